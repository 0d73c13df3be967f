"""Initial values, steps and faults, against plain loops and library solvers."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from one_frame import TOUCHES, explained, frame, residual

from eitskin.training.joint.channel_faults import FAULT_PRICE, FAULT_SIZE, possible_faults
from eitskin.training.joint.fit_kernels import (
    ANGLE_PRIOR_STD_DEG,
    ANGLE_UNIT,
    DAMPINGS,
    TOUCH_UNITS,
    trust_step,
)
from eitskin.training.joint.objective import TouchObjective, Unknowns, levenberg_marquardt
from eitskin.training.joint.touch_search import (
    MIN_DISTANCE,
    PAIR_STRIDE,
    TouchCandidates,
    pair_starts,
)

from on_demand import OnDemand
from smooth_sensor import (
    FLAT,
    MEASUREMENTS,
    NOISE,
    PROTOCOL,
    RANGES,
    TOUCH_PRIOR,
    curve,
    places,
    response,
)

stats = OnDemand("scipy.stats")

ONE, CURVE = response(mismatch=0.05).for_specimen(()), curve()
TWO = np.array([[0.055, 0.030, 7.0], [0.100, 0.020, 9.0]])
BAD = [4, 11]


@pytest.fixture(scope="module")
def objective():
    """Objective of a frame with two touches, motion and two bad channels."""
    change = CURVE.value(14.0) - CURVE.value(10.0) + ONE(TWO, 14.0).sum(axis=0)
    change = change + NOISE * np.random.default_rng(0).standard_normal(28)
    change[BAD] = np.nan
    combined = MEASUREMENTS.combine(change, 2.0, 1e-8)
    return TouchObjective(combined, 10.0, ONE, CURVE, TOUCH_PRIOR)


@pytest.fixture(scope="module")
def candidates():
    force = RANGES.middle_force
    touches = np.column_stack([places(), np.full(len(places()), force)])
    return TouchCandidates(places(), force, ONE(touches, 10.0))


def test_steps_are_the_least_damped_shorter_where_they_fail_and_stay_at_bounds(linear):
    whole = frame(TOUCHES[3], 20.0, 12.0, np.random.default_rng(1))
    near = np.array([[0.050, 0.030, 6.0], [0.062, 0.036, 11.0], [0.055, 0.020, 8.0]])
    start = whole.linearise(Unknowns(near, -10.0))
    metric = whole.whitening(start)
    ended, exact = (levenberg_marquardt(whole, start, 20, t, metric) for t in (0.3, 1e-9))
    assert exact.misfit < 28.0
    away = [one.touches - exact.unknowns.touches for one in (ended.unknowns, ended.minimum(0.3))]
    assert np.abs(away[1]).max() < 0.1 * np.abs(away[0]).max()
    np.testing.assert_array_equal(ended.minimum(0.0).touches, ended.unknowns.touches)
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
    held = np.arange(7) % 3 == 1
    at = np.where(
        held[1:], np.sign(linear.products[0, 1:][1:]), -np.sign(linear.products[0, 1:][1:])
    )
    step, _ = trust_step(linear.products, at.reshape(2, 3), FRAME, np.inf)
    expected = np.linalg.lstsq(linear.jacobian[:, ~held], linear.residual, rcond=None)[0]
    np.testing.assert_allclose(step[~held], expected, rtol=1e-4)
    np.testing.assert_allclose(step[held], 0.0, atol=1e-6)


@pytest.mark.slow
def test_gradients_are_differences_of_the_misfit_also_of_touches_that_lie_too_close(objective):
    """And the curvature by the angle is that of residual and prior."""
    close = np.array([[0.055, 0.030, 7.0], [0.058, 0.026, 9.0]])
    metric = objective.whitening(objective.linearise(Unknowns(close, 13.0)))

    def at(angle, *touches):
        unknowns = Unknowns(np.array(touches).reshape(2, 3), angle)
        return levenberg_marquardt(objective, unknowns, 0, 0.03, metric)

    whole, units = at(13.0, *close.ravel()), np.array([ANGLE_UNIT, *TOUCH_UNITS, *TOUCH_UNITS])
    for i, step in enumerate(1e-4 * np.diag(units)):
        ahead, behind = (at(*([13.0, *close.ravel()] + sign * step)).misfit for sign in (1, -1))
        assert -2.0 * whole.products[0, 1 + i] == pytest.approx((ahead - behind) / 2e-4, rel=0.01)
    own = whole.products[1, 1] - whole.white[1] @ whole.white[1]
    assert own == pytest.approx((ANGLE_UNIT / ANGLE_PRIOR_STD_DEG) ** 2)


def test_best_pairs_are_those_of_a_loop_over_all(objective, candidates):
    start = Unknowns(np.array([[0.012, 0.048, 3.0]]), 14.0)
    found = levenberg_marquardt(objective, objective.linearise(start), 0, 0.03)
    rest = [found.unknowns.without_touch(0), found.unknowns]
    said = pair_starts(found, [0, None], candidates)
    tried = candidates.places[::PAIR_STRIDE]
    shapes = found.whitening @ candidates.change[::PAIR_STRIDE].T
    for unknowns, (promise, pair) in zip(rest, said, strict=True):
        left, best = found.whitening @ residual(objective, unknowns), (np.inf, None)
        taken = unknowns.touches[:, :2]
        for i, j in combinations(range(len(tried)), 2):
            near = np.linalg.norm(taken - tried[[i, j], None], axis=-1) <= MIN_DISTANCE * 0.030
            if near.any() or np.linalg.norm(tried[i] - tried[j]) <= TOUCH_PRIOR.separation:
                continue
            share = np.linalg.lstsq(shapes[:, [i, j]], left, rcond=None)[0]
            forces = share * candidates.force
            if np.any(forces <= TOUCH_PRIOR.low[2]) or np.any(forces >= TOUCH_PRIOR.high[2]):
                continue
            misfit = np.sum((left - shapes[:, [i, j]] @ share) ** 2)
            best = min(best, (misfit, (i, j), tuple(forces)))
        assert promise == pytest.approx(best[0], rel=1e-6)
        np.testing.assert_allclose(pair.touches[-2:, :2], tried[list(best[1])])
        np.testing.assert_allclose(pair.touches[-2:, 2], best[2], rtol=1e-6)


def test_faults_are_every_channel_and_contact_weighed_by_density_and_no_touch_near_them():
    """Against the normal density with the faults' covariance, the best of all sets by hand."""
    flat = FLAT.copy()
    flat[3] = np.nan
    said = possible_faults(PROTOCOL, flat)
    assert [fault.members for fault in said.faults[:28]] == [(i,) for i in range(28)]
    np.testing.assert_array_equal(said.changes[:, :28], np.eye(28))
    for electrode in range(8):
        fault, change = said.faults[28 + electrode], said.changes[:, 28 + electrode]
        through = [electrode in row[:2] and electrode in row[2:] for row in PROTOCOL.table]
        assert fault.members == tuple(np.flatnonzero(through))
        share = np.where(np.isnan(flat), 0.0, np.nanmedian(flat) / flat)
        np.testing.assert_allclose(change, np.where(through, share, 0.0))
    assert len(said.faults) == 36
    rng = np.random.default_rng(12)
    for x, y in ((0.0225, 0.010), (0.075, 0.012), (0.140, 0.030)):
        found = explained(frame([[x, y, 8.0]], 0.0, 0.0, rng, mismatch=0.05))
        assert len(found.touches) == 1
        assert found.faults == ()
    rng = np.random.default_rng(4)
    possible = possible_faults(PROTOCOL, FLAT)
    combined = frame((), 0.0, 0.0, rng).combined
    slope = 1e-3 * rng.standard_normal((1, 28))
    for electrodes in ((2,), (1, 6), (0, 3, 7)):
        numbers = [28 + electrode for electrode in electrodes]
        sizes = rng.uniform(0.004, 0.01, len(numbers)) * np.array([1, -1, 1])[: len(numbers)]
        measured = combined.measured + possible.changes[:, numbers] @ sizes
        faulty = possible.alone(replace(combined, measured=measured), slope)
        assert [possible.faults.index(fault) for fault in faulty.faults] == numbers
        shown = FAULT_SIZE * possible.changes[:, numbers]
        covariance = combined.noise + slope.T @ slope + shown @ shown.T
        log = stats.multivariate_normal(np.zeros(28), covariance).logpdf(measured)
        expected = -2.0 * log - 28 * np.log(2.0 * np.pi) + FAULT_PRICE * len(numbers)
        assert faulty.improbability == pytest.approx(expected, rel=1e-6)
        assert np.abs(faulty.rest.measured).max() < 0.3 * np.abs(measured).max()


NOWHERE = np.zeros((0, 3))  # no unknown has bounds
FRAME = np.zeros(1), np.zeros(5), np.array([[0.0] * 3] * 2 + [[-1.0] * 3, [1.0] * 3])


@pytest.fixture
def linear():
    """Residual (20,) and Jacobian (20, 7) of a linear problem, and the products of both."""
    rng = np.random.default_rng(0)
    jacobian, residual = rng.standard_normal((20, 7)), 30.0 * rng.standard_normal(20)
    both = np.column_stack([residual, jacobian])
    return SimpleNamespace(residual=residual, jacobian=jacobian, products=both.T @ both)
