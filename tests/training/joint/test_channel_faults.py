"""Bad measurements and contacts: left out, told, and no touches."""

from dataclasses import replace

import numpy as np
import pytest
from one_frame import TOUCHES, changed, explained, frame
from scipy.stats import multivariate_normal

from eitskin.training.joint.channel_faults import FAULT_PRICE, FAULT_SIZE, possible_faults

from smooth_sensor import FLAT, PROTOCOL


@pytest.mark.parametrize(("count", "share"), [(0, 0.001), (0, 0.01), (1, 0.002)])
def test_contact_that_changed_is_told_and_is_no_touch(share, count):
    """A series resistance of a few ohm at one electrode resembles a touch beside it."""
    rng = np.random.default_rng(11)
    for electrode in (0, 3, 5):
        through = np.array([electrode in row[:2] for row in PROTOCOL.table])
        objective = frame(TOUCHES.get(count, ()), 0.0, 0.0, rng)
        found = explained(
            changed(objective, objective.combined.change + share * np.median(FLAT) / FLAT * through)
        )
        assert len(found.touches) == count
        (fault,) = found.faults
        assert fault.name == f"the contact of electrode {electrode} has changed"
        assert fault.members == tuple(np.flatnonzero(through))


def test_touches_near_electrodes_are_no_faults():
    rng = np.random.default_rng(12)
    for x, y in ((0.0225, 0.010), (0.075, 0.012), (0.140, 0.030)):
        found = explained(frame([[x, y, 8.0]], 0.0, 0.0, rng, mismatch=0.05))
        assert len(found.touches) == 1
        assert found.faults == ()


def test_faults_are_weighed_by_their_density():
    """Against the normal density with the faults' covariance, the best of all sets by hand."""
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
        log = multivariate_normal(np.zeros(28), covariance).logpdf(measured)
        expected = -2.0 * log - 28 * np.log(2.0 * np.pi) + FAULT_PRICE * len(numbers)
        assert faulty.improbability == pytest.approx(expected, rel=1e-6)
        assert np.abs(faulty.rest.measured).max() < 0.3 * np.abs(measured).max()
