"""Board time by this machine's clock: made-up clocks whose difference is known."""

import dataclasses
import math

import numpy as np
import pytest

from eitskin.hardware.live import DRIFT, AcquisitionClock
from eitskin.simulator import Frame, Protocol

PROTOCOL = Protocol.pairwise(8)
PERIOD, DURATION = 0.3, 0.28


def frame(number, **changes):
    known = {"time": PERIOD * number, "number": number, "duration": DURATION} | changes
    return Frame(np.full(28, 600.0), PROTOCOL, **known)


def arrivals(count, drift=0.0, offset=1000.0, shortest=0.002):
    """When each measurement began and when its frame came, by the host's clock."""
    late = np.random.default_rng(0).exponential(0.004, count)
    late[0] = 0.0
    begun = offset + (1.0 + drift) * PERIOD * np.arange(count)
    return begun, begun + DURATION * (1.0 + drift) + shortest + late


def test_begin_is_known_but_for_the_shortest_time_on_the_line():
    clock = AcquisitionClock()
    begun, came = arrivals(200)
    found = [clock.begun(frame(k), at) for k, at in enumerate(came)]
    assert found == pytest.approx(begun + 0.002, abs=1e-9 + 200 * PERIOD * DRIFT)
    assert found[0] == pytest.approx(begun[0] + 0.002, abs=1e-9)


@pytest.mark.parametrize("drift", [-5e-5, 5e-5])
def test_clocks_that_drift_apart_are_followed_for_hours(drift):
    clock = AcquisitionClock()
    begun, came = arrivals(20_000, drift)
    one = frame(0)
    found = [
        clock.begun(dataclasses.replace(one, time=PERIOD * k), at) for k, at in enumerate(came)
    ]
    assert np.abs(found - begun - 0.002).max() < 0.003  # 100 minutes apart by 0.3 s


def test_another_session_has_another_clock():
    clock = AcquisitionClock()
    assert clock.begun(frame(0, time=100.0), 5.0) == pytest.approx(5.0 - DURATION)
    assert clock.begun(frame(0, time=7000.0, session=2), 6.0) == pytest.approx(6.0 - DURATION)
    # A board that counts its time anew without saying so.
    assert clock.begun(frame(0, time=1.0, session=2), 9.0) == pytest.approx(9.0 - DURATION)


def test_without_a_duration_nothing_is_known():
    assert math.isnan(AcquisitionClock().begun(frame(0, duration=math.nan), 5.0))
