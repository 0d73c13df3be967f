"""Layers of the paper's networks, evaluated by numpy: a saved pipeline runs without torch.

`training/paper/networks.py` has the same networks for training, with the same names of arrays.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError

Maps = NDArray[np.float32]  # (n, channels, rows, columns)
Arrays = Mapping[str, NDArray[Any]]

EPSILON = 1e-5  # added to variances by batch normalisation
EVALUATED_AT_ONCE = 64  # maps; bounds the memory of a large dataset


@dataclass(frozen=True, slots=True, eq=False)
class Convolution:
    """Convolution with 3 by 3 weights and zeros around the maps.

    Attributes:
        weight: (outputs, inputs, 3, 3).
        bias: (outputs,); None without.
        stride: step between outputs, in pixels.
        dilation: step between the weights' pixels; as many zeros are around the maps.
    """

    weight: Maps
    bias: Maps | None
    stride: int = 1
    dilation: int = 1

    def apply(self, maps: Maps) -> Maps:
        """Maps (n, outputs, rows / stride, columns / stride)."""
        d, s = self.dilation, self.stride
        n, inputs, rows, columns = maps.shape
        size, out = 3, (rows // s, columns // s)
        padded = np.zeros((n, inputs, rows + 2 * d, columns + 2 * d), np.float32)
        padded[:, :, d : d + rows, d : d + columns] = maps
        patches = np.empty((n, inputs, size, size, *out), np.float32)
        for i, j in np.ndindex(size, size):
            patches[:, :, i, j] = padded[
                :, :, i * d : i * d + rows : s, j * d : j * d + columns : s
            ]
        patches = patches.reshape(n, inputs * size**2, -1)
        values = self.weight.reshape(len(self.weight), -1) @ patches
        if self.bias is not None:
            values += self.bias[:, None]
        return values.reshape(n, -1, *out)


@dataclass(frozen=True, slots=True, eq=False)
class TransposedConvolution:
    """Adjoint of a convolution with stride 2 and one zero around the maps, and a bias.

    Attributes:
        weight: (inputs, outputs, size, size), of 3 or 4 pixels.
        bias: (outputs,).
    """

    weight: Maps
    bias: Maps

    def apply(self, maps: Maps) -> Maps:
        """Maps (n, outputs, 2 rows, 2 columns)."""
        n, inputs, rows, columns = maps.shape
        _, outputs, size, _ = self.weight.shape
        parts = self.weight.reshape(inputs, -1).T @ maps.reshape(n, inputs, -1)
        parts = parts.reshape(n, outputs, size, size, rows, columns)
        spread = np.zeros((n, outputs, 2 * rows + 2, 2 * columns + 2), np.float32)
        for i, j in np.ndindex(size, size):
            spread[:, :, i : i + 2 * rows : 2, j : j + 2 * columns : 2] += parts[:, :, i, j]
        return spread[:, :, 1:-1, 1:-1] + self.bias[:, None, None]


@dataclass(frozen=True, slots=True, eq=False)
class BatchNorm:
    """Batch normalisation by the statistics of the training, each (channels,)."""

    weight: Maps
    bias: Maps
    running_mean: Maps
    running_var: Maps

    def apply(self, maps: Maps) -> Maps:
        """Maps of the same shape."""
        factor = self.weight / np.sqrt(self.running_var + np.float32(EPSILON))
        shift = self.bias - factor * self.running_mean
        scaled: Maps = maps * factor[:, None, None] + shift[:, None, None]
        return scaled


@dataclass(frozen=True, slots=True, eq=False)
class Dense:
    """Fully connected layer: weight (outputs, inputs), bias (outputs,)."""

    weight: Maps
    bias: Maps

    def apply(self, maps: Maps) -> Maps:
        """Values (n, outputs) of (n, inputs)."""
        return maps @ self.weight.T + self.bias


class Rectifier:
    """Zero in place of every negative value."""

    def apply(self, maps: Maps) -> Maps:
        """Maps of the same shape."""
        return np.maximum(maps, np.float32(0.0))


class MaxPool:
    """Largest of each two by two pixels."""

    def apply(self, maps: Maps) -> Maps:
        """Maps (n, channels, rows / 2, columns / 2)."""
        n, channels, rows, columns = maps.shape
        blocks = maps.reshape(n, channels, rows // 2, 2, columns // 2, 2)
        largest: Maps = blocks.max(axis=(3, 5))
        return largest


class Flatten:
    """All values of a frame in one row."""

    def apply(self, maps: Maps) -> Maps:
        """Values (n, channels x rows x columns)."""
        return maps.reshape(len(maps), -1)


Layer = Convolution | TransposedConvolution | BatchNorm | Dense | Rectifier | MaxPool | Flatten
Layers = Sequence[Layer]


def logits_of(layers: Layers, maps: ArrayLike) -> NDArray[np.float64]:
    """Output of the last layer for maps (n, channels, rows, columns), computed in batches."""
    inputs = np.asarray(maps, dtype=np.float32)
    parts = []
    for first in range(0, max(len(inputs), 1), EVALUATED_AT_ONCE):
        values = inputs[first : first + EVALUATED_AT_ONCE]
        for layer in layers:
            values = layer.apply(values)
        parts.append(values)
    return np.concatenate(parts).astype(np.float64)


def state_layers(arrays: Arrays, shape: tuple[int, int], maps: int) -> Layers:
    """Layers of the state network: maps (n, maps, rows, columns) to logits (n, 3).

    Raises DataError where arrays are missing or of another shape, as all functions here do.
    """
    trained = _Trained("state network", arrays)
    layers: list[Layer] = []
    for number, (inputs, outputs) in enumerate(((maps, 16), (16, 32), (32, 64))):
        name = f"layers.{number}"
        convolution = Convolution(*trained.pair(f"{name}.0", outputs, inputs, 3, 3))
        layers += [convolution, trained.norm(f"{name}.1", outputs), Rectifier(), MaxPool()]
    for number, (inputs, outputs) in enumerate(((64, 32), (32, 16), (16, 1)), start=3):
        name = f"layers.{number}"
        weight = trained.array(f"{name}.0.weight", inputs, outputs, 3, 3)
        transposed = TransposedConvolution(weight, trained.array(f"{name}.0.bias", outputs))
        layers += [transposed, trained.norm(f"{name}.1", outputs), Rectifier()]
    layers.append(Flatten())
    for number, inputs, outputs in ((7, shape[0] * shape[1], 64), (9, 64, 16)):
        layers += [Dense(*trained.pair(f"layers.{number}", outputs, inputs)), Rectifier()]
    return [*layers, Dense(*trained.pair("layers.11", 3, 16))]


def touch_map_layers(arrays: Arrays) -> Layers:
    """Layers of the post-processor: maps with coordinates (n, 3, rows, columns) to logits."""
    trained = _Trained("touch map network", arrays)
    first = arrays.get("layers.0.weight")
    width = 1 if first is None else len(first)
    layers: list[Layer] = [
        Convolution(*trained.pair("layers.0", width, 3, 3, 3), stride=2),
        Rectifier(),
    ]
    for number, dilation in enumerate((1, 2, 4, 8, 1), start=2):
        weight = trained.array(f"layers.{number}.0.weight", width, width, 3, 3)
        convolution = Convolution(weight, None, dilation=dilation)
        layers += [convolution, trained.norm(f"layers.{number}.1", width), Rectifier()]
    weight = trained.array("layers.7.weight", width, 8, 4, 4)
    layers.append(TransposedConvolution(weight, trained.array("layers.7.bias", 8)))
    return [*layers, Rectifier(), Convolution(*trained.pair("layers.9", 1, 8, 3, 3))]


def layer_arrays(arrays: Arrays) -> dict[str, NDArray[Any]]:
    """Weights and batch statistics of a network, among the saved arrays of its stage."""
    return {name: array for name, array in arrays.items() if name.startswith("layers.")}


def coordinates(shape: tuple[int, int]) -> Maps:
    """y and x of each pixel (2, rows, columns), -1 at the first and 1 at the last."""
    y, x = (np.linspace(-1.0, 1.0, count, dtype=np.float32) for count in shape)
    return np.stack(np.meshgrid(y, x, indexing="ij"))


@dataclass(frozen=True, slots=True)
class _Trained:
    """Arrays of a saved network by their names."""

    network: str
    arrays: Arrays

    def array(self, name: str, *shape: int) -> Maps:
        """Array `name`, in single precision; raises DataError."""
        found = self.arrays.get(name)
        if found is None:
            raise DataError(
                f"expected an array '{name}' of a saved {self.network}, which is missing; save the "
                "pipeline again"
            )
        if found.shape != shape:
            raise DataError(
                f"expected '{name}' of a saved {self.network} of shape {shape}, got other shapes "
                f"than this version's: {found.shape}; train the pipeline again"
            )
        return np.asarray(found, dtype=np.float32)

    def pair(self, name: str, *shape: int) -> tuple[Maps, Maps]:
        """Weight of `shape` and bias of a layer."""
        return self.array(f"{name}.weight", *shape), self.array(f"{name}.bias", shape[0])

    def norm(self, name: str, channels: int) -> BatchNorm:
        """Batch normalisation of so many channels."""
        weight, bias = self.pair(name, channels)
        mean, variance = (
            self.array(f"{name}.{each}", channels) for each in ("running_mean", "running_var")
        )
        return BatchNorm(weight, bias, mean, variance)
