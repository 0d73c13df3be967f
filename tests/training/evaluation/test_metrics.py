"""Definitions of the figures that are reported."""

import numpy as np
import pytest

from eitskin.training.evaluation.metrics import (
    GATE,
    calibration,
    confusion,
    determination,
    localisation,
    match,
    match_distances,
    percentiles,
    root_mean_square,
    similarity,
)


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
    found = localisation([([(0.05, 0.03)], [(0.05 + distance, 0.03)])], gate=0.015)
    assert (len(found.errors), found.missed, found.false) == (pairs, 1 - pairs, 1 - pairs)


def test_misses_and_false_touches_are_counted_apart():
    frames = [
        ([(0.03, 0.03), (0.10, 0.03)], [(0.031, 0.03)]),
        ([(0.05, 0.03)], [(0.05, 0.03 + GATE * 1.01), (0.05, 0.03 - GATE * 0.99)]),
        (np.zeros((0, 2)), [(0.01, 0.01)]),
        ([(0.02, 0.02)], []),
    ]
    score = localisation(frames)
    assert score.errors == pytest.approx((0.001, GATE * 0.99))
    assert (score.true, score.missed, score.false) == (4, 2, 2)


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


def test_confusion_has_the_truth_in_rows():
    counts = confusion([0, 0, 1, 2, 2], [0, 1, 1, 0, 2])
    assert counts.tolist() == [[1, 1, 0], [0, 1, 0], [1, 0, 1]]


def test_percentiles():
    assert percentiles(list(range(101))) == (50.0, 99.0)


def test_calibration_compares_errors_with_what_was_stated():
    nan = float("nan")
    found = calibration([3.0, -1.0, 100.0, 5.0, nan], [2.0, 2.0, nan, 0.0, 1.0])
    assert found.count == 2
    assert found.rms_ratio == pytest.approx(np.sqrt((1.5**2 + 0.5**2) / 2))
    assert found.within_one == 0.5
    assert calibration([1.0], [nan]) is None
    assert calibration([], []) is None


def test_true_standard_errors_are_found_calibrated():
    """Places in the plane: sqrt(var x + var y) is the rms distance; 1 - exp(-1) lie within it."""
    x, y = np.random.default_rng(0).normal(size=(2, 100_000)) * 1.5
    found = calibration(np.hypot(x, y), np.full(100_000, 1.5 * np.sqrt(2)))
    assert found.rms_ratio == pytest.approx(1.0, abs=0.01)
    assert found.within_one == pytest.approx(1 - np.exp(-1), abs=0.01)
