"""Standard errors of places: scales by known touches, and the picture that checks copies."""

import numpy as np
import pytest
from scipy.stats import norm

from eitskin.errors import DataError
from eitskin.training.joint.frame_predictions import (
    STRANGEST,
    ErrorScale,
    disc_map,
    own_error_scale,
)
from eitskin.training.method.predictions import FoundTouches


def test_the_scale_of_one_sensor_is_the_rms_of_its_ratios():
    touches = np.array([[[0.05, 0.03, 8.0]], [[0.10, 0.03, np.nan]], [[0.02, 0.02, 5.0]]])
    found = [
        FoundTouches.from_arrays(
            [[0.053, 0.034]], [1.0], None, [0.001]
        ),  # 5 mm, five standard errors
        FoundTouches.from_arrays([[0.10, 0.028]], [1.0], None, [0.001]),  # two
        FoundTouches.from_arrays([[0.10, 0.028]], [1.0], None, [0.001]),  # another touch
    ]
    assert own_error_scale(touches, found) == pytest.approx(np.sqrt((4 + 25 + 4) / (4 + 2)))


def many(scale: ErrorScale, count: int = 4000):
    """Touches with normal errors of 1 mm along each axis, times the scale of their sensors."""
    rng = np.random.default_rng(3)
    features = rng.standard_normal((count, 2)) * rng.uniform(0.2, 2.0, (count, 1))
    touches = np.tile([[0.07, 0.03]], (count, 1, 1))
    factors = np.array([scale.evaluate(p) for p in features])[:, None]
    places = touches[:, 0] + 1e-3 * factors * rng.standard_normal((count, 2))
    spread = [np.sqrt(2.0) * 1e-3]
    found = [FoundTouches.from_arrays(place[None], [1.0], None, spread) for place in places]
    return touches, found, features


@pytest.mark.parametrize(
    "scale", [ErrorScale(1.5, 0.5), ErrorScale(0.6, 0.0), ErrorScale(1.0, 3.0)]
)
def test_the_scale_of_strange_sensors_is_found_again(scale):
    learned = ErrorScale.fit(*many(scale))
    # Standard errors of both are 3 to 6 %: squares of normal errors in two dimensions scatter by
    # their mean.
    assert learned.usual == pytest.approx(scale.usual, rel=0.1, abs=0.05)
    assert learned.strange == pytest.approx(scale.strange, rel=0.2, abs=0.05)
    for features, square in (([0.5, 0.5], 0.25), ([3.0, 1.0], STRANGEST)):
        expected = np.sqrt(learned.usual + square * learned.strange)
        assert learned.evaluate(np.array(features)) == pytest.approx(expected)


def test_a_scale_is_stored_as_its_terms_or_as_that_of_all_sensors():
    assert ErrorScale.from_stored(np.array([3.0, 0.5])) == ErrorScale(3.0, 0.5)
    assert ErrorScale.from_stored(np.array(2.0)).evaluate(np.array([1.5])) == 2.0
    for wrong in ([1.0, np.nan], [1.0, -1.0], [1.0, 1.0, 1.0]):
        with pytest.raises(DataError, match="standard errors"):
            ErrorScale.from_stored(np.array(wrong))


SIZE, RADIUS = (0.150, 0.060), 0.0075
FINE = (240, 600)  # pixels of 0.25 mm


def drawn(places, deviations, shape=FINE):
    return disc_map(np.array(places), np.array(deviations), RADIUS, SIZE, shape)


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
