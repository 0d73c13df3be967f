"""Initial values and faults against exhaustive search in plain loops."""

from itertools import combinations

import numpy as np
import pytest
from one_frame import residual

from eitskin.training.joint.channel_faults import possible_faults
from eitskin.training.joint.fit_kernels import ANGLE_UNIT, TOUCH_UNITS
from eitskin.training.joint.objective import TouchObjective, Unknowns, levenberg_marquardt
from eitskin.training.joint.touch_search import (
    LEAST_DISTANCE,
    PAIR_STRIDE,
    TouchCandidates,
    initial_touches,
    pair_starts,
)

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

ONE, CURVE = response(mismatch=0.05).of(()), curve()
TWO = np.array([[0.055, 0.030, 7.0], [0.100, 0.020, 9.0]])
BAD = [4, 11]


@pytest.fixture(scope="module")
def objective():
    """Objective of a frame with two touches, motion and two bad channels."""
    change = CURVE.value(14.0) - CURVE.value(10.0) + ONE(TWO, 14.0).sum(axis=0)
    change = change + NOISE * np.random.default_rng(0).standard_normal(28)
    change[BAD] = np.nan
    combined = MEASUREMENTS.combined(change, 2.0, 1e-8)
    return TouchObjective(combined, 10.0, ONE, CURVE, TOUCH_PRIOR)


@pytest.fixture(scope="module")
def candidates():
    force = RANGES.middle_force
    touches = np.column_stack([places(), np.full(len(places()), force)])
    return TouchCandidates(places(), force, ONE(touches, 10.0))


def plain_covariance(objective, touches, angle_deg):
    """Covariance as the sum of noise, bend, scan and response."""
    late = CURVE.slope(angle_deg) * (np.arange(28) / 28 - 0.5) * (angle_deg - 10.0)
    covariance = (
        objective.combined.noise + CURVE.uncertainty(angle_deg, 10.0) + np.outer(late, late)
    )
    own = ONE.latent_changes(touches, angle_deg)
    size = 0.05**2 * np.sum(ONE(touches, angle_deg) ** 2, axis=0)
    return covariance + own.T @ own + np.diag(size)


def test_quadratic_is_that_of_the_plain_formula(objective):
    touches, angle = TWO + np.array([0.002, -0.003, 1.0]), 17.0
    at = objective.linearised(Unknowns(touches, angle))
    good = np.setdiff1d(np.arange(28), BAD)
    covariance = plain_covariance(objective, touches, angle)[np.ix_(good, good)]
    expected = np.linalg.inv(np.linalg.cholesky(covariance))
    whitening = objective.whitening(at)
    size = np.abs(expected).max()
    np.testing.assert_allclose(whitening[np.ix_(good, good)], expected, atol=1e-6 * size)
    assert np.abs(whitening[:, BAD]).max() < 2e-4 * size
    J = [ANGLE_UNIT * CURVE.slope(angle)]
    for touch in touches:
        for axis in range(3):
            step = 1e-5 * np.eye(3)[axis] * TOUCH_UNITS
            up, down = (ONE((touch + sign * step)[None], angle)[0] for sign in (1, -1))
            J.append((up - down) / 2e-5)
    J = expected @ np.array(J)[:, good].T
    r = expected @ residual(objective, at.unknowns)[good]
    mean, size = (
        0.5 * (TOUCH_PRIOR.low + TOUCH_PRIOR.high),
        (TOUCH_PRIOR.high - TOUCH_PRIOR.low) / np.sqrt(12.0),
    )
    mean[2], size[2] = TOUCH_PRIOR.force
    off = np.append((angle - 10.0) / 15.0, (touches - mean) / size)
    scale = np.append(ANGLE_UNIT / 15.0, np.tile(TOUCH_UNITS / size, 2))
    said = objective.quadratic(at, whitening)
    assert said.misfit == pytest.approx(r @ r + off @ off, rel=1e-6)
    gradient, hessian = J.T @ r - scale * off, J.T @ J + np.diag(scale**2)
    np.testing.assert_allclose(said.products[0, 1:], gradient, atol=1e-6 * np.abs(gradient).max())
    np.testing.assert_allclose(said.hessian, hessian, atol=1e-6 * np.abs(hessian).max())


def test_best_pairs_are_those_of_a_loop_over_all(objective, candidates):
    start = Unknowns(np.array([[0.012, 0.048, 3.0]]), 14.0)
    found = levenberg_marquardt(objective, objective.linearised(start), 0, 0.03)
    rest = [found.unknowns.without_touch(0), found.unknowns]
    said = pair_starts(found, [0, None], candidates)
    tried = candidates.places[::PAIR_STRIDE]
    shapes = found.whitening @ candidates.change[::PAIR_STRIDE].T
    for unknowns, (promise, pair) in zip(rest, said, strict=True):
        left, best = found.whitening @ residual(objective, unknowns), (np.inf, None)
        taken = unknowns.touches[:, :2]
        for i, j in combinations(range(len(tried)), 2):
            near = np.linalg.norm(taken - tried[[i, j], None], axis=-1) <= LEAST_DISTANCE * 0.030
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


def test_forces_are_the_least_squares_with_their_prior(objective):
    untouched = objective.linearised(Unknowns(np.zeros((0, 3)), 13.0))
    said = initial_touches(objective, TWO[:, :2], untouched).touches
    whitening = objective.whitening(untouched)
    mean, deviation = TOUCH_PRIOR.force
    unit = np.column_stack([TWO[:, :2], np.full(2, mean)])
    shapes = whitening @ ONE(unit, 13.0).T / mean
    A = np.vstack([shapes, np.eye(2) / deviation])
    b = np.concatenate(
        [whitening @ residual(objective, untouched.unknowns), np.full(2, mean / deviation)]
    )
    np.testing.assert_allclose(said[:, 2], np.linalg.lstsq(A, b, rcond=None)[0], rtol=1e-8)


def test_possible_faults_are_every_channel_and_every_contact():
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


def test_likeliest_fault_is_that_of_a_fit_of_each():
    rng = np.random.default_rng(1)
    possible, seen = possible_faults(PROTOCOL, FLAT), MEASUREMENTS.combined(np.ones(28), 1.0, 0.0)
    known, residual = rng.standard_normal((28, 4)), rng.standard_normal(28)
    gains = []
    for change in possible.changes.T:
        both = np.column_stack([known, change])
        without, beside = (
            np.sum((residual - A @ np.linalg.lstsq(A, residual, rcond=None)[0]) ** 2)
            for A in (known, both)
        )
        gains.append(without - beside)
    whole = np.append(residual, np.zeros(28))  # nothing remains
    fault, gain = possible.likeliest(seen, np.eye(28), 1.0, whole, known)
    assert fault is possible.faults[int(np.argmax(gains))]
    assert gain == pytest.approx(max(gains), rel=1e-9)
