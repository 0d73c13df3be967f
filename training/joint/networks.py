"""Angle networks: an ensemble that estimates the bend angle of sensors in clamps of any kind.

One Gaussian distribution of bend curves (`BendCurvePrior`) holds the sensors of one clamp. Where
the clamps of the training set differ, a curve's shape depends nonlinearly on the clamp, and the
networks show the angle from the shape of the change. They estimate it as long as a sensor is not
calibrated; the curve of a calibrated one is known better than that.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from eitskin.training.joint.bend_curve import BEYOND_DEG
from eitskin.training.joint.touch_response import MAX_TOUCHES
from eitskin.training.method.stored_fields import StoredField, StoredFields

Array = NDArray[np.float64]

UNIT_DEG = 20.0  # deg, of the networks' outputs
LOG_DEVIATION = (-5.0, 0.0)  # bounds of the logarithm of the standard deviation, in units
DRIFT = (1e-4, 0.1)
"""Bounds of the standard deviation of the common change, from one of seconds to one of days."""
FEATURE_LIMIT = 4.0  # standard deviations; features of stranger sensors count as so strange
Single = NDArray[np.float32]
Layers: TypeAlias = tuple[tuple[Single, Single], ...]

THRESHOLD = 0.08  # least value of a cell from which a touch is proposed
WIDTH = 0.004  # m, standard deviation of the bump that represents a touch in the target map


@dataclass(frozen=True, slots=True, eq=False)
class AngleNetworks(StoredFields):
    """Ensemble of M networks, each from a change of log V and features to a normal distribution.

    The mean of their means is the estimate. Each was trained without one of M groups of similar
    specimens, so that their differences are a jackknife of what the training set lacks: with m_i
    their means and s_i their standard deviations, the variance is

        mean(s_i^2) + (M - 1) / M sum_i (m_i - mean(m))^2

    (Efron and Stein 1981; Lakshminarayanan et al. 2017 for ensembles of such networks).

    Attributes:
        weights: weights of each layer (M, outputs, inputs).
        biases: biases of each layer (M, outputs).
        unit: rms of each combination of the change in training (K,).
        drift: combinations of a common change of log V by one, in units (K,).
        filter: weights of the change, in units, in the estimate of the common change (K,).
        angle_deg: smallest and largest angle learned from [deg].
    """

    weights: Annotated[tuple[Array, ...], StoredField("weight", single=True)]
    biases: Annotated[tuple[Array, ...], StoredField("bias", single=True)]
    unit: Array
    drift: Array
    filter: Array
    angle_deg: tuple[float, float]
    _layers: Layers = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Round the layers as they are saved."""
        object.__setattr__(self, "_layers", _single_layers(self.weights, self.biases))

    def inputs(self, change: Array, features: Array, drift: Array) -> Array:
        """Inputs (..., K + P + 1).

        Args:
            change: combinations of the change from the flat sensor (..., K).
            features: features of the specimen (..., P).
            drift: standard deviation of the change common to all measurements (...).
        """
        held = np.clip(features, -FEATURE_LIMIT, FEATURE_LIMIT)
        size = np.log(np.clip(drift, *DRIFT) / DRIFT[0])
        shape = without_drift(change / self.unit, np.square(drift), self.drift, self.filter)
        return np.concatenate([shape, held, np.asarray(size)[..., None]], axis=-1)

    def estimate(self, change: Array, features: Array, drift: float) -> tuple[float, float]:
        """Angle [deg] and its standard error [deg] of one frame; arguments as of `inputs`.

        The angle is at most `BEYOND_DEG` outside of those learned from, as that of a bend curve.
        """
        values = self.inputs(change, features, np.array(drift))
        outputs = dense_network(self._layers, values.astype(np.float32))
        means, logs = outputs.astype(float).T
        variance = np.mean(np.exp(2.0 * np.clip(logs, *LOG_DEVIATION)))
        variance += (len(means) - 1) * np.var(means)
        low, high = self.angle_deg
        angle = min(max(UNIT_DEG * float(np.mean(means)), low - BEYOND_DEG), high + BEYOND_DEG)
        return angle, UNIT_DEG * float(np.sqrt(variance))


