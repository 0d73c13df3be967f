"""Drift: a random walk that is a function of time."""

import numpy as np
import pytest

from eitskin.simulator.instrument.drift import DRIFT_TIME, RandomWalk


def test_a_walk_has_its_deviation_after_4_h_and_grows_as_the_root_of_time():
    times = DRIFT_TIME * np.array([1 / 64, 1 / 16, 1 / 4, 1.0])
    walks = np.array([RandomWalk(0.002, seed)(times) for seed in range(4000)])
    # Four standard errors of a standard deviation of 4,000 values are 4.5 %.
    np.testing.assert_allclose(walks.std(axis=0), 0.002 * np.sqrt(times / DRIFT_TIME), rtol=0.045)
    steps = np.diff(walks, axis=1)
    assert np.abs(np.corrcoef(steps.T) - np.eye(3)).max() < 0.064


def test_a_walk_is_a_function_of_time_however_it_is_asked():
    walk = RandomWalk(0.002, 7)
    times = np.array([0.0, 3.0, 10.0, 7000.0, 14400.0])
    together = walk(times)
    assert together[0] == 0.0
    assert together[1] == pytest.approx(0.3 * together[2])
    one_by_one = [walk(np.array([time]))[0] for time in times[::-1]]
    np.testing.assert_array_equal(one_by_one[::-1], together)
    assert walk(np.zeros(0)).shape == (0,)
