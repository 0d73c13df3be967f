"""Parts of an adaptation to one sensor: width of its curve, scale of its standard errors."""

import numpy as np
import pytest
from smooth_joint import smooth_method

from eitskin.training.joint.adaptation import error_scale, widened
from eitskin.training.method.predictions import FoundTouches


def test_curves_of_strange_sensors_are_less_certain():
    curve = smooth_method().bend_prior.of([0.0])
    for features, factor in (([0.5, 0.5], 1.0), ([2.0, 2.0], 4.0), ([], 1.0)):
        wide = widened(curve, np.array(features))
        np.testing.assert_allclose(wide.covariance, factor * curve.covariance)


def test_the_scale_of_standard_errors_is_the_rms_of_their_ratios():
    touches = np.array([[[0.05, 0.03, 8.0]], [[0.10, 0.03, np.nan]], [[0.02, 0.02, 5.0]]])
    found = [
        FoundTouches.of([[0.053, 0.034]], [1.0], None, [0.001]),  # 5 mm, five standard errors
        FoundTouches.of([[0.10, 0.028]], [1.0], None, [0.001]),  # two
        FoundTouches.of([[0.10, 0.028]], [1.0], None, [0.001]),  # another touch
    ]
    assert error_scale(touches, found) == pytest.approx(np.sqrt((4 + 25 + 4) / (4 + 2)))
