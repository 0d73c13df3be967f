"""What a touch does to a sensor: a smooth function of place, force and bend, from frames."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Ranges:
    """What a response was learned for; outside of it, it is a guess.

    Attributes:
        size: length and width of the sensor [m].
        force: smallest and largest [N].
        angle_deg: smallest and largest [deg].
    """

    size: tuple[float, float]
    force: tuple[float, float]
    angle_deg: tuple[float, float]

    @property
    def middle_force(self) -> float:
        """[N]."""
        return 0.5 * (self.force[0] + self.force[1])

    def inputs(self, touches: Array, angle_deg: ArrayLike) -> Array:
        """Of the network (..., 4), about -1 to 1, from touches (..., 3) of x, y [m], force [N]."""
        inputs = np.empty((*touches.shape[:-1], 4))
        inputs[..., :3] = touches * self.input_scale - 1.0
        inputs[..., 3] = np.asarray(angle_deg) / _ANGLE_SCALE
        return inputs

    @property
    def input_scale(self) -> Array:
        """Derivatives of the first three inputs by x, y [1/m] and force [1/N]."""
        return np.array([2.0 / self.size[0], 2.0 / self.size[1], 1.0 / self.middle_force])


_ANGLE_SCALE = 30.0  # deg, that the network takes as one


@dataclass(frozen=True, slots=True, eq=False)
class TouchResponse:
    """Change of log V by one touch, for any specimen; those of several touches add up.

        g(x, y, F, theta; p, q) = F / F0 scale (W0 + sum_j p_j Wj + sum_l q_l Wl) [h, 1]

    with h(x, y, F, theta) a network of three layers and p the features of a specimen. q ~ N(0, 1)
    is what differs between specimens and shows in their touches alone, such as how stiff they are
    around the gel; it is never known, and part of the uncertainty. The factor F makes a touch of no
    force change nothing. Linear in p and q, because specimens differ by little.

    Attributes:
        weights: of the three layers, (hidden, inputs) each.
        biases: (hidden,) each.
        output: (1 + P, C, hidden + 1): of the middle specimen, then for each feature.
        hidden_output: (Q, C, hidden + 1): for each q.
        scale: size of a change, dimensionless.
        ranges: what it was learned for.
        mismatch: rms error of a touch's change over its rms, on specimens never seen, after its
            strength and q are fitted.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    output: Array
    hidden_output: Array
    scale: float
    ranges: Ranges
    mismatch: float
    _layers: tuple[Array, ...] = field(init=False, repr=False)  # weights (inputs, hidden), scaled
    _biases: tuple[Array, ...] = field(init=False, repr=False)
    _bias_by_angle: Array = field(init=False, repr=False)  # of the first layer [1/deg]

    def __post_init__(self) -> None:
        """Fold the scales of the inputs into the first layer, and room for a one into the last."""
        first, last = self.weights[0], len(self.weights) - 1
        layers = [weight.T for weight in self.weights]
        layers[0] = (first[:, :3] * self.ranges.input_scale).T
        biases = [self.biases[0] - first[:, :3].sum(axis=1), *self.biases[1:]]
        by_angle = first[:, 3] / _ANGLE_SCALE
        layers[last] = np.pad(layers[last], ((0, 0), (0, 1)))
        biases[last] = np.pad(biases[last], (0, 1))
        if not last:
            by_angle = np.pad(by_angle, (0, 1))
        object.__setattr__(self, "_layers", tuple(map(np.ascontiguousarray, layers)))
        object.__setattr__(self, "_biases", tuple(biases))
        object.__setattr__(self, "_bias_by_angle", by_angle)

    def hidden(self, touches: Array, angle_deg: float) -> Array:
        """[h, 1] of each touch (k, 3) times its factor F / F0 scale (k, hidden + 1)."""
        before = touches @ self._layers[0] + (self._biases[0] + angle_deg * self._bias_by_angle)
        hidden = before * expit(before)
        for layer, bias in zip(self._layers[1:], self._biases[1:], strict=True):
            before = hidden @ layer + bias
            hidden = before * expit(before)
        hidden[:, -1] = 1.0
        rows: Array = self._unit * touches[:, 2:] * hidden
        return rows

    def hidden_tangent(self, touches: Array, angle_deg: float) -> Array:
        """The same and its derivatives by x, y [1/m] and force [1/N] (k, 4, hidden + 1).

        Tangents travel below the values: forward differentiation with one product a layer.
        """
        count, first = len(touches), self._layers[0]
        rows = np.empty((count, 4, first.shape[1]))
        value = touches @ first
        value += self._biases[0] + angle_deg * self._bias_by_angle
        np.multiply(_activated(value)[:, None], first, out=rows[:, 1:])
        rows[:, 0] = value
        for layer, bias in zip(self._layers[1:], self._biases[1:], strict=True):
            rows = rows.reshape(4 * count, -1).dot(layer).reshape(count, 4, -1)
            value = rows[:, 0]
            value += bias
            rows[:, 1:] *= _activated(value)[:, None]
        rows[:, 0, -1] = 1.0
        by_force = self._unit * rows[:, 0]
        rows *= self._unit * touches[:, 2:, None]
        rows[:, 3] += by_force
        return rows

    @property
    def _unit(self) -> float:
        """Factor of a touch over its force [1/N]."""
        return self.scale / self.ranges.middle_force

    def of(self, features: ArrayLike) -> "SpecimenResponse":
        """The response of the specimen with these features (P,)."""
        p = np.concatenate([[1.0], np.asarray(features, dtype=float)])
        return SpecimenResponse(self, np.tensordot(p, self.output, axes=1))

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """What `from_arrays` needs to make this again; weights were trained in single precision."""
        arrays: dict[str, NDArray[np.floating]] = {
            "output": self.output.astype(np.float32),
            "hidden_output": self.hidden_output.astype(np.float32),
            "scale": np.array([self.scale, self.mismatch]),
        }
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays[f"weight{i}"] = weight.astype(np.float32)
            arrays[f"bias{i}"] = bias.astype(np.float32)
        ranges = self.ranges
        return arrays | {"ranges": np.array([ranges.size, ranges.force, ranges.angle_deg])}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "TouchResponse":
        """The response that `arrays` came from."""
        values = {name: array.astype(float) for name, array in arrays.items()}
        layers = range(sum(name.startswith("weight") for name in values))
        size, force, angle = (tuple(row) for row in values["ranges"].tolist())
        scale, mismatch = values["scale"].tolist()
        return cls(
            tuple(values[f"weight{i}"] for i in layers),
            tuple(values[f"bias{i}"] for i in layers),
            values["output"],
            values["hidden_output"],
            scale,
            Ranges(size, force, angle),
            mismatch,
        )


