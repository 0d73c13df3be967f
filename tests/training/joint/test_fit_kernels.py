"""Compiled fits against the same functions as numpy runs them."""

from dataclasses import replace

import numpy as np
import pytest
from one_frame import FAULTS, RESPONSE, TOUCHES, candidates, frame

from eitskin import compiled
from eitskin.compiled import kernels
from eitskin.training.joint.combinations import Combinations
from eitskin.training.joint.model_selection import fit_frame
from eitskin.training.joint.objective import Unknowns, levenberg_marquardt

from smooth_sensor import TOUCH_PRIOR

if compiled.loaded("numba") is None:
    pytest.skip("needs the extra `fast`, without EITSKIN_PLAIN", allow_module_level=True)

NEAR = [[0.050, 0.030, 6.0], [0.062, 0.036, 11.0], [0.055, 0.020, 8.0]]
STARTS = {"untouched": [], **TOUCHES, "near": NEAR, "at bounds": [TOUCH_PRIOR.low] * 2}


def compiled_one(objective):
    """The same objective with compiled kernels."""
    with kernels():
        return replace(objective)


def three_layers():
    """Specimen response of three layers, the last of which mixes."""
    rng = np.random.default_rng(8)
    mixing = np.eye(160) + 0.01 * rng.standard_normal((160, 160))
    weights, biases = (*RESPONSE.weights, mixing), (*RESPONSE.biases, 0.1 * np.ones(160))
    return replace(RESPONSE, weights=weights, biases=biases).of(())


@pytest.mark.parametrize("layers", [2, 3])
def test_linearisations_are_those_of_plain_numpy(layers):
    objective = frame(TOUCHES[3], 20.0, 12.0, np.random.default_rng(0))
    if layers == 3:
        objective = replace(objective, response=three_layers())
    fast = compiled_one(objective)
    for name, touches in STARTS.items():
        unknowns = Unknowns(np.array(touches, dtype=float).reshape(-1, 3), 17.0)
        plain, found = objective.linearised(unknowns), fast.linearised(unknowns)
        np.testing.assert_allclose(found.rows, plain.rows, rtol=1e-10, atol=1e-15, err_msg=name)
        if len(touches):
            np.testing.assert_allclose(found.changes, plain.changes, rtol=1e-10, atol=1e-15)
            np.testing.assert_allclose(found.hidden, plain.hidden, rtol=1e-10, atol=1e-12)
        whitening = objective.whitening(plain)
        one, other = objective.quadratic(plain, whitening), fast.quadratic(found, whitening)
        assert other.misfit == pytest.approx(one.misfit, rel=1e-10)
        size = np.abs(one.hessian).max()
        np.testing.assert_allclose(other.products, one.products, rtol=1e-8, atol=1e-10 * size)
        np.testing.assert_allclose(other.white, one.white, rtol=1e-8, atol=1e-10 * size)


@pytest.mark.parametrize("combined", [False, True])
def test_covariances_are_those_of_plain_numpy(combined):
    objective = frame(TOUCHES[3], 20.0, 12.0, np.random.default_rng(0), mismatch=0.1)
    if combined:
        basis = np.linalg.qr(np.random.default_rng(4).standard_normal((28, 28)))[0]
        several = Combinations(objective.combined.combinations.noise, basis)
        objective = replace(objective, combined=replace(objective.combined, combinations=several))
    fast = compiled_one(objective)
    for name, touches in STARTS.items():
        for angle in (12.0, 17.0):
            unknowns = Unknowns(np.array(touches, dtype=float).reshape(-1, 3), angle)
            plain = objective.covariance(objective.linearised(unknowns))
            found = fast.covariance(fast.linearised(unknowns))
            np.testing.assert_allclose(
                found, plain, rtol=1e-9, atol=1e-12 * np.abs(plain).max(), err_msg=name
            )


@pytest.mark.parametrize("steps", [1, 3, 8])
def test_fits_end_where_those_of_plain_numpy_do(steps):
    """Starts near and far, steps that shrink, bounds that hold, and a goal out of reach."""
    objective = frame(TOUCHES[3], 20.0, 12.0, np.random.default_rng(1))
    fast = compiled_one(objective)
    for name, touches in STARTS.items():
        for away, goal in ((0.0, np.inf), (0.009, np.inf), (0.003, 500.0)):
            start = np.array(touches, dtype=float).reshape(-1, 3)
            start = np.add(start, [away, -away, 0.0])
            start = np.clip(start, TOUCH_PRIOR.low, TOUCH_PRIOR.high)
            at = objective.linearised(Unknowns(start, 14.0))
            whitening = objective.whitening(at)
            one, other = (
                levenberg_marquardt(each, at, steps, 0.03, whitening, goal)
                for each in (objective, fast)
            )
            assert other.misfit == pytest.approx(one.misfit, rel=1e-6), name
            assert other.unknowns.angle_deg == pytest.approx(one.unknowns.angle_deg, abs=1e-5)
            np.testing.assert_allclose(other.unknowns.touches, one.unknowns.touches, atol=1e-6)


def test_frames_are_explained_as_by_plain_numpy():
    rng = np.random.default_rng(2)
    for count, angle in ((0, 10.0), (1, 0.0), (2, 35.0), (4, -10.0)):
        objective = frame(TOUCHES.get(count, ()), angle, angle - 3.0, rng)
        tried = candidates(angle)
        one = fit_frame(objective, tried, None, FAULTS)
        other = fit_frame(compiled_one(objective), tried, None, FAULTS)
        assert len(one.touches) == count
        np.testing.assert_allclose(other.touches, one.touches, atol=1e-6)
        np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-4)
        assert other.evidence == pytest.approx(one.evidence, rel=1e-6)
        assert other.misfit == pytest.approx(one.misfit, rel=1e-6)
