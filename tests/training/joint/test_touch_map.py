"""Touch maps: discs blurred by the standard errors of positions."""

import numpy as np
import pytest
from scipy.stats import norm

from eitskin.training.joint.frame_predictions import disc_map

SIZE, RADIUS = (0.150, 0.060), 0.0075
FINE = (240, 600)  # pixels of 0.25 mm


def drawn(places, deviations, shape=FINE):
    return disc_map(np.array(places), np.array(deviations), RADIUS, SIZE, shape)


def area(map_):
    return float(map_.sum()) * SIZE[0] * SIZE[1] / map_.size


def test_sharp_disc_has_its_area_and_place():
    map_ = drawn([[0.050, 0.020]], [0.0])
    assert map_.dtype == np.float32
    assert np.mean((map_ > 0.0) & (map_ < 1.0)) < 1e-3
    assert area(map_) == pytest.approx(np.pi * RADIUS**2, rel=0.01)
    rows, columns = np.nonzero(map_)
    assert (columns.mean() + 0.5) * 0.25e-3 == pytest.approx(0.050, abs=1e-4)
    assert (rows.mean() + 0.5) * 0.25e-3 == pytest.approx(0.020, abs=1e-4)


def test_edge_is_blurred_by_the_standard_error():
    """Profile through the centre: 0.5 at the edge, the normal distribution about it."""
    map_ = drawn([[0.075, 0.030125]], [0.001])
    x = (np.arange(600) + 0.5) * 0.25e-3
    expected = norm.cdf((RADIUS - np.abs(x - 0.075)) / 0.001)
    np.testing.assert_allclose(map_[120], expected, atol=1e-5)
    # To second order a blurred disc's area is pi (R^2 + s^2): the mean of pi (R + s n)^2.
    assert area(map_) == pytest.approx(np.pi * (RADIUS**2 + 0.001**2), rel=0.005)


@pytest.mark.parametrize("deviation", [0.0, 4e-4, 0.003, 0.02])
def test_map_is_that_of_the_plain_formula(deviation):
    """Skipping pixels far from a touch changes nothing, also at the sensor's rim."""
    shape = (32, 80)
    x, y = (np.arange(80) + 0.5) * SIZE[0] / 80, (np.arange(32) + 0.5) * SIZE[1] / 32
    places = [[0.002, 0.058], [0.075, 0.030], [0.090, 0.031]]
    free = np.ones(shape)
    for px, py in places:
        away = np.sqrt((x - px) ** 2 + (y[:, None] - py) ** 2)
        free *= norm.sf((RADIUS - away) / max(deviation, 1e-6))
    said = drawn(places, [deviation] * 3, shape)
    np.testing.assert_allclose(said, 1.0 - free, atol=1e-7)


def test_no_touch_is_an_empty_map_of_the_shape_asked_for():
    empty = disc_map(np.zeros((0, 2)), np.zeros(0), RADIUS, SIZE, (32, 80))
    assert empty.shape == (32, 80)
    assert not empty.any()
