"""Bad measurements and contacts: left out, told, and no touches."""

import numpy as np
import pytest
from one_frame import TOUCHES, changed, explained, frame, misfit_sigma

from smooth_sensor import FLAT, PROTOCOL


@pytest.mark.parametrize(
    ("count", "size", "told"),
    [
        *((0, size, True) for size in (0.003, 0.02, -0.05)),
        (1, 0.005, True),
        *((1, size, False) for size in (0.02, -0.05, 0.3)),
    ],
)
def test_one_wrong_channel_is_told_and_is_no_touch(count, size, told):
    """Beside a touch, a large fault is named, or the frame's misfit is reported."""
    rng = np.random.default_rng(9)
    for channel in (0, 9, 17):
        objective = frame(TOUCHES.get(count, ()), 0.0, 0.0, rng)
        change = objective.combined.change.copy()
        change[channel] += size
        found = explained(changed(objective, change))
        assert found.faults or misfit_sigma(found) > 6.0
        if told:
            assert [fault.members for fault in found.faults] == [(channel,)]
            assert PROTOCOL.labels[channel] in found.faults[0].name
            assert len(found.touches) == count


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


def test_frame_that_nothing_explains_has_a_misfit_that_tells():
    rng = np.random.default_rng(10)
    for size in (0.003, 0.01, 0.05):
        objective = changed(frame(), size * rng.standard_normal(28))
        found = explained(objective)
        assert misfit_sigma(found) > 6.0
        assert np.isfinite(found.covariance).all()
        assert (np.diagonal(found.covariance, axis1=1, axis2=2) > 0).all()


def test_any_common_factor_is_survived():
    """A common change of a few percent, as of a reference of another day, is tolerated."""
    for factor in (0.01, 0.1, -0.1, 1.0, -0.7):
        found = explained(changed(frame(TOUCHES[1]), frame(TOUCHES[1]).combined.change + factor))
        assert np.isfinite(found.angle_deg)
        assert np.isfinite(found.covariance).all()
        assert misfit_sigma(found) > 6.0
