"""Pixels of rectangles, discs and polygons."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Disc, Polygon, Rectangle
from eitskin.training.reconstruction.pixel_grid import PixelGrid

L_SHAPE = Polygon(((0, 0), (0.12, 0), (0.12, 0.05), (0.06, 0.05), (0.06, 0.1), (0, 0.1)))


def test_reference_sensor_has_squares_of_two_millimetres():
    grid = PixelGrid.of(Rectangle(0.150, 0.060))
    assert grid.shape == (30, 75)
    assert len(grid) == 2250
    assert grid.sides == pytest.approx((2e-3, 2e-3))
    assert (grid.x[0], grid.y[-1]) == pytest.approx((1e-3, 59e-3))


@pytest.mark.parametrize(("outline", "area"), [(Disc(0.05), np.pi * 0.05**2), (L_SHAPE, 0.009)])
def test_mask_has_the_area_of_the_outline(outline, area):
    grid = PixelGrid.of(outline, 4000)
    assert len(grid) * grid.area == pytest.approx(area, rel=0.02)
    picture = grid.image(np.arange(len(grid)))
    assert np.isnan(picture).sum() == picture.size - len(grid)
    assert (picture[grid.inside] == np.arange(len(grid))).all()


def test_cut_pixels_add_to_their_nearest_ones():
    grid = PixelGrid.of(Disc(0.05), 400)
    values = np.random.default_rng(0).normal(size=(3, 400))
    gathered = grid.gathered(values)
    assert gathered.sum(axis=1) == pytest.approx(values.sum(axis=1))
    deep = Disc(0.05).contains(grid.centres, margin=0.015)
    assert (gathered[:, deep] == values[:, grid.inside.ravel()][:, deep]).all()


def test_differences_of_a_slope_are_its_gradient_and_none_crosses_the_rim():
    grid = PixelGrid.of(L_SHAPE, 300)
    x, y = grid.centres.T
    along_x, along_y = (grid.differences @ (3.0 * x - 2.0 * y)).reshape(2, -1)
    for values, expected in ((along_x, 3.0 * grid.sides[0]), (along_y, -2.0 * grid.sides[1])):
        assert values[values != 0.0] == pytest.approx(expected)
    assert (along_x == 0.0).sum() == grid.shape[0]  # the last pixel of every row


def test_discs_have_their_area():
    grid = PixelGrid.of(Rectangle(0.150, 0.060))
    for radius in (0.004, 0.0075, 0.02):
        shares = grid.discs([(0.0731, 0.0302), (0.075, 0.030)], radius)
        assert shares.sum(axis=1) * grid.area == pytest.approx(np.pi * radius**2, rel=0.05)


def test_numbers_of_pixels_out_of_range_are_refused():
    with pytest.raises(ConfigurationError, match="got 3"):
        PixelGrid.of(Disc(0.05), 3)
