"""Matching of touches, and definitions of the figures that are reported."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from eitskin.training.evaluation.scores import (
    GATE,
    consistency,
    determination,
    match_distances,
    ospa,
    root_mean_square,
    similarity,
)


@pytest.mark.parametrize(
    ("true", "found", "distances"),
    [
        # The nearest pair first would leave one 15 mm apart, beyond the gate.
        ([(0.010, 0.0), (0.020, 0.0)], [(0.0145, 0.0), (0.005, 0.0)], [0.005, 0.0055]),
        # The smallest total alone would be one pair of 0 mm.
        ([(0.0, 0.0), (0.014, 0.0)], [(0.014, 0.0), (0.014, 0.0145)], [0.014, 0.0145]),
        ([(0.03, 0.03), (0.10, 0.03)], [(0.031, 0.03)], [0.001]),
        ([(0.05, 0.03)], [(0.05, 0.03 + GATE * 1.01), (0.05, 0.03 - GATE * 0.99)], [GATE * 0.99]),
        ([(0.05, 0.03)], [(0.05 + 1.9 * GATE, 0.03)], []),
        (np.zeros((0, 2)), [(0.01, 0.01)], []),
        ([(0.02, 0.02)], [], []),
    ],
)
def test_pairs_are_as_many_as_can_be_and_then_the_nearest(true, found, distances):
    assert sorted(match_distances(true, found)) == pytest.approx(distances)


places = st.lists(st.tuples(*[st.floats(0, 0.1)] * 2), max_size=5)


@given(true=places, found=places)
def test_ospa_distance_is_a_capped_assignment_with_misses_at_the_cutoff(true, found):
    a, b = (np.reshape(each, (-1, 2)) for each in (true, found))
    away = np.minimum(np.linalg.norm(a[:, None] - b[None], axis=2), 0.02)
    total = away[linear_sum_assignment(away)].sum() + 0.02 * abs(len(a) - len(b))
    assert ospa(true, found, 0.02) == pytest.approx(total / max(len(a), len(b), 1))
    assert ospa(found, true, 0.02) == pytest.approx(ospa(true, found, 0.02))


def test_similarity():
    truth = np.zeros((32, 80))
    truth[10:18, 30:38] = 1.0
    assert similarity(truth * 0.2, truth) == pytest.approx(1.0)
    assert similarity(truth - 5.0 * (truth == 0), truth) == pytest.approx(1.0)
    assert similarity(np.roll(truth, 3), truth) < 0.95
    assert similarity(np.zeros_like(truth), truth) < 0.95


def test_angles():
    true = np.array([-20.0, 0.0, 50.0])
    assert determination(true, true) == 1.0
    assert determination(true, np.full(3, true.mean())) == pytest.approx(0.0)
    assert determination(np.ones(3), true) is None
    assert root_mean_square([3.0, -4.0]) == pytest.approx(np.sqrt(12.5))


def test_consistency_compares_errors_with_their_standard_errors():
    """Places in the plane: sqrt(var x + var y) is the rms distance; 1 - exp(-1) lie within it."""
    nan = float("nan")
    found = consistency([3.0, -1.0, 100.0, 5.0, nan], [2.0, 2.0, nan, 0.0, 1.0])
    assert (found.count, found.within_one) == (2, 0.5)
    assert found.rms_ratio == pytest.approx(np.sqrt((1.5**2 + 0.5**2) / 2))
    assert consistency([1.0], [nan]) is consistency([], []) is None
    x, y = np.random.default_rng(0).normal(size=(2, 100_000)) * 1.5
    found = consistency(np.hypot(x, y), np.full(100_000, 1.5 * np.sqrt(2)))
    assert found.rms_ratio == pytest.approx(1.0, abs=0.01)
    assert found.within_one == pytest.approx(1 - np.exp(-1), abs=0.01)
