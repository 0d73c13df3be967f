"""Proposal network: a coarse probability map of touches, from which the fit starts."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from eitskin.training.joint.prior import MOST_TOUCHES

Array = NDArray[np.float64]
Single = NDArray[np.float32]

THRESHOLD = 0.08  # least value of a cell from which a touch is proposed
WIDTH = 0.004  # m, standard deviation of the bump that represents a touch in the target map


@dataclass(frozen=True, slots=True, eq=False)
class ProposalNetwork:
    """Network from a frame's change of log V to a coarse map of touches.

    Attributes:
        weights: of the layers (outputs, inputs) each.
        biases: of the layers (outputs,) each.
        columns, rows: x and y of the cells' centres, rising evenly [m].
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    columns: Array
    rows: Array
    _centres: Array = field(init=False, repr=False)  # x, y of all cells (rows x columns, 2) [m]
    _layers: tuple[tuple[Single, Single], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Compute the centres of the cells, and round the layers as they are saved."""
        layers = zip(self.weights, self.biases, strict=True)
        single = tuple((w.astype(np.float32), b.astype(np.float32)) for w, b in layers)
        object.__setattr__(self, "_layers", single)
        x, y = np.meshgrid(self.columns, self.rows)
        object.__setattr__(self, "_centres", np.column_stack([x.ravel(), y.ravel()]))

    def map(self, inputs: Array) -> Array:
        """Map (rows, columns), 0 to 1, from `network_inputs` (inputs,)."""
        hidden = inputs.astype(np.float32)
        for weight, bias in self._layers[:-1]:
            before = weight @ hidden + bias
            hidden = before * expit(before)
        weight, bias = self._layers[-1]
        values: Array = expit(weight @ hidden + bias).astype(float)
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
        while len(found) < MOST_TOUCHES and remaining[best := int(remaining.argmax())] > THRESHOLD:
            x, y = self._centres.T
            square = (x - x[best]) ** 2 + (y - y[best]) ** 2
            around = values * (square < (2.0 * WIDTH) ** 2)
            found.append(around @ self._centres / around.sum())
            remaining[square < (0.6 * separation) ** 2] = 0.0
        return np.array(found).reshape(-1, 2)

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """Arrays from which `from_arrays` restores the network; weights in single precision."""
        arrays: dict[str, NDArray[np.floating]] = {"columns": self.columns, "rows": self.rows}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays[f"weight{i}"] = weight.astype(np.float32)
            arrays[f"bias{i}"] = bias.astype(np.float32)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "ProposalNetwork":
        """Restore the network that `arrays` came from."""
        values = {name: array.astype(float) for name, array in arrays.items()}
        layers = range(sum(name.startswith("weight") for name in values))
        return cls(
            tuple(values[f"weight{i}"] for i in layers),
            tuple(values[f"bias{i}"] for i in layers),
            values["columns"],
            values["rows"],
        )


def network_inputs(change: Array, noise: Array, angle_deg: ArrayLike, features: Array) -> Array:
    """Inputs (..., K + 1 + P) of the network.

    The change by a touch is one to a hundred times the noise: asinh is linear for small changes
    and logarithmic for large ones.

    Args:
        change: combinations of the change of log V (..., K); those not finite count as unchanged.
        noise: standard deviation of the change (K,).
        angle_deg: of the reference (...) [deg].
        features: of the specimen (..., P).
    """
    sizes = np.arcsinh(np.where(np.isfinite(change), change, 0.0) / (2.0 * noise))
    return np.concatenate([sizes, np.asarray(angle_deg)[..., None] / 30.0, features], axis=-1)
