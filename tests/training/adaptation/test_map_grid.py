"""Inversion of maps: channels that are left out, against covariances without them."""

import numpy as np

from eitskin.training.adaptation.map_grid import _Score


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