@dataclass(frozen=True, slots=True, eq=False)
class SpecimenResponse:
    """Change of log V by touches on one specimen.

    Attributes:
        response: of any.
        output: of this specimen (C, hidden + 1).
    """

    response: TouchResponse
    output: Array

    def __call__(self, touches: Array, angle_deg: float) -> Array:
        """Changes (k, C) by touches (k, 3) of x [m], y [m] and force [N], each alone."""
        change: Array = self.response.hidden(touches, angle_deg) @ self.output.T
        return change

    def tangent(self, touches: Array, angle_deg: float) -> tuple[Array, Array]:
        """Changes and their derivatives, and what `uncertainty` needs to know.

        Returns:
            changes and their derivatives by x, y [1/m] and force [1/N] (k, 4, C).
            hidden: rows of the last layer (k, hidden + 1).
        """
        rows = self.response.hidden_tangent(touches, angle_deg)
        said = rows.reshape(-1, rows.shape[2]) @ self.output.T
        return said.reshape(len(touches), 4, -1), rows[:, 0]

    def uncertainty(self, changes: Array, hidden: Array) -> Array:
        """Covariance (C, C) of the touches' sum, of not knowing q and of what stays unexplained.

        Args:
            changes: by each touch (k, C).
            hidden: rows of the last layer (k, hidden + 1).
        """
        own = self.response.hidden_output @ hidden.sum(axis=0)
        covariance: Array = own.T @ own
        diagonal = covariance.reshape(-1)[:: len(covariance) + 1]
        diagonal += self.response.mismatch**2 * np.einsum("kc,kc->c", changes, changes)
        return covariance

    def unseen(self, touches: Array, angle_deg: float) -> Array:
        """What each q changes in their sum (Q, C)."""
        hidden = self.response.hidden(touches, angle_deg).sum(axis=0)
        change: Array = self.response.hidden_output @ hidden
        return change


def _activated(values: Array) -> Array:
    """v becomes v / (1 + exp(-v)), in place; gives the derivative."""
    gate: Array = expit(values)
    values *= gate
    slope = 1.0 - values
    slope *= gate
    slope += values
    return slope
