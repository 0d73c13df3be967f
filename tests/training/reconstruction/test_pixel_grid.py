"""Pixels of rectangles, discs and polygons."""

import numpy as np
import pytest

from eitskin.errors import DataError
from eitskin.geometry.design.outline import Disc, Polygon, Rectangle
from eitskin.training.reconstruction.pixel_grid import PixelGrid, figures_of_merit

L_SHAPE = Polygon(((0, 0), (0.12, 0), (0.12, 0.05), (0.06, 0.05), (0.06, 0.1), (0, 0.1)))


def test_reference_sensor_has_squares_of_two_millimetres():
    grid = PixelGrid.from_outline(Rectangle(0.150, 0.060))
    assert grid.shape == (30, 75)
    assert len(grid) == 2250
    assert grid.sides == pytest.approx((2e-3, 2e-3))
    assert (grid.x[0], grid.y[-1]) == pytest.approx((1e-3, 59e-3))


@pytest.mark.parametrize(("outline", "area"), [(Disc(0.05), np.pi * 0.05**2), (L_SHAPE, 0.009)])
def test_mask_has_the_area_of_the_outline(outline, area):
    grid = PixelGrid.from_outline(outline, 4000)
    assert len(grid) * grid.area == pytest.approx(area, rel=0.02)
    picture = grid.image(np.arange(len(grid)))
    assert np.isnan(picture).sum() == picture.size - len(grid)
    assert (picture[grid.inside] == np.arange(len(grid))).all()


def test_differences_of_a_slope_are_its_gradient_and_none_crosses_the_rim():
    grid = PixelGrid.from_outline(L_SHAPE, 300)
    x, y = grid.centres.T
    along_x, along_y = (grid.differences @ (3.0 * x - 2.0 * y)).reshape(2, -1)
    for values, expected in ((along_x, 3.0 * grid.sides[0]), (along_y, -2.0 * grid.sides[1])):
        assert values[values != 0.0] == pytest.approx(expected)
    assert (along_x == 0.0).sum() == grid.shape[0]  # the last pixel of every row


# ---- figures of merit ----


DISC = PixelGrid.from_outline(Disc(0.1), 10_000)
CENTRE, RADIUS = (0.13, 0.09), 0.02
INTEGRAL = np.pi * RADIUS**2


def test_square_sticks_out_of_its_circle():
    """A square of side a and the circle of its area: 4 (r^2 acos(a/2r) - a/2 sqrt(..)) outside."""
    side = 0.08
    away = np.abs(DISC.centres - 0.1)
    a, r = side, side / np.sqrt(np.pi)
    segment = r**2 * np.arccos(a / (2 * r)) - a / 2 * np.sqrt(r**2 - a**2 / 4)
    found = figures_of_merit((away <= side / 2).all(axis=1), DISC, (0.1, 0.1), side**2)
    assert found.shape_deformation == pytest.approx(4 * segment / a**2, abs=0.01)


def test_picture_of_nothing_is_refused():
    with pytest.raises(DataError, match="got none"):
        figures_of_merit(np.zeros(len(DISC)), DISC, CENTRE, INTEGRAL)
