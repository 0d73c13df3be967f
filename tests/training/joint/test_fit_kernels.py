"""Compiled fits against the same functions as numpy runs them."""

from dataclasses import replace

import numpy as np
import pytest
from one_frame import TOUCHES, frame

from eitskin import compiled
from eitskin.compiled import kernels
from eitskin.training.joint.objective import Unknowns, levenberg_marquardt

from smooth_sensor import TOUCH_PRIOR

if compiled.load_kernels("numba") is None:
    pytest.skip("needs the extra `fast`, without EITSKIN_PLAIN", allow_module_level=True)

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
