"""Gaussian-process maps against a dense solution, left-out presses against fits without them."""

import numpy as np
import pytest

from eitskin.training.adaptation.channel_maps import (
    ChannelMaps,
    KernelFeatures,
    PlaceKernel,
    Presses,
)

KERNEL = PlaceKernel(0.03)


def presses(count=30, channels=4, seed=0):
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.0, 0.1, (count, 2))
    waves = rng.uniform(-40.0, 40.0, (2, channels))
    strength = rng.uniform(0.5, 2.0, count)
    answers = strength[:, None] * np.cos(places @ waves)
    return Presses.of(places, strength, answers + 0.1 * rng.standard_normal(answers.shape))


def dense(maps, learned, at):
    """Mean and covariance of all channels at places, by the full covariance of all answers."""
    back = np.linalg.inv(maps.whitening)
    signal, noise = back.T @ np.diag(maps.gain) @ back, back.T @ back
    s, n = learned.strength, len(learned.strength)
    full = np.kron(KERNEL(learned.places, learned.places) * np.outer(s, s), signal)
    full += np.kron(np.diag(1.0 / learned.weight), noise)
    cross = np.kron(KERNEL(at, learned.places) * s, signal)
    mean = cross @ np.linalg.solve(full, learned.answers.ravel())
    prior = np.kron(KERNEL(at, at), signal)
    covariance = prior - cross @ np.linalg.solve(full, cross.T)
    assert n * len(signal) == len(full)
    return mean.reshape(len(at), -1), covariance, back


@pytest.mark.parametrize("weighted", [False, True])
def test_maps_are_those_of_the_full_covariance(weighted):
    learned = presses()
    if weighted:
        learned.weight[20:] = 0.1
    maps = ChannelMaps.fit(KERNEL, learned, 0.05)
    at = np.random.default_rng(1).uniform(0.0, 0.1, (3, 2))
    mean, variance = maps.at(at)
    expected, covariance, back = dense(maps, learned, at)
    np.testing.assert_allclose(mean @ back, expected, atol=1e-5)
    for place in range(3):
        own = covariance[4 * place : 4 * place + 4, 4 * place : 4 * place + 4]
        np.testing.assert_allclose(back.T @ np.diag(variance[place]) @ back, own, atol=1e-5)


def test_left_out_presses_are_predicted_as_by_a_fit_without_them():
    learned = presses()
    learned = learned.select(np.r_[np.arange(30), np.arange(5)])  # copies go with their owner
    learned.weight[30:] = 0.2
    learned.places[30:] += 0.01
    maps = ChannelMaps.fit(KERNEL, learned, 0.05)
    mean, variance = maps.left_out(learned)
    for press in (2, 17):
        rest = learned.select(learned.owner != press)
        expected, covariance, back = dense(maps, rest, learned.places[press : press + 1])
        s = learned.strength[press]
        np.testing.assert_allclose(mean[press] @ back, s * expected[0], atol=1e-5)
        noise = back.T @ back
        predicted = back.T @ np.diag(variance[press]) @ back
        np.testing.assert_allclose(predicted, s**2 * covariance + noise, atol=1e-5)


def test_learned_noise_is_that_of_the_presses():
    learned = presses(400)
    maps = ChannelMaps.fit(KERNEL, learned, 0.05)
    back = np.linalg.inv(maps.whitening)
    np.testing.assert_allclose(np.diag(back.T @ back), 0.01, rtol=0.3)


def test_features_are_bounded_and_give_the_kernel_back():
    places = np.random.default_rng(0).uniform(0.0, 0.1, (900, 2))
    features = KernelFeatures.of(PlaceKernel(0.05), places, most=150)
    assert len(features.chosen) <= 150
    phi = features(places[:50])
    np.testing.assert_allclose(phi @ phi.T, PlaceKernel(0.05)(places[:50], places[:50]), atol=0.02)
