"""Figures of merit of drawn pictures, whose values are known."""

import numpy as np
import pytest

from eitskin.errors import DataError
from eitskin.geometry.design.outline import Disc
from eitskin.training.reconstruction.pixel_grid import PixelGrid, figures_of_merit

GRID = PixelGrid.of(Disc(0.1), 10_000)
CENTRE, RADIUS = (0.13, 0.09), 0.02
INTEGRAL = np.pi * RADIUS**2


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_disc_at_its_place(sign):
    found = figures_of_merit(sign * GRID.discs([CENTRE], RADIUS)[0], GRID, CENTRE, sign * INTEGRAL)
    assert found.amplitude == pytest.approx(1.0, rel=0.01)
    assert found.position_error < 1e-4
    assert found.resolution == pytest.approx(0.2, rel=0.03)
    assert found.shape_deformation < 0.02
    assert found.ringing == 0.0


def test_disc_that_is_moved_and_halved():
    values = 0.5 * GRID.discs([(0.10, 0.13)], RADIUS)[0]
    found = figures_of_merit(values, GRID, CENTRE, INTEGRAL)
    assert found.amplitude == pytest.approx(0.5, rel=0.01)
    assert found.shift == pytest.approx((-0.03, 0.04), abs=2e-4)
    assert found.position_error == pytest.approx(0.05, abs=2e-4)


def test_square_sticks_out_of_its_circle():
    """A square of side a and the circle of its area: 4 (r^2 acos(a/2r) - a/2 sqrt(..)) outside."""
    side = 0.08
    away = np.abs(GRID.centres - 0.1)
    a, r = side, side / np.sqrt(np.pi)
    segment = r**2 * np.arccos(a / (2 * r)) - a / 2 * np.sqrt(r**2 - a**2 / 4)
    found = figures_of_merit((away <= side / 2).all(axis=1), GRID, (0.1, 0.1), side**2)
    assert found.shape_deformation == pytest.approx(4 * segment / a**2, abs=0.01)


def test_ring_of_the_wrong_sign():
    away = np.linalg.norm(GRID.centres - CENTRE, axis=1)
    values = np.where(away <= RADIUS, 1.0, np.where(away <= 1.5 * RADIUS, -0.2, 0.0))
    found = figures_of_merit(values, GRID, CENTRE, INTEGRAL)
    assert found.ringing == pytest.approx(0.2 * 1.25, rel=0.05)


def test_picture_of_nothing_is_refused():
    with pytest.raises(DataError, match="got none"):
        figures_of_merit(np.zeros(len(GRID)), GRID, CENTRE, INTEGRAL)
