"""Definitions of the figures that are reported."""

import numpy as np
import pytest

from eitskin.training.evaluation.scores import (
    consistency,
    determination,
    root_mean_square,
    similarity,
)


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


def test_consistency_compares_errors_with_what_was_stated():
    nan = float("nan")
    found = consistency([3.0, -1.0, 100.0, 5.0, nan], [2.0, 2.0, nan, 0.0, 1.0])
    assert found.count == 2
    assert found.rms_ratio == pytest.approx(np.sqrt((1.5**2 + 0.5**2) / 2))
    assert found.within_one == 0.5
    assert consistency([1.0], [nan]) is None
    assert consistency([], []) is None


def test_true_standard_errors_are_consistent():
    """Places in the plane: sqrt(var x + var y) is the rms distance; 1 - exp(-1) lie within it."""
    x, y = np.random.default_rng(0).normal(size=(2, 100_000)) * 1.5
    found = consistency(np.hypot(x, y), np.full(100_000, 1.5 * np.sqrt(2)))
    assert found.rms_ratio == pytest.approx(1.0, abs=0.01)
    assert found.within_one == pytest.approx(1 - np.exp(-1), abs=0.01)
