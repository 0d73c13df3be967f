"""Steps of the fit: within their trust region, and of unknowns that bounds hold."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from one_frame import STIFF, TOUCHES, frame
from scipy.optimize import minimize

from eitskin.training.joint.fit_kernels import DAMPINGS, trust_step
from eitskin.training.joint.objective import Unknowns, levenberg_marquardt

from smooth_sensor import TOUCH_PRIOR

NOWHERE = np.zeros((0, 3))  # no unknown has bounds
FRAME = np.zeros(1), np.zeros(5), np.array([[0.0] * 3] * 2 + [[-1.0] * 3, [1.0] * 3])


@pytest.fixture
def linear():
    """Residual (20,) and Jacobian (20, 7) of a linear problem, and the products of both."""
    rng = np.random.default_rng(0)
    jacobian, residual = rng.standard_normal((20, 7)), 30.0 * rng.standard_normal(20)
    both = np.column_stack([residual, jacobian])
    return SimpleNamespace(residual=residual, jacobian=jacobian, products=both.T @ both)


def test_a_wide_region_is_left_to_the_minimum(linear):
    expected = np.linalg.lstsq(linear.jacobian, linear.residual, rcond=None)[0]
    np.testing.assert_allclose(
        trust_step(linear.products, NOWHERE, FRAME, np.inf)[0], expected, rtol=1e-4
    )


@pytest.mark.parametrize("radius", [3.0, 1.0, 0.1])
def test_steps_stay_within_their_region_and_promise_what_they_gain(linear, radius):
    step, promised = trust_step(linear.products, NOWHERE, FRAME, radius)
    assert 0.1 * radius < np.abs(step).max() <= radius
    left = linear.residual - linear.jacobian @ step
    assert promised == pytest.approx(linear.products[0, 0] - left @ left, rel=1e-9)
    assert promised > 0.0


def test_steps_are_the_least_damped_ones_within_their_region(linear):
    unit = np.eye(7) + np.diag(np.diag(linear.products[1:, 1:]))
    steps = [
        np.linalg.solve(linear.products[1:, 1:] + d * unit, linear.products[0, 1:])
        for d in DAMPINGS
    ]
    lengths = np.abs(steps).max(axis=1)
    for radius in (lengths[0], lengths[3], lengths[8], 1e-9):
        within = np.append(np.flatnonzero(lengths <= 1.0001 * radius), len(steps) - 1)[0]
        step, _ = trust_step(linear.products, NOWHERE, FRAME, 1.0001 * radius)
        np.testing.assert_allclose(step, steps[within], rtol=1e-8)


def test_unknowns_stay_at_bounds_that_they_would_cross_and_the_others_take_them_for_known(linear):
    held = np.arange(7) % 3 == 1
    at = np.where(
        held[1:], np.sign(linear.products[0, 1:][1:]), -np.sign(linear.products[0, 1:][1:])
    )
    step, _ = trust_step(linear.products, at.reshape(2, 3), FRAME, np.inf)
    expected = np.linalg.lstsq(linear.jacobian[:, ~held], linear.residual, rcond=None)[0]
    np.testing.assert_allclose(step[~held], expected, rtol=1e-4)
    np.testing.assert_allclose(step[held], 0.0, atol=1e-6)


@pytest.mark.parametrize("force", [0.8, 17.0])
def test_a_fit_beyond_a_bound_is_the_best_within(force):
    """Against bounded minimisation of the same misfit by scipy, without derivatives.

    The response is one that does not depend on the bend: its slope is left out of the angle's.
    """
    true = np.array([[*TOUCHES[1][0][:2], force]])
    objective = replace(frame(true, 5.0, 5.0, np.random.default_rng(3)), response=STIFF)
    start = objective.linearised(Unknowns(np.array([[0.050, 0.026, 8.0]]), 4.0))
    whitening = objective.whitening(start)
    found = levenberg_marquardt(objective, start, 30, 1e-8, whitening)
    bound = TOUCH_PRIOR.low[2] if force < 1.0 else TOUCH_PRIOR.high[2]
    assert found.unknowns.touches[0, 2] == pytest.approx(bound, rel=1e-5)

    def misfit(x):
        unknowns = Unknowns(np.array([[0.01 * x[1], 0.01 * x[2], x[3]]]), x[0])
        return objective.misfit(objective.linearised(unknowns), whitening)

    low, high = TOUCH_PRIOR.low * [100.0, 100.0, 1.0], TOUCH_PRIOR.high * [100.0, 100.0, 1.0]
    bounds = [(-25.0, 55.0), *zip(low, high, strict=True)]
    best = minimize(misfit, [5.0, 4.5, 2.1, bound], bounds=bounds, method="L-BFGS-B", tol=1e-14)
    # A touch weaker than any that was learned leaves a valley, along which steps become short.
    weak = force < 1.0
    assert found.misfit == pytest.approx(best.fun, abs=0.1 if weak else 1e-5 * best.fun)
    away = np.abs(found.unknowns.touches[0, :2] - 0.01 * best.x[1:3]).max()
    assert away < (1e-3 if weak else 2e-5)


def test_the_step_at_which_a_fit_ends_leads_on_to_its_minimum():
    objective = frame(TOUCHES[2], 15.0, 10.0, np.random.default_rng(4))
    start = objective.linearised(Unknowns(np.array(TOUCHES[2]) + 0.004, 12.0))
    whitening = objective.whitening(start)
    coarse, fine = (
        levenberg_marquardt(objective, start, 30, tolerance, whitening)
        for tolerance in (20.0, 1e-10)
    )
    off, on = (
        np.abs(unknowns.touches - fine.unknowns.touches)[:, :2].max()
        for unknowns in (coarse.unknowns, coarse.minimum(20.0))
    )
    assert on < 0.3 * off
    early = levenberg_marquardt(objective, start, 1, 20.0, whitening)
    assert early.minimum(20.0).touches is early.at.touches  # it ended before its minimum
