"""Total variation against a closed form, and its decrease."""

import numpy as np
import pytest

from eitskin.geometry.design.outline import Rectangle
from eitskin.training.reconstruction.picture_methods import TotalVariation
from eitskin.training.reconstruction.pixel_grid import PixelGrid


def test_step_of_one_dimension_has_its_closed_form():
    """min |x - y|^2 / 2 + alpha TV(x): both plateaus move by alpha over their lengths."""
    grid = PixelGrid(Rectangle(0.04, 0.001), (1, 40))
    y = np.where(np.arange(40) < 10, 1.0, 3.0)
    alpha = 2.0
    misfit = alpha * np.sqrt(1 / 10 + 1 / 30)
    found = TotalVariation(grid, np.eye(40)).picture(y, misfit)
    expected = np.where(np.arange(40) < 10, 1.0 + alpha / 10, 3.0 - alpha / 30)
    assert found == pytest.approx(expected, abs=0.1)  # corners are rounded a little
    assert found[[0, -1]] == pytest.approx(expected[[0, -1]], abs=0.015)


def test_total_variation_falls_at_the_same_misfit():
    grid = PixelGrid.of(Rectangle(0.1, 0.1), 225)
    J = np.random.default_rng(0).normal(size=(60, 225))
    truth = grid.discs([(0.04, 0.06)], 0.02)[0]
    y = J @ truth + 0.1 * np.random.default_rng(1).normal(size=60)
    varied, history = TotalVariation(grid, J), []
    picture = varied.picture(y, 0.8, history)
    assert len(history) > 3
    assert (np.diff(history) <= 1e-6 * history[0]).all()
    assert np.linalg.norm(y - J @ picture) == pytest.approx(0.8, rel=1e-3)
    # Edges come back that no smooth picture has, of a quarter as many data as pixels.
    assert np.abs(picture - truth).mean() < 0.02


def test_data_within_the_misfit_need_no_change():
    grid = PixelGrid.of(Rectangle(0.1, 0.1), 25)
    assert not TotalVariation(grid, np.eye(25)).picture(np.full(25, 0.1), 1.0).any()
