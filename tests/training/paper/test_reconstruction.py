"""One-step Gauss-Newton with the NOSER prior."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.training.paper.stages import MAX_SNR, Reconstruction, signal_to_noise

SHAPE = (8, 16)


@pytest.fixture
def jacobian():
    return np.random.default_rng(0).normal(size=(12, 128)) * np.geomspace(0.4, 1, 128)


def test_push_through_form_is_the_formula_of_the_paper(jacobian):
    made = Reconstruction.fit(jacobian, snr=20.0, shape=SHAPE)
    prior = np.diag(np.sum(jacobian**2, axis=0))
    gram = jacobian.T @ jacobian + made.regularisation**2 * prior
    np.testing.assert_allclose(made.matrix, np.linalg.solve(gram, jacobian.T), rtol=1e-7)


def test_noise_of_channels_weighs_them_as_in_the_map_estimate(jacobian):
    noise = np.geomspace(1e-4, 1e-1, 12)
    made = Reconstruction.fit(jacobian, 20.0, SHAPE, noise)
    precision = np.diag(noise**-2)
    seen = np.einsum("mp,mn,np->p", jacobian, precision, jacobian)
    prior = np.diag(np.maximum(seen, 0.1 * np.median(seen)))
    gram = jacobian.T @ precision @ jacobian + made.regularisation**2 * prior
    expected = np.linalg.solve(gram, jacobian.T @ precision)
    np.testing.assert_allclose(made.matrix, expected, rtol=1e-6, atol=1e-9)
    alike = Reconstruction.fit(jacobian, 20.0, SHAPE, np.full(12, 0.3)).matrix
    plain = Reconstruction.fit(jacobian, 20.0, SHAPE).matrix
    np.testing.assert_allclose(alike, plain, rtol=1e-9)


def test_signal_to_noise_takes_the_noise_off():
    touch = np.random.default_rng(2).normal(size=(5000, 20)) * np.hypot(3.0, 1.0)
    assert signal_to_noise(touch, 1.0) == pytest.approx(3.0, rel=0.02)
    assert signal_to_noise(touch, 0.0) == MAX_SNR
    assert 0 < signal_to_noise(touch, 100.0) < 1


def test_refusals(jacobian):
    assert Reconstruction.fit(jacobian, snr=np.inf, shape=SHAPE).regularisation > 0
    with pytest.raises(ConfigurationError, match=r"128 columns.*got 120"):
        Reconstruction.fit(jacobian[:, :120], snr=20.0, shape=SHAPE)
    with pytest.raises(ConfigurationError, match="positive snr"):
        Reconstruction.fit(jacobian, snr=-1.0, shape=SHAPE)
