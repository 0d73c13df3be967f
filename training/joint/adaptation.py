"""Adaptation of the joint method to one sensor: its bend curve and the noise of its frames.

The posterior of the bend curve by Bayes' rule is that of the sensor's random effects, whose prior
was learned from the training specimens; hinge, layers and contacts act on it together.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator.instrument.session import DRIFT_TIME
from eitskin.training.joint.bend_curve import BendCurve, BendCurvePrior, mixture_curve
from eitskin.training.joint.combinations import Combinations, CombinedChange, log_change
from eitskin.training.joint.specimen_model import LOG_ODDS, angle_standard_error, estimate_angle
from eitskin.training.method.interface import Calibration
from eitskin.training.method.known_frames import FLAT_DEG, KnownFrames
from eitskin.training.method.observations import UNKNOWN_AGE

Array = NDArray[np.float64]
Combined = Callable[[Array, float, float], CombinedChange]

STATED_ANGLES = 8  # at which standard errors are stated
PRIOR_FRAMES = 1.0  # frames with noise as in training, that count beside the known ones
NOISE_SCALE = (0.5, 5.0)  # bounds of the noise relative to that of training
# Growth of the covariance of curves with how strange a sensor is among those learned from
# (`BendCurvePrior.widened`). The usual ones were learned from sensors that differ by a tenth as
# much, so that any other is strange among them.
WIDENING, USUAL_WIDENING = 1.0, 0.2


def adapted_curve(
    curves: BendCurvePrior,
    usual: BendCurvePrior | None,
    features: Array,
    known: KnownFrames,
    combined: Combined,
    drift: float,
    noise_scale: float,
) -> tuple[BendCurve, Calibration]:
    """Bend curve of a sensor given untouched frames at known angles, which are taken to be exact.

    Its mean and covariance are those of the mixture of the posteriors of all priors. Errors before
    are those by the prior that is likeliest given the frames.

    Args:
        curves: prior of the curve of any sensor.
        usual: that of one in the usual clamp, if there is one.
        features: of the sensor (P,).
        known: untouched frames at known angles.
        combined: combinations of a change of log V (C,), given the sum of the reciprocal numbers of
            frames in both means that are compared, and the time between these [s].
        drift: standard deviation after `DRIFT_TIME` of the factor common to all measurements.
        noise_scale: noise of a frame relative to that in training.
    """
    priors, odds = [curves.widened(features, WIDENING)], [0.0]
    if usual is not None:
        priors.append(usual.widened(features, USUAL_WIDENING))
        odds.append(LOG_ODDS)
    seen, static = known.observations, log_change(known.observations.static)
    # A measurement that is bad at one angle is left out of all: they share the flat frames.
    usable = np.where(np.isfinite(static).all(axis=0), static, np.nan)
    changes = [combined(each, 1.0, 0.0) for each in usable]
    # Frames drift together from their reference on. The times of those of one age, as in a dataset,
    # are unknown: what drift they share is not known either, and is taken to be none.
    age, count = seen.age, len(usable)
    others = (age[:, None] == age) & ~np.eye(count, dtype=bool)
    walk = np.where(others, 0.0, np.minimum(age[:, None], age)) / DRIFT_TIME * drift**2
    together = noise_scale**2 * (np.diag(seen.frames**-1) + 1.0 / seen.static_frames[0])
    combinations = changes[0].combinations
    shared, own = combinations.drift, combinations.without(changes[0].good)[1]
    noise = np.kron(together, own) + np.kron(walk, np.outer(shared, shared))
    bends = known.angle_deg, np.array([each.change for each in changes]), noise
    logs = np.add([curve.log_likelihood(*bends) for curve in priors], odds)
    shares = np.exp(logs - logs.max())
    curve = mixture_curve([prior.conditioned(*bends) for prior in priors], shares / shares.sum())
    share, residuals = 1.0 + 1.0 / float(seen.static_frames[0]), []
    for change, time, angle in zip(static, age.tolist(), known.angle_deg, strict=True):
        frame = combined(change, share, time)
        residuals.append(estimate_angle(curve, frame.change, frame.noise)[0] - angle)
    before = priors[int(logs.argmax())]
    angles = np.linspace(*before.angle_deg, STATED_ANGLES).tolist()
    unknown = combined(np.zeros_like(static[0]), share, UNKNOWN_AGE).noise
    errors = [
        tuple(angle_standard_error(each, angle, unknown) for angle in angles)
        for each in (before, curve)
    ]
    residual = float(np.sqrt(np.mean(np.square(residuals))))
    return curve, Calibration(tuple(angles), errors[0], errors[1], residual)


def noise_scale(known: KnownFrames, combinations: Combinations) -> float:
    """Noise of a frame relative to that in training, from untouched frames of one angle.

    A frame with noise as in training counts beside them, so that few tell little. Their differences
    count without the part that is common to all measurements, which drifts.
    """
    seen = known.observations
    alike = np.abs(known.reference_deg - known.angle_deg) <= FLAT_DEG
    alike &= known.told & ~known.touched & (seen.dynamic != seen.static).any(axis=1)
    total = count = PRIOR_FRAMES * (len(combinations.noise) - 1.0)
    for row in np.flatnonzero(alike):
        white = log_change(seen.dynamic[row]) / combinations.noise
        white = white[np.isfinite(white)]
        size = 1.0 / seen.frames[row] + 1.0 / seen.dynamic_frames[row]
        total += float(np.sum((white - white.mean()) ** 2)) / size
        count += len(white) - 1.0
    return float(np.clip(np.sqrt(total / count), *NOISE_SCALE))
