"""What a touch does to a sensor: a smooth function of place, force and bend, from frames."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

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


_AXES = np.array([1, 2, 3])
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
        hidden = self._hidden(touches, angle_deg)
        change: Array = hidden @ self.output.T
        return change

    def uncertainty(self, touches: Array, angle_deg: float) -> Array:
        """Covariance (C, C) of their sum, from not knowing q, and from what is left unexplained."""
        hidden = self._hidden(touches, angle_deg)
        change = hidden @ self.output.T
        own = self.response.hidden_output @ hidden.sum(axis=0)
        unexplained = self.response.mismatch**2 * np.sum(change**2, axis=0)
        covariance: Array = own.T @ own + np.diag(unexplained)
        return covariance

    def unseen(self, touches: Array, angle_deg: float) -> Array:
        """What each q changes in their sum (Q, C)."""
        change: Array = self.response.hidden_output @ self._hidden(touches, angle_deg).sum(axis=0)
        return change

    def _hidden(self, touches: Array, angle_deg: float) -> Array:
        """[h, 1] of each touch times its factor (k, hidden + 1)."""
        ranges, response = self.response.ranges, self.response
        hidden = ranges.inputs(touches, angle_deg)
        for weight, bias in zip(response.weights, response.biases, strict=True):
            before = hidden @ weight.T + bias
            hidden = before * _logistic(before)
        factor = response.scale * touches[:, 2:] / ranges.middle_force
        return np.concatenate([factor * hidden, factor], axis=1)

    def with_derivatives(self, touches: Array, angle_deg: float) -> tuple[Array, Array]:
        """Changes (k, C), and their derivatives (k, 3, C) by x, y [1/m] and force [1/N]."""
        ranges, response = self.response.ranges, self.response
        count = len(touches)
        # Tangents along the first three inputs travel below the values: forward differentiation
        # with one matrix product a layer. Rows are values, then d/dx, d/dy, d/dF of each touch.
        rows = np.zeros((4, count, 4))
        rows[0] = ranges.inputs(touches, angle_deg)
        rows[_AXES, :, _AXES - 1] = ranges.input_scale[:, None]
        for weight, bias in zip(response.weights, response.biases, strict=True):
            rows = (rows.reshape(4 * count, -1) @ weight.T).reshape(4, count, -1)
            before = rows[0] + bias
            gate = _logistic(before)
            rows[1:] *= gate * (1.0 + before * (1.0 - gate))
            rows[0] = before * gate
        said = (rows.reshape(4 * count, -1) @ self.output[:, :-1].T).reshape(4, count, -1)
        said[0] += self.output[:, -1]
        unit = response.scale / ranges.middle_force
        slopes = said[1:] * (unit * touches[:, 2:])
        slopes[2] += unit * said[0]
        return unit * touches[:, 2:] * said[0], slopes.transpose(1, 0, 2)


def _logistic(values: Array) -> Array:
    gate: Array = 0.5 + 0.5 * np.tanh(0.5 * values)
    return gate
