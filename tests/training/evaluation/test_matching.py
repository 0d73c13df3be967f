"""Matching of touches: pairs, misses and false touches."""

import numpy as np
import pytest

from eitskin.training.evaluation.scores import GATE, match, match_distances, ospa


def test_matching_minimises_the_total_distance_not_the_nearest_first():
    true = [(0.010, 0.0), (0.020, 0.0)]
    found = [(0.0145, 0.0), (0.005, 0.0)]  # the nearest pair first: 4.5 mm, then 15 mm beyond gate
    assert sorted(match_distances(true, found)) == pytest.approx([0.005, 0.0055])


def test_as_many_pairs_as_there_can_be():
    """The smallest total alone would be one pair of 0 mm, the other beyond the gate."""
    true, found = [(0.0, 0.0), (0.014, 0.0)], [(0.014, 0.0), (0.014, 0.0145)]
    assert match_distances(true, found) == pytest.approx([0.014, 0.0145])


def test_matched_rows_belong_together():
    true = [(0.0, 0.0), (0.1, 0.0), (0.05, 0.0)]
    rows, columns = match(true, [(0.052, 0.0), (0.001, 0.0)])
    assert dict(zip(rows.tolist(), columns.tolist(), strict=True)) == {0: 1, 2: 0}
    assert [len(each) for each in match(true, np.zeros((0, 2)))] == [0, 0]


@pytest.mark.parametrize(("distance", "pairs"), [(0.0149, 1), (0.0151, 0), (0.029, 0)])
def test_nothing_is_matched_beyond_the_gate(distance, pairs):
    assert len(match_distances([(0.05, 0.03)], [(0.05 + distance, 0.03)], gate=0.015)) == pairs


@pytest.mark.parametrize(
    ("true", "found", "distances"),
    [
        ([(0.03, 0.03), (0.10, 0.03)], [(0.031, 0.03)], [0.001]),
        ([(0.05, 0.03)], [(0.05, 0.03 + GATE * 1.01), (0.05, 0.03 - GATE * 0.99)], [GATE * 0.99]),
        (np.zeros((0, 2)), [(0.01, 0.01)], []),
        ([(0.02, 0.02)], [], []),
    ],
)
def test_misses_and_false_touches_have_no_partner(true, found, distances):
    assert match_distances(true, found) == pytest.approx(distances)


def test_ospa_distance_counts_misses_and_false_touches_as_the_cutoff():
    true = [(0.0, 0.0), (0.1, 0.0)]
    assert ospa([], []) == 0.0
    assert ospa(true, true[::-1]) == 0.0
    assert ospa(true, [(0.004, 0.0)]) == pytest.approx((0.004 + 0.015) / 2)
    assert ospa([], true) == pytest.approx(0.015)
    assert ospa(true, [(0.05, 0.0), (0.101, 0.0)], cutoff=0.02) == pytest.approx(0.021 / 2)
