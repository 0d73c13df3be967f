"""Joint method whose model is exactly that of the sensor in `smooth_sensor`."""

import numpy as np

from eitskin.training.joint.combinations import SpecimenFeatures
from eitskin.training.joint.method import JointMethod
from eitskin.training.joint.networks import ProposalNetwork
from eitskin.training.method.input_spec import mirrors

from smooth_sensor import (
    FLAT,
    LAYOUT,
    MEASUREMENTS,
    PROTOCOL,
    SIZE,
    TOUCH_PRIOR,
    curves,
    places,
    response,
)


def silent_proposals():
    """Network without proposals: the search alone finds the touches."""
    columns, rows = np.array([0.05, 0.10]), np.array([0.02, 0.04])
    return ProposalNetwork((np.zeros((4, 30)),), (np.full(4, -9.0),), columns, rows)


def smooth_method():
    """Method of the whole sensor, with one feature of its specimens."""
    rng = np.random.default_rng(0)
    flat = FLAT * np.exp(0.02 * rng.standard_normal((40, 28)))
    features = SpecimenFeatures.fit(flat, mirrors(LAYOUT.design, PROTOCOL), count=1)
    return JointMethod(
        features=features,
        response=response(mismatch=0.03, features=1),
        bend_prior=curves(features=1),
        proposals=silent_proposals(),
        touch_prior=TOUCH_PRIOR,
        combinations=MEASUREMENTS,
        drift=0.02,
        places=places(),
        radius=0.0075,
        size=SIZE,
        shape=(32, 80),
        protocol=PROTOCOL,
    )
