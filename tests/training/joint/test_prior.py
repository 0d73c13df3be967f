"""Prior of touches: estimated from a dataset, and changed by hand."""

from dataclasses import replace

import numpy as np
import pytest

from eitskin.training.joint.objective import TouchObjective, Unknowns, levenberg_marquardt
from eitskin.training.joint.touch_response import TouchPrior

from smooth_sensor import MEASUREMENTS, SIZE, TOUCH_PRIOR, curve, response

NAN = np.nan
X = np.array([[0.010, 0.050, NAN], [0.001, NAN, NAN], [0.120, 0.120, 0.090]])
Y = np.array([[0.020, 0.020, NAN], [0.030, NAN, NAN], [0.050, 0.010, 0.030]])
FORCE = np.array([[4.0, 6.0, NAN], [8.0, NAN, NAN], [4.0, 10.0, 6.0]])


def test_prior_is_estimated_from_touches():
    """Bounds lie 3 mm and 30 % beyond the touches, but on the sensor."""
    prior = TouchPrior.fit(np.stack([X, Y, FORCE], axis=-1), SIZE, 0.0075)
    np.testing.assert_allclose(prior.low, [0.0, 0.007, 0.3 * 4.0])
    np.testing.assert_allclose(prior.high, [0.123, 0.053, 1.3 * 10.0])
    assert prior.separation == pytest.approx(np.hypot(0.030, 0.020))
    known = FORCE[np.isfinite(FORCE)]
    mean = known.mean()
    assert prior.force == pytest.approx((mean, np.hypot(known.std(), 0.15 * mean)))
    np.testing.assert_allclose(prior.box[0], [0.0615, 0.030, mean])


def test_single_touches_keep_the_indenters_apart():
    single = np.stack([X, Y, FORCE], axis=-1)
    single[:, 1:] = NAN
    prior = TouchPrior.fit(single, SIZE, 0.0075)
    assert prior.separation == 0.015


@pytest.mark.parametrize("mean", [5.0, 8.0, 11.0])
def test_changed_prior_pulls_forces(mean):
    """The estimate of an 8 N touch in large noise approaches the prior's mean force."""
    prior = replace(TOUCH_PRIOR, force=(mean, 0.2))
    assert prior.box[0, 2] == mean
    one = response().of(())
    true = Unknowns(np.array([[0.060, 0.030, 8.0]]), 0.0)
    change = one(true.touches, 0.0)[0]
    combined = MEASUREMENTS.combined(change, 2.0 * 30**2, 0.0)
    objective = TouchObjective(combined, 0.0, one, curve(), prior)
    found = levenberg_marquardt(objective, objective.linearised(true), 30, 1e-9)
    assert found.unknowns.touches[0, 2] == pytest.approx(mean, abs=0.3)
