"""Gaussian-process maps against a dense solution, left-out presses against fits without them."""

import dataclasses

import numpy as np
import pytest

from eitskin.geometry import SensorDesign
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Disc
from eitskin.simulator import Protocol
from eitskin.training.adaptation import sheet
from eitskin.training.adaptation.channel_maps import (
    ChannelMaps,
    PlaceKernel,
    Presses,
)
from eitskin.training.adaptation.sheet import Sectors, design_span

KERNEL = PlaceKernel(0.03)


def presses(count=30, channels=4, seed=0):
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.0, 0.1, (count, 2))
    waves = rng.uniform(-40.0, 40.0, (2, channels))
    strength = rng.uniform(0.5, 2.0, count)
    answers = strength[:, None] * np.cos(places @ waves)
    return Presses.from_frames(places, strength, answers + 0.1 * rng.standard_normal(answers.shape))


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
    mean, variance = maps.evaluate(at)
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


# ---- sheet ----


RADIUS, N = 0.05, 6
ANGLES = 2 * np.pi * np.arange(N) / N
RING = Protocol.from_rows(
    [(d, (d + 3) % N, (s + 1) % N, s) for d in range(N) for s in ((d + 1) % N, (d + 4) % N)], N
)


def ring():
    x, y = RADIUS + 0.8 * RADIUS * np.array([np.cos(ANGLES), np.sin(ANGLES)])
    electrodes = tuple(
        Electrode(on="top", shape="round", width=0.004, x=float(a), y=float(b))
        for a, b in zip(x, y, strict=True)
    )
    return SensorDesign(Disc(RADIUS), 0.003, electrodes, encapsulated_thickness=0.003)


def answers(places, signs=1.0):
    """Ideal answers by the fields of point electrodes in an unbounded sheet."""
    z = (places - RADIUS) @ [1.0, 1j]
    field = 1.0 / (z[:, None] - 0.8 * RADIUS * np.exp(1j * ANGLES))
    rows = np.array(RING.table)
    drive = field[:, rows[:, 0]] - field[:, rows[:, 1]]
    sense = field[:, rows[:, 2]] - field[:, rows[:, 3]]
    return signs * np.real(drive * sense.conj()) * RADIUS**2


def test_rotations_of_a_ring_are_found_and_only_with_their_channels():
    sectors = Sectors.from_design(ring(), RING)
    assert sectors.turned.shape == (N, len(RING))
    places = RADIUS + np.random.default_rng(0).uniform(-0.02, 0.02, (5, 2))
    turned = np.empty((5, len(RING)))
    turned[:, sectors.turned[2]] = answers(places)
    np.testing.assert_allclose(turned, answers(sectors.rotate(places, 2)), atol=1e-12)
    fewer = Protocol(RING.table[1:], N)
    assert Sectors.from_design(ring(), fewer) is None
    assert Sectors.from_design(None, RING) is None
    assert Sectors.from_design(ring(), Protocol.pairwise(N)).turned.shape == (N, 15)
    half_turn = Sectors.from_design(SensorDesign.reference(), Protocol.adjacent(8))
    assert half_turn.turned.shape == (2, 40)
    square = dataclasses.replace(ring(), electrodes=ring().electrodes[:5])
    assert Sectors.from_design(square, Protocol.adjacent(5)) is None


def test_gains_and_signs_are_found_from_few_presses():
    sectors = Sectors.from_design(ring(), RING)
    rng = np.random.default_rng(1)
    places = RADIUS + rng.uniform(-0.025, 0.025, (12, 2))
    signs = np.where(rng.random(len(RING)) < 0.5, -1.0, 1.0)
    sizes = np.exp(0.2 * rng.standard_normal(len(RING)))
    seen = answers(places, signs * sizes)
    gains = sectors.gains(PlaceKernel(0.04), Presses.from_frames(places, np.ones(12), seen))
    for orbit in sectors.turned.T:
        relative = gains[orbit] / (signs * sizes)[orbit]
        assert len(set(np.sign(relative))) == 1
        assert np.std(np.log(np.abs(relative))) < 0.25


def test_copies_keep_their_owner():
    sectors = Sectors.from_design(ring(), RING)
    places = RADIUS + np.array([[0.01, 0.0], [0.0, 0.02]])
    presses = sectors.copy_to_sectors(Presses.from_frames(places, np.ones(2), answers(places)), 0.1)
    assert len(presses.strength) == 2 * N
    np.testing.assert_array_equal(presses.owner, np.tile([0, 1], N))
    np.testing.assert_array_equal(presses.weight, np.repeat([1.0, 0.1], [2, 2 * (N - 1)]))
    np.testing.assert_allclose(presses.answers, answers(presses.places), atol=1e-12)


@pytest.mark.slow
def test_span_of_a_design_holds_the_maps_of_its_protocol(monkeypatch):
    """Any sensitivity is a combination of the span's maps: here against those of point sources."""
    monkeypatch.setattr(sheet, "SPAN_PIXELS", 900)
    span = design_span(ring())
    places = RADIUS + np.random.default_rng(2).uniform(-0.022, 0.022, (200, 2))
    features, wanted = span.features(places), answers(places)
    found = features @ np.linalg.lstsq(features, wanted, rcond=1e-6)[0]
    assert np.linalg.norm(found - wanted) < 0.03 * np.linalg.norm(wanted)
