"""Sensor in closed form with bend and touches: smooth, symmetric and quick."""

import numpy as np

from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol
from eitskin.training import InputSpec
from eitskin.training.joint.bend_curve import (
    MEAN_POWERS,
    RANDOM_POWERS,
    BendCurve,
    BendCurvePrior,
)
from eitskin.training.joint.combinations import Combinations
from eitskin.training.joint.mirrored_frames import SCALE
from eitskin.training.joint.touch_response import InputRanges, TouchPrior, TouchResponse

NOISE = 2e-4  # of log V, one frame
SIZE = (0.150, 0.060)
RANGES = InputRanges(SIZE, (4.0, 12.0), (-20.0, 50.0))
TOUCH_PRIOR = TouchPrior(
    0.030, (8.0, 2.6), np.array([0.008, 0.008, 1.2]), np.array([0.142, 0.052, 15.6])
)
PROTOCOL = Protocol.pairwise(8)
_ELECTRODES = np.array([[e.x, e.y] for e in SensorDesign.reference().electrodes])
_PAIRS = np.array([row[:2] for row in PROTOCOL.table])
MEASUREMENTS = Combinations(np.full(28, NOISE))  # each by itself
FLAT = 300.0 + 5e3 * np.linalg.norm(_ELECTRODES[_PAIRS[:, 0]] - _ELECTRODES[_PAIRS[:, 1]], axis=1)
LAYOUT = InputSpec(SensorDesign.reference(), PROTOCOL, 40e3, FLAT)
_SOFTNESS = 0.020  # m: how near to an electrode its field no longer grows


def touch_change(touches, angle_deg=0.0):
    """Changes of log V (k, 28) by touches (k, 3): squares of the field between two electrodes."""
    away = touches[:, None, :2] - _ELECTRODES
    field = away / (np.sum(away**2, axis=2, keepdims=True) + _SOFTNESS**2)
    between = field[:, _PAIRS[:, 0]] - field[:, _PAIRS[:, 1]]
    stretch = 1.0 + 0.004 * np.asarray(angle_deg)
    return 1.5e-6 * stretch * touches[:, 2:] * np.sum(between**2, axis=2)


def powers(angle_deg, count):
    """Powers 1, 2, ... (n, count) of the angle in the unit of bend curves."""
    return (np.asarray(angle_deg)[..., None] / SCALE) ** np.arange(1, count + 1)


def bend_mean():
    """Coefficients b_k (MEAN_POWERS, 28), largest for pairs along the sensor."""
    along = np.abs(_ELECTRODES[_PAIRS[:, 0], 0] - _ELECTRODES[_PAIRS[:, 1], 0]) / SIZE[0]
    return np.outer([1.0, 0.15, -0.05, 0.0, 0.0], 0.01 + 0.04 * along)[:MEAN_POWERS]


def own_covariance(size=5e-4):
    """Covariance of the random effects: independent channels and powers."""
    return size**2 * np.eye(RANDOM_POWERS * 28)


def curve(size=5e-4):
    """Bend curve of an uncalibrated specimen."""
    return BendCurve(
        bend_mean(), np.zeros((RANDOM_POWERS, 28)), own_covariance(size), (-20.0, 50.0)
    )


def curves(features=0):
    """Distribution of bend curves, independent of the features."""
    mean = np.concatenate([bend_mean()[None], np.zeros((features, MEAN_POWERS, 28))])
    return BendCurvePrior(mean, own_covariance(), (-20.0, 50.0), np.ones(features))


def response(mismatch=0.0, features=0, unseen=0, hidden=160, seed=0):
    """Touch response of fixed random layers, the last one fitted to `touch_change`.

    What it is fitted to does not matter where frames are made from it: it is the truth then.
    """
    rng = np.random.default_rng(seed)
    weights = (rng.standard_normal((hidden, 4)) * [4.0, 2.0, 0.2, 0.2], np.eye(hidden))
    biases = (3.0 * rng.standard_normal(hidden), np.zeros(hidden))
    touches = rng.uniform(TOUCH_PRIOR.low, TOUCH_PRIOR.high, (2000, 3))
    angle = rng.uniform(-30.0, 60.0, 2000)
    inner = RANGES.inputs(touches, angle)
    for weight, bias in zip(weights, biases, strict=True):
        before = inner @ weight.T + bias
        inner = before / (1.0 + np.exp(-before))
    columns = np.column_stack([inner, np.ones(len(inner))])
    factor = 0.01 * touches[:, 2:] / RANGES.middle_force
    wanted = touch_change(touches, angle[:, None]) / factor
    output = np.linalg.lstsq(columns, wanted, rcond=1e-4)[0].T
    extra = 0.05 * rng.standard_normal((features, 28, 1)) * output
    own = 0.05 * rng.standard_normal((unseen, 28, 1)) * output
    output = np.concatenate([output[None], extra])
    return TouchResponse(weights, biases, output, own, 0.01, RANGES, mismatch)


def places(step=0.006):
    """Grid of positions (n, 2) [m] within the prior's bounds."""
    axes = [np.arange(TOUCH_PRIOR.low[i], TOUCH_PRIOR.high[i] + 1e-9, step) for i in (0, 1)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
