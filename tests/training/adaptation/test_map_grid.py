"""Inversion of maps: channels that are left out, against covariances without them."""

import numpy as np

from eitskin.training.adaptation.map_grid import Places, _Score, mixture_places


def test_a_bad_channel_is_left_out_of_covariance_and_residual():
    rng = np.random.default_rng(0)
    whitening, keep = rng.standard_normal((4, 4)), [0, 2, 3]
    back = np.linalg.inv(whitening)
    answer, means = rng.standard_normal(4), rng.standard_normal((2, 4))
    precision = rng.uniform(0.2, 1.0, (2, 4))
    score = _Score(np.array([1.0, 0.5]), answer @ whitening, whitening[[1]])
    yy, ym, mm, log = score._products(means, precision)
    dropped = []
    for at in range(2):
        covariance = (back.T @ np.diag(1.0 / precision[at]) @ back)[np.ix_(keep, keep)]
        y, m = answer[keep], (means[at] @ back)[keep]
        expected = [a @ np.linalg.solve(covariance, b) for a, b in ((y, y), (y, m), (m, m))]
        np.testing.assert_allclose([yy[at], ym[at], mm[at]], expected, rtol=1e-9)
        dropped.append(-np.linalg.slogdet(covariance)[1])
    np.testing.assert_allclose(log[1] - log[0], dropped[1] - dropped[0], rtol=1e-9)


def test_mixed_places_have_the_moments_of_the_mixture():
    rng = np.random.default_rng(1)
    each = [
        Places(rng.normal(size=(2, 2)), rng.uniform(0.1, 2.0, 2), np.ones(2), np.zeros((2, 4)))
        for _ in range(3)
    ]
    mixed = mixture_places(each)
    drawn = [
        one.place + one.deviation[:, None] / np.sqrt(2.0) * rng.standard_normal((100_000, 2, 2))
        for one in each
    ]
    points = np.concatenate(drawn)
    np.testing.assert_allclose(mixed.place, points.mean(axis=0), atol=0.02)
    spread = np.sqrt(points.var(axis=0).sum(axis=1))
    np.testing.assert_allclose(mixed.deviation, spread, rtol=0.01)
    assert mixture_places(each[:1]) is each[0]
