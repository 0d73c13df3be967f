"""Compiled fits against the same functions as numpy runs them."""

from dataclasses import replace

import numpy as np
import pytest
from one_frame import CURVE, TOUCHES, TWO_FRAMES, frame

from eitskin import compiled
from eitskin.compiled import kernels
from eitskin.training.joint import fit_kernels
from eitskin.training.joint.objective import Unknowns, levenberg_marquardt

from on_demand import require_kernels
from smooth_sensor import TOUCH_PRIOR

require_kernels()

NEAR = [[0.050, 0.030, 6.0], [0.062, 0.036, 11.0], [0.055, 0.020, 8.0]]
STARTS = {"untouched": [], **TOUCHES, "near": NEAR, "at bounds": [TOUCH_PRIOR.low] * 2}


@pytest.mark.parametrize("steps", [1, 3, 8])
def test_fits_end_where_those_of_plain_numpy_do(steps):
    """Starts near and far, steps that shrink, bounds that hold, and a goal out of reach."""
    objective = frame(TOUCHES[3], 20.0, 12.0, np.random.default_rng(1))
    with kernels():
        fast = replace(objective)
    for name, touches in STARTS.items():
        for away, goal in ((0.0, np.inf), (0.009, np.inf), (0.003, 500.0)):
            start = np.array(touches, dtype=float).reshape(-1, 3)
            start = np.add(start, [away, -away, 0.0])
            start = np.clip(start, TOUCH_PRIOR.low, TOUCH_PRIOR.high)
            at = objective.linearise(Unknowns(start, 14.0))
            whitening = objective.whitening(at)
            one, other = (
                levenberg_marquardt(each, at, steps, 0.03, whitening, goal)
                for each in (objective, fast)
            )
            assert other.misfit == pytest.approx(one.misfit, rel=1e-6), name
            assert other.unknowns.angle_deg == pytest.approx(one.unknowns.angle_deg, abs=1e-5)
            np.testing.assert_allclose(other.unknowns.touches, one.unknowns.touches, atol=1e-6)


def test_whitened_vectors_and_angles_are_those_of_the_library():
    rng = np.random.default_rng(2)
    with kernels():
        fast = compiled.implementation(fit_kernels.__name__)
    assert fast.whiten is not fit_kernels.whiten
    root = rng.standard_normal((28, 28))
    covariance, vectors = root @ root.T + np.eye(28), rng.standard_normal((3, 28))
    white, width = fast.whiten(covariance, vectors)
    expected = vectors @ np.linalg.inv(covariance) @ vectors.T
    np.testing.assert_allclose(white @ white.T, expected, rtol=1e-9, atol=1e-9)
    assert width == pytest.approx(0.5 * np.linalg.slogdet(covariance)[1])
    for angle in (-8.0, 3.0, 31.0):
        change = CURVE.value(angle) + rng.multivariate_normal(np.zeros(28), TWO_FRAMES)
        given = CURVE.coefficients, CURVE.blocks, change, TWO_FRAMES, angle + 2.0, (-25.0, 55.0)
        by_kernel, plain = fast.score_angle(*given), fit_kernels.score_angle(*given)
        assert by_kernel[0] == pytest.approx(plain[0], abs=1e-5)
        assert [by_kernel[1], by_kernel[3]] == pytest.approx([plain[1], plain[3]], rel=1e-6)
        np.testing.assert_allclose(by_kernel[2], plain[2], rtol=1e-5, atol=1e-5)
        residual, slope = by_kernel[2]
        covariance = TWO_FRAMES + CURVE.uncertainty(by_kernel[0])
        off = change - CURVE.value(by_kernel[0])
        assert residual @ residual == pytest.approx(off @ np.linalg.solve(covariance, off))
        assert residual @ slope == pytest.approx(0.0, abs=1e-2 * np.sqrt(slope @ slope))
