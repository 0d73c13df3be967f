"""Parts of an adaptation to one sensor: width of its curve."""

import numpy as np
from smooth_joint import smooth_method

from eitskin.training.joint.adaptation import widened


def test_curves_of_strange_sensors_are_less_certain():
    curve = smooth_method().bend_prior.of([0.0])
    for features, factor in (([0.5, 0.5], 1.0), ([2.0, 2.0], 4.0), ([], 1.0)):
        wide = widened(curve, np.array(features))
        np.testing.assert_allclose(wide.covariance, factor * curve.covariance)
