"""Predictions of a method: touches as arrays and one by one."""

import copy

from eitskin.training import FoundTouches


def test_a_touch_unpacks_as_three_and_knows_five():
    found = FoundTouches.of([[0.1, 0.2], [0.3, 0.4]], [0.5, 0.9], [7.0, 8.0], [1e-3, 2e-3])
    first, second = found
    x, y, strength = first
    assert (x, y, strength) == first == (0.3, 0.4, 0.9)
    assert (first.force, first.deviation, len(first)) == (8.0, 2e-3, 3)
    assert copy.copy(second).force == 7.0
