"""Angle networks: an ensemble that estimates the bend angle of sensors in clamps of any kind.

One Gaussian distribution of bend curves (`BendCurvePrior`) holds the sensors of one clamp. Where
the clamps of the training set differ, a curve's shape depends nonlinearly on the clamp, and the
networks tell the angle from the shape of the change. They estimate it as long as a sensor is not
calibrated; the curve of a calibrated one is known better than that.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from eitskin.training.joint.bend_curve import BEYOND_DEG

Array = NDArray[np.float64]

UNIT_DEG = 20.0  # deg, of the networks' outputs
LOG_DEVIATION = (-5.0, 0.0)  # bounds of the logarithm of the standard deviation, in units
NEAR_DEG = 5.0
"""Angle below which the bend curve counts the more, the nearer: it meets zero exactly."""
FAR_DEG = 20.0
"""Angle by a bend curve beyond which it does not count where networks see no bend: curves of any
clamp are so wide there that a large bend explains almost any frame."""
DRIFT = (1e-4, 0.1)
"""Bounds of the standard deviation of the common change, from one of seconds to one of days."""
FEATURE_LIMIT = 4.0  # standard deviations; features of stranger sensors count as so strange


@dataclass(frozen=True, slots=True, eq=False)
class AngleNetworks:
    """Ensemble of M networks, each from a change of log V and features to a normal distribution.

    The mean of their means is the estimate. Each was trained without one of M groups of similar
    specimens, so that their differences are a jackknife of what the training set lacks: with m_i
    their means and s_i their standard deviations, the variance is

        mean(s_i^2) + (M - 1) / M sum_i (m_i - mean(m))^2

    (Efron and Stein 1981; Lakshminarayanan et al. 2017 for ensembles of such networks).

    Attributes:
        weights: of each layer (M, outputs, inputs).
        biases: of each layer (M, outputs).
        unit: rms of each combination of the change in training (K,).
        drift: combinations of a common change of log V by one, in units (K,).
        filter: weights of the change, in units, in the estimate of the common change (K,).
        angle_deg: smallest and largest angle learned from [deg].
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    unit: Array
    drift: Array
    filter: Array
    angle_deg: tuple[float, float]

    def inputs(self, change: Array, features: Array, drift: Array) -> Array:
        """Inputs (..., K + P + 1).

        Args:
            change: combinations of the change from the flat sensor (..., K).
            features: of the specimen (..., P).
            drift: standard deviation of the change common to all measurements (...).
        """
        held = np.clip(features, -FEATURE_LIMIT, FEATURE_LIMIT)
        size = np.log(np.clip(drift, *DRIFT) / DRIFT[0])
        shape = self.without_drift(change / self.unit, np.square(drift))
        return np.concatenate([shape, held, np.asarray(size)[..., None]], axis=-1)

    def without_drift(self, change: Array, variance: Array) -> Array:
        """Change, in units, less the linear estimate of the part common to all measurements.

        Where the change by bending has the second moments C and the common one the variance v,
        its estimate of least mean square is v d C^-1 c / (1 + v d C^-1 d).

        Args:
            change: in units (..., K).
            variance: of the common change (...).
        """
        told = variance * (change @ self.filter) / (1.0 + variance * (self.drift @ self.filter))
        return change - np.asarray(told)[..., None] * self.drift

    def members(self, change: Array, features: Array, drift: float) -> tuple[Array, Array]:
        """Means and standard deviations (M,) of one frame [deg]; arguments as of `inputs`."""
        values = self.inputs(change, features, np.array(drift))
        hidden = np.repeat(values[None], len(self.biases[0]), axis=0)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            before = np.einsum("moi,mi->mo", weight, hidden) + bias
            hidden = before * expit(before)
        last = np.einsum("moi,mi->mo", self.weights[-1], hidden) + self.biases[-1]
        return UNIT_DEG * last[:, 0], UNIT_DEG * np.exp(np.clip(last[:, 1], *LOG_DEVIATION))

    def estimate(self, change: Array, features: Array, drift: float) -> tuple[float, float]:
        """Angle [deg] and its standard error [deg] of one frame; arguments as of `inputs`.

        The angle is at most `BEYOND_DEG` outside of those learned from, as that of a bend curve.
        """
        means, deviations = self.members(change, features, drift)
        lacking = (len(means) - 1) * float(np.var(means))
        low, high = self.angle_deg
        angle = min(max(float(np.mean(means)), low - BEYOND_DEG), high + BEYOND_DEG)
        return angle, float(np.sqrt(np.mean(deviations**2) + lacking))

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """Arrays from which `from_arrays` restores the networks; weights in single precision."""
        parts = {"unit": self.unit, "drift": self.drift, "filter": self.filter}
        arrays: dict[str, NDArray[np.floating]] = {**parts, "angle_deg": np.array(self.angle_deg)}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays[f"weight{i}"] = weight.astype(np.float32)
            arrays[f"bias{i}"] = bias.astype(np.float32)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "AngleNetworks":
        """Restore the networks that `arrays` came from."""
        values = {name: array.astype(float) for name, array in arrays.items()}
        layers = range(sum(name.startswith("weight") for name in values))
        low, high = values["angle_deg"].tolist()
        return cls(
            tuple(values[f"weight{i}"] for i in layers),
            tuple(values[f"bias{i}"] for i in layers),
            values["unit"],
            values["drift"],
            values["filter"],
            (low, high),
        )


def blended(curve: tuple[float, float], networks: tuple[float, float]) -> tuple[float, float]:
    """Angle and its standard error [deg] from those by the bend curve and by the networks.

    Near zero the curve counts; the networks alone do from `NEAR_DEG` by themselves on, or `FAR_DEG`
    by the curve.
    """
    far = (abs(curve[0]) - NEAR_DEG) / (FAR_DEG - NEAR_DEG)
    share = min(max(abs(networks[0]) / NEAR_DEG, far), 1.0)
    angle, deviation = (
        (1.0 - share) * one + share * other for one, other in zip(curve, networks, strict=True)
    )
    return angle, deviation
