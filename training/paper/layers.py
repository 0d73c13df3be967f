"""Networks of the paper's method as tables of layers, and their evaluation by numpy.

A saved pipeline runs without torch. `training/paper/networks.py` builds the same networks from the
same tables for training.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Maps = NDArray[np.float32]  # (n, channels, rows, columns)
Arrays = Mapping[str, NDArray[Any]]

EPSILON = 1e-5  # added to variances by batch normalisation
EVALUATED_AT_ONCE = 64  # maps; bounds the memory of a large dataset


@dataclass(frozen=True, slots=True)
class Layer:
    """One layer of weights, and what follows it.

    Attributes:
        kind: "convolution" with zeros around the maps, "transposed", the adjoint of a convolution
            of stride 2 with one zero around the maps, or "dense", fully connected.
        inputs, outputs: number of channels, or of values.
        size: size of the weights, in pixels.
        stride: step between the outputs of a convolution, in pixels.
        dilation: step between the pixels of its weights; as many zeros are around the maps.
        bias: whether there is one.
        normed: whether batch normalisation follows.
        rectified: whether negative values are then set to zero.
        pooled: whether the largest of each two by two pixels is then taken.
    """

    kind: Literal["convolution", "transposed", "dense"]
    inputs: int
    outputs: int
    size: int = 3
    stride: int = 1
    dilation: int = 1
    bias: bool = True
    normed: bool = False
    rectified: bool = True
    pooled: bool = False


def state_layers(shape: tuple[int, int], maps: int) -> tuple[Layer, ...]:
    """Encoder-decoder classifier of the paper: maps (n, maps, rows, columns) to logits (n, 3).

    Three 3x3 convolutions (16, 32, 64) with batch norm and max pooling, mirrored by transposed
    convolutions that bring the map back to its size, two fully connected layers down to 16, and
    the layer whose softmax is taken. Rows and columns are multiples of eight.
    """
    down, up = ((maps, 16), (16, 32), (32, 64)), ((64, 32), (32, 16), (16, 1))
    return (
        *(Layer("convolution", *ends, normed=True, pooled=True) for ends in down),
        *(Layer("transposed", *ends, normed=True) for ends in up),
        Layer("dense", shape[0] * shape[1], 64),
        Layer("dense", 64, 16),
        Layer("dense", 16, 3, rectified=False),
    )


def touch_map_layers(width: int = 24) -> tuple[Layer, ...]:
    """Light post-processor: maps with `coordinates` (n, 3, rows, columns) to logits of touch maps.

    One step down, dilated 3x3 convolutions whose receptive field is the whole sensor, one step up;
    `width` channels at half resolution. Rows and columns are multiples of two.
    """
    dilated = {"bias": False, "normed": True}
    return (
        Layer("convolution", 3, width, stride=2),
        *(Layer("convolution", width, width, dilation=d, **dilated) for d in (1, 2, 4, 8, 1)),
        Layer("transposed", width, 8, size=4),
        Layer("convolution", 8, 1, rectified=False),
    )


def coordinates(shape: tuple[int, int]) -> Maps:
    """y and x of each pixel (2, rows, columns), -1 at the first and 1 at the last.

    A reconstruction is sharp near the electrodes and blurred in the middle.
    """
    y, x = (np.linspace(-1.0, 1.0, count, dtype=np.float32) for count in shape)
    return np.stack(np.meshgrid(y, x, indexing="ij"))


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """Trained network, evaluated by numpy.

    Attributes:
        layers: table of the layers.
        arrays: arrays of each layer: weight, bias or zero and, where it is normed, weight, bias,
            mean and variance of batch normalisation.
    """

    layers: tuple[Layer, ...]
    arrays: tuple[tuple[Maps, ...], ...]

    @classmethod
    def from_arrays(cls, layers: Sequence[Layer], arrays: Arrays) -> "Network":
        """Network of saved weights; raises KeyError where some are missing."""
        layer_arrays = []
        for layer, (key, norm) in zip(layers, _names(layers), strict=True):
            bias = arrays[f"{key}.bias"] if layer.bias else 0.0
            mine = [arrays[f"{key}.weight"], bias]
            if layer.normed:
                parts = ("weight", "bias", "running_mean", "running_var")
                mine += [arrays[f"{norm}.{part}"] for part in parts]
            layer_arrays.append(tuple(np.asarray(each, np.float32) for each in mine))
        return cls(tuple(layers), tuple(layer_arrays))

    def logits(self, maps: ArrayLike) -> NDArray[np.float64]:
        """Output of the last layer for maps (n, channels, rows, columns), computed in batches."""
        inputs = np.asarray(maps, dtype=np.float32)
        parts = []
        for first in range(0, max(len(inputs), 1), EVALUATED_AT_ONCE):
            values = inputs[first : first + EVALUATED_AT_ONCE]
            for layer, arrays in zip(self.layers, self.arrays, strict=True):
                values = _evaluate(layer, arrays, values)
            parts.append(values)
        return np.concatenate(parts).astype(np.float64)


def _names(layers: Sequence[Layer]) -> Iterator[tuple[str, str]]:
    """Names in a saved network of each layer and of its batch normalisation, as torch counts."""
    number = 0
    for layer, before in zip(layers, (None, *layers), strict=False):
        if layer.kind == "dense" and before is not None and before.kind != "dense":
            number += 1  # the maps are flattened
        yield (f"{number}.0", f"{number}.1") if layer.normed else (f"{number}", "")
        number += 1 if layer.normed else 1 + layer.rectified


def _evaluate(layer: Layer, arrays: tuple[Maps, ...], maps: Maps) -> Maps:
    """Outputs of a layer, and of what follows it."""
    weight, bias, *norm = arrays
    if layer.kind == "dense":
        values = maps.reshape(len(maps), -1) @ weight.T + bias
    else:
        operation = _convolve if layer.kind == "convolution" else _convolve_transposed
        values = operation(layer, weight, maps)
        if layer.bias:
            values += bias[:, None, None]
    if norm:
        scale, shift, mean, variance = norm
        factor = scale / np.sqrt(variance + np.float32(EPSILON))
        values = values * factor[:, None, None] + (shift - factor * mean)[:, None, None]
    if layer.rectified:
        values = np.maximum(values, np.float32(0.0))
    if layer.pooled:
        n, channels, rows, columns = values.shape
        values = values.reshape(n, channels, rows // 2, 2, columns // 2, 2).max(axis=(3, 5))
    return np.asarray(values)


def _convolve(layer: Layer, weight: Maps, maps: Maps) -> Maps:
    """Maps (n, outputs, rows / stride, columns / stride)."""
    d, s, size = layer.dilation, layer.stride, layer.size
    n, inputs, rows, columns = maps.shape
    padded = np.zeros((n, inputs, rows + 2 * d, columns + 2 * d), np.float32)
    padded[:, :, d : d + rows, d : d + columns] = maps
    patches = np.empty((n, inputs, size, size, rows // s, columns // s), np.float32)
    for i, j in np.ndindex(size, size):
        patches[:, :, i, j] = padded[:, :, i * d : i * d + rows : s, j * d : j * d + columns : s]
    values = weight.reshape(len(weight), -1) @ patches.reshape(n, inputs * size**2, -1)
    return values.reshape(n, -1, rows // s, columns // s)


def _convolve_transposed(layer: Layer, weight: Maps, maps: Maps) -> Maps:
    """Maps (n, outputs, 2 rows, 2 columns)."""
    n, inputs, rows, columns = maps.shape
    size = layer.size
    parts = weight.reshape(inputs, -1).T @ maps.reshape(n, inputs, -1)
    parts = parts.reshape(n, layer.outputs, size, size, rows, columns)
    spread = np.zeros((n, layer.outputs, 2 * rows + 2, 2 * columns + 2), np.float32)
    for i, j in np.ndindex(size, size):
        spread[:, :, i : i + 2 * rows : 2, j : j + 2 * columns : 2] += parts[:, :, i, j]
    return spread[:, :, 1:-1, 1:-1]