@dataclass(frozen=True, slots=True, eq=False)
class ProposalNetwork(StoredFields):
    """Network from a frame's change of log V to a coarse map of touches.

    Attributes:
        weights: weights of the layers (outputs, inputs) each.
        biases: biases of the layers (outputs,) each.
        columns, rows: x and y of the cells' centres, rising evenly [m].
    """

    weights: Annotated[tuple[Array, ...], StoredField("weight", single=True)]
    biases: Annotated[tuple[Array, ...], StoredField("bias", single=True)]
    columns: Array
    rows: Array
    _centres: Array = field(init=False, repr=False)  # x, y of all cells (rows x columns, 2) [m]
    _layers: Layers = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Compute the centres of the cells, and round the layers as they are saved."""
        object.__setattr__(self, "_layers", _single_layers(self.weights, self.biases))
        x, y = np.meshgrid(self.columns, self.rows)
        object.__setattr__(self, "_centres", np.column_stack([x.ravel(), y.ravel()]))

    def map(self, inputs: Array) -> Array:
        """Map (rows, columns), 0 to 1, from `network_inputs` (inputs,)."""
        values: Array = expit(dense_network(self._layers, inputs.astype(np.float32))).astype(float)
        return values.reshape(len(self.rows), len(self.columns))

    def places(self, inputs: Array, separation: float) -> Array:
        """Positions of the highest peaks (k, 2) [m], the highest first.

        Args:
            inputs: `network_inputs` of one frame (inputs,).
            separation: smallest distance of two touches [m]; peaks keep 0.6 of it.
        """
        values = self.map(inputs).ravel()
        remaining = values.copy()
        found: list[Array] = []
        while len(found) < MAX_TOUCHES and remaining[best := int(remaining.argmax())] > THRESHOLD:
            x, y = self._centres.T
            square = (x - x[best]) ** 2 + (y - y[best]) ** 2
            around = values * (square < (2.0 * WIDTH) ** 2)
            found.append(around @ self._centres / around.sum())
            remaining[square < (0.6 * separation) ** 2] = 0.0
        return np.array(found).reshape(-1, 2)


def _single_layers(weights: tuple[Array, ...], biases: tuple[Array, ...]) -> Layers:
    """Weights and biases of each layer in single precision."""
    layers = zip(weights, biases, strict=True)
    return tuple((w.astype(np.float32), b.astype(np.float32)) for w, b in layers)


def without_drift(change: Any, variance: Any, drift: Any, filter_: Any) -> Any:
    """Change (..., K) less the linear estimate of the part common to all measurements.

    Where the change by bending has the second moments C and the common one, of direction d, the
    variance v (...), its estimate of least mean square is v d C^-1 c / (1 + v d C^-1 d). Arrays of
    numpy or torch; `drift` is d and `filter_` is C^-1 d (K,).
    """
    drift_share = variance * (change @ filter_) / (1.0 + variance * (drift @ filter_))
    return change - drift_share[..., None] * drift


def dense_network(layers: Iterable[tuple[Any, Any]], values: NDArray[Any]) -> Any:
    """Output (..., outputs) of one or several networks with SiLU between layers, from (inputs,).

    Layers are weights (..., outputs, inputs) and biases (..., outputs).
    """
    for number, (weight, bias) in enumerate(layers):
        hidden = values * expit(values) if number else values
        values = (weight @ hidden[..., None])[..., 0] + bias
    return values


def network_inputs(change: Array, noise: Array, angle_deg: ArrayLike, features: Array) -> Array:
    """Inputs (..., K + 1 + P) of the network.

    The change by a touch is one to a hundred times the noise: asinh is linear for small changes
    and logarithmic for large ones.

    Args:
        change: combinations of the change of log V (..., K); those not finite count as unchanged.
        noise: standard deviation of the change (K,).
        angle_deg: angle of the reference (...) [deg].
        features: features of the specimen (..., P).
    """
    sizes = np.arcsinh(np.where(np.isfinite(change), change, 0.0) / (2.0 * noise))
    return np.concatenate([sizes, np.asarray(angle_deg)[..., None] / 30.0, features], axis=-1)
