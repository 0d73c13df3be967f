"""Where touches may be, at first glance: a small network whose word the fit starts from."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

Array = NDArray[np.float64]

MOST = 4
LIKELY = 0.08  # least value of a cell from which a touch is proposed
WIDTH = 0.004  # m, of the bump that stands for a touch in what the network learns


@dataclass(frozen=True, slots=True, eq=False)
class Proposals:
    """A network from a frame's change to a coarse map of touches.

    Attributes:
        weights: of the layers (outputs, inputs) each.
        biases: of the layers (outputs,) each.
        columns, rows: x and y of the cells' centres, rising evenly [m].
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    columns: Array
    rows: Array
    _centres: Array = field(init=False, repr=False)  # x and y of all cells (rows x columns, 2) [m]

    def __post_init__(self) -> None:
        """Lay out the cells."""
        x, y = np.meshgrid(self.columns, self.rows)
        object.__setattr__(self, "_centres", np.column_stack([x.ravel(), y.ravel()]))

    def map(self, inputs: Array) -> Array:
        """Values of the cells, 0 to 1 (rows, columns), from `network_inputs` (inputs,)."""
        hidden = inputs
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            before = weight @ hidden + bias
            hidden = before * expit(before)
        values: Array = expit(self.weights[-1] @ hidden + self.biases[-1])
        return values.reshape(len(self.rows), len(self.columns))

    def places(self, inputs: Array, separation: float) -> Array:
        """Places of the likeliest touches (k, 2) [m], the likeliest first, so far apart."""
        values = self.map(inputs).ravel()
        left = values.copy()
        found: list[Array] = []
        while len(found) < MOST and left[best := int(left.argmax())] > LIKELY:
            away = np.hypot(*(self._centres - self._centres[best]).T)
            around = values * (away < 2.0 * WIDTH)
            found.append(around @ self._centres / around.sum())
            left[away < 0.6 * separation] = 0.0
        return np.array(found).reshape(-1, 2)

    def arrays(self) -> dict[str, NDArray[np.floating]]:
        """What `from_arrays` needs to make this again; weights were trained in single precision."""
        arrays: dict[str, NDArray[np.floating]] = {"columns": self.columns, "rows": self.rows}
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            arrays[f"weight{i}"] = weight.astype(np.float32)
            arrays[f"bias{i}"] = bias.astype(np.float32)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "Proposals":
        """The proposals that `arrays` came from."""
        values = {name: array.astype(float) for name, array in arrays.items()}
        layers = range(sum(name.startswith("weight") for name in values))
        return cls(
            tuple(values[f"weight{i}"] for i in layers),
            tuple(values[f"bias{i}"] for i in layers),
            values["columns"],
            values["rows"],
        )


def network_inputs(change: Array, noise: Array, angle_deg: ArrayLike, features: Array) -> Array:
    """Inputs (..., C + 1 + P) of the network.

    Args:
        change: of log V (..., C); bad measurements (not finite) count as unchanged.
        noise: standard deviation of the change (C,).
        angle_deg: of the reference (...) [deg].
        features: of the specimen (..., P).

    A touch may be once or a hundred times the noise: asinh is linear for the one and logarithmic
    for the other.
    """
    sizes = np.arcsinh(np.where(np.isfinite(change), change, 0.0) / (2.0 * noise))
    return np.concatenate([sizes, np.asarray(angle_deg)[..., None] / 30.0, features], axis=-1)
