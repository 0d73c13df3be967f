"""Scores of regions of targets in a tank, and its folder."""

import numpy as np
import pytest

from eitskin.benchmarks.tank_targets import read_targets, score, similarity
from eitskin.errors import DataError


@pytest.mark.slow
def test_scores_are_one_for_the_truth_and_near_nothing_for_other_regions():
    truth = np.zeros((256, 256), np.int8)
    truth[60:110, 60:110], truth[150:200, 150:200] = -1, 1
    assert score(truth, truth) == pytest.approx(1.0)
    assert score(truth, truth[::2, ::2]) == pytest.approx(1.0)
    assert score(truth, -truth) < 0.2


def test_similarity_is_that_of_its_definition():
    """Mean over pixels of the ratio by Wang et al. 2004, with sums written out."""
    rng = np.random.default_rng(0)
    first, second = rng.random((2, 24, 24)) > 0.6
    x, y = np.indices((24, 24)).reshape(2, -1)
    away = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    window = np.exp(-0.5 * away / 80.0**2)
    window /= window.sum(axis=1, keepdims=True)
    a, b = first.ravel().astype(float), second.ravel().astype(float)
    mean_a, mean_b = window @ a, window @ b
    cross, own = window @ (a * b) - mean_a * mean_b, window @ a - mean_a**2 + window @ b - mean_b**2
    ratio = (2 * mean_a * mean_b + 1e-4) * (2 * cross + 9e-4)
    ratio /= (mean_a**2 + mean_b**2 + 1e-4) * (own + 9e-4)
    assert similarity(first, second) == pytest.approx(ratio.mean())


def test_a_folder_without_the_challenge_is_refused(tmp_path):
    with pytest.raises(DataError, match="Kuopio Tomography Challenge 2023"):
        read_targets(tmp_path, quick=True)
