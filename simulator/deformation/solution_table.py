"""Table of solved fields over parameters such as distance and depth."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.simulator.deformation.solution_store import Arrays
from eitskin.simulator.linalg.alike_products import block_rows

Array = NDArray[np.float64]

TOLERANCE = 3e-4
"""Singular values, relative to the largest, that a table keeps."""
_OF_FIELD = 4  # dimensions of the coefficients of one field
_LEAST = 0.01  # least measure of a solution over the largest, for its weight


class Axis(NamedTuple):
    """Solved values of one parameter, and the way of interpolation between them.

    Attributes:
        name: name of the parameter.
        kind: key of `INTERPOLATIONS`.
        nodes: solved values, rising, (n,).
    """

    name: str
    kind: str
    nodes: Array

    def weights(self, x: Array) -> Array:
        """Weights of the solved values at parameters (t,), (images, t, solved).

        A parameter that is solved up to a plane of symmetry has two images: the solved fields as
        they are, and mirrored.
        """
        return INTERPOLATIONS[self.kind](self.nodes, x)


@dataclass(frozen=True, eq=False)
class SolutionTable:
    """Solved fields over axes, stored by proper orthogonal decomposition, and numbers with them.

    Attributes:
        axes: axes of the parameters.
        amplitudes: amplitudes of the modes at all solved values, (n1, n2, ..., rank).
        modes: coefficients of fields relative to `scales`, (rank, nx, ny, nz, k), stored in
            single precision.
        scales: scales of the components, (k,).
        numbers: solved with the fields, (n1, n2, ...) each; "extra_depth" is by how much presses
            sink deeper than in an unbounded stack [m].
        sizes: lengths and moduli of the solved sensor, and nodes of its fields.
    """

    axes: tuple[Axis, ...]
    amplitudes: Array
    modes: NDArray[np.floating]
    scales: Array
    numbers: Mapping[str, Array]
    sizes: Mapping[str, Array]

    @classmethod
    def from_solutions(
        cls,
        axes: Sequence[Axis],
        fields: ArrayLike,
        numbers: Mapping[str, ArrayLike],
        sizes: Mapping[str, ArrayLike],
        tolerance: float = TOLERANCE,
        measure: Callable[[Array], Array] | None = None,
    ) -> "SolutionTable":
        """Table of coefficients (n1, n2, ..., nx, ny, nz, k) and of numbers (n1, n2, ...).

        Singular values below `tolerance`, relative to the largest, are left out: of coefficients
        over their scales, or of a linear `measure` (n, m) of n fields, each over the root of its
        norm. Source: Sirovich, Quarterly of Applied Mathematics 45, 561 (1987), "snapshots".
        """
        coefficients = np.asarray(fields)
        solved, shape = coefficients.shape[:-_OF_FIELD], coefficients.shape[-_OF_FIELD:]
        scales = np.sqrt(np.mean(coefficients**2, axis=tuple(range(coefficients.ndim - 1))))
        relative = coefficients / np.where(scales > 0.0, scales, 1.0)
        rows = relative.reshape(math.prod(solved), -1)
        weights = np.ones((len(rows), 1))
        measured = rows if measure is None else measure(coefficients.reshape(-1, *shape))
        if measure is not None:
            norms = np.linalg.norm(measured, axis=1, keepdims=True)
            weights = np.maximum(norms, _LEAST * norms.max()) ** -0.5
        left_vectors, singular, _ = np.linalg.svd(weights * measured, full_matrices=False)
        rank = max(1, int(np.count_nonzero(singular > tolerance * singular[0])))
        amounts = left_vectors[:, :rank] * singular[:rank]
        modes = amounts.T @ (weights * rows) / singular[:rank, None] ** 2
        largest = np.abs(modes).max(axis=1)
        amplitudes = (amounts / weights * largest).reshape(*solved, rank)
        modes /= largest[:, None]
        return cls(
            tuple(axes),
            amplitudes,
            modes.reshape(rank, *shape).astype(np.float32).astype(np.float64),
            scales,
            {name: np.asarray(values) for name, values in numbers.items()},
            {name: np.asarray(value) for name, value in sizes.items()},
        )

    def arrays(self, precision: type = np.float32) -> Arrays:
        """Arrays by name, as they are stored, with the modes in a precision."""
        return {
            **{f"axis {n} {a.name} {a.kind}": a.nodes for n, a in enumerate(self.axes)},
            "amplitudes": self.amplitudes,
            "modes": self.modes.astype(precision),
            "scales": self.scales,
            **{f"number {name}": values for name, values in self.numbers.items()},
            **{f"size {name}": value for name, value in self.sizes.items()},
        }

    @classmethod
    def from_arrays(cls, arrays: Arrays, precision: type = np.float32) -> "SolutionTable":
        """Table of stored arrays, which sums modes in a precision."""
        axes = sorted(name.split() for name in arrays if name.startswith("axis "))
        return cls(
            tuple(Axis(name, kind, arrays[f"axis {n} {name} {kind}"]) for _, n, name, kind in axes),
            arrays["amplitudes"].astype(np.float64, copy=False),
            arrays["modes"].astype(precision, copy=False),
            arrays["scales"],
            {k.removeprefix("number "): a for k, a in arrays.items() if k.startswith("number ")},
            {k.removeprefix("size "): a for k, a in arrays.items() if k.startswith("size ")},
        )

    def nodes(self, name: str) -> Array:
        """Solved values of a parameter."""
        return next(axis.nodes for axis in self.axes if axis.name == name)

    def size(self, name: str) -> float:
        """Length or modulus of the solved sensor by its name."""
        return float(self.sizes[name])

    def amounts(self, **parameters: ArrayLike) -> tuple[Array, dict[str, Array]]:
        """Amounts of the modes and numbers at parameters (t,) or at one of each.

        Returns amounts (images of each axis that has them, t, rank) and numbers (t,), summed over
        images.
        """
        weights = [axis.weights(np.atleast_1d(parameters[axis.name])) for axis in self.axes]
        images = tuple(len(weight) for weight in weights if len(weight) > 1)
        product = weights[0]  # of the weights, (all images, t, solved)
        for weight in weights[1:]:
            products = product[:, None, :, :, None] * weight[:, :, None]
            product = products.reshape(-1, products.shape[2], products.shape[3] * products.shape[4])
        summed = product.sum(axis=0)
        numbers = {name: (summed * v.ravel()).sum(axis=1) for name, v in self.numbers.items()}
        rows = product.reshape(-1, product.shape[-1])
        rank = len(self.modes)
        amounts = product_in_blocks(rows, self.amplitudes.reshape(-1, rank))
        return amounts.reshape(*images, len(summed), rank), numbers

    def evaluate(self, **parameters: ArrayLike) -> tuple[Array, dict[str, Array]]:
        """Coefficients and numbers at parameters (t,) or at one of each.

        Returns coefficients (images of each axis that has them, t, nx, ny, nz, k) and numbers (t,),
        summed over images.
        """
        amounts, numbers = self.amounts(**parameters)
        # In the precision of the modes, since reading them takes all the time.
        rows = product_in_blocks(amounts.reshape(-1, len(self.modes)), self._fields)
        return rows.reshape(*amounts.shape[:-1], *self.modes.shape[1:]), numbers

    @cached_property
    def _fields(self) -> NDArray[np.floating]:
        """Modes with their scales, (rank, nx * ny * nz * k)."""
        scaled = (self.modes * self.scales).astype(self.modes.dtype)
        return scaled.reshape(len(scaled), -1)

    def rescale(self, length: float) -> "SolutionTable":
        """Table whose fields and sizes, which are all lengths, are multiplied."""
        sizes = {name: length * value for name, value in self.sizes.items()}
        return replace(self, scales=length * self.scales, sizes=sizes)


def product_in_blocks(rows: NDArray[np.floating], matrix: NDArray[np.floating]) -> NDArray[Any]:
    """Product of rows (n, m) with a matrix (m, k), in the precision of the matrix, (n, k).

    The rows are multiplied in blocks of one size, filled up with zeros: what is found of one row
    depends on no other, and not on their number.
    """
    each = block_rows()
    blocks = np.zeros((-(-len(rows) // each), each, rows.shape[1]), matrix.dtype)
    blocks.reshape(-1, rows.shape[1])[: len(rows)] = rows
    return np.asarray(np.matmul(blocks, matrix).reshape(-1, matrix.shape[1])[: len(rows)])


def _spline(nodes: Array, x: Array) -> Array:
    """Cubic spline through all solved values."""
    return np.array(_cardinal_splines(tuple(nodes.tolist()))(x))[None]


def _vanishing(nodes: Array, x: Array) -> Array:
    """Cubic spline to 0 at the last node, and constant before the first."""
    return _spline(nodes, np.maximum(x, nodes[0]))[..., :-1]


def _vanishing_logarithmic(nodes: Array, x: Array) -> Array:
    """As `_vanishing`, over the logarithm."""
    return _vanishing(np.log(nodes), np.log(np.maximum(x, nodes[0])))


def _from_zero(nodes: Array, x: Array) -> Array:
    """Polynomial through the solved values and 0 at 0."""
    return _lagrange(nodes, np.append(0.0, nodes), x)[None]


def _polynomial(nodes: Array, x: Array) -> Array:
    """Polynomial through the solved values."""
    return _lagrange(nodes, nodes, x)[None]


def _bilinear(nodes: Array, x: Array) -> Array:
    """For the product of two depths, by solved equal ones.

    Over the product the change is constant up to the least solved depth, and a polynomial beyond.
    """
    deep = np.maximum(np.sqrt(x), nodes[0])
    return (x[:, None] / nodes**2 * _lagrange(nodes, nodes, deep))[None]


def _lagrange(nodes: Array, every: Array, x: Array) -> Array:
    """Polynomials, (t, n), that are 1 at one of the nodes and 0 at all others of `every`."""
    is_other = every != nodes[:, None]
    others = np.broadcast_to(every, is_other.shape)[is_other].reshape(len(nodes), -1)
    shares = (x[:, None, None] - others) / (nodes[:, None] - others)
    return np.asarray(np.prod(shares, axis=-1))


def _mirrored_spline(nodes: Array, x: Array) -> Array:
    """Spline through values that are solved up to the middle, the last node, and their images."""
    count, middle = len(nodes), float(nodes[-1])
    weights = _spline(np.concatenate([nodes, (2.0 * middle - nodes)[-2::-1]]), x)[0]
    direct, images = weights[:, :count], np.zeros((len(x), count))
    images[:, :-1] = weights[:, : count - 1 : -1]
    # A press in the middle is its own image, but the mesh is not quite symmetric.
    direct[:, -1] *= 0.5
    images[:, -1] = direct[:, -1]
    return np.stack([direct, images])


def _direction(nodes: Array, x: Array) -> Array:
    """Trigonometric polynomial over half a turn, solved in a quarter, and its mirror images."""
    count = 2 * (len(nodes) - 1)
    every = np.arange(count) * math.pi / count
    turn = 2.0 * (np.asarray(x)[:, None] - every)
    waves = sum(np.cos(k * turn) for k in range(1, count // 2))
    weights = (1.0 + 2.0 * waves + np.cos(count // 2 * turn)) / count
    images = np.zeros((len(turn), len(nodes)))
    images[:, 1:-1] = weights[:, : len(nodes) - 1 : -1]
    return np.stack([weights[:, : len(nodes)], images])


INTERPOLATIONS: dict[str, Callable[[Array, Array], Array]] = {
    "spline": _spline,
    "vanishing": _vanishing,
    "logarithmic": _vanishing_logarithmic,
    "from-zero": _from_zero,
    "polynomial": _polynomial,
    "bilinear": _bilinear,
    "mirrored": _mirrored_spline,
    "direction": _direction,
}


@lru_cache(maxsize=64)
def _cardinal_splines(nodes: tuple[float, ...]) -> Callable[[Array], Array]:
    from scipy.interpolate import CubicSpline

    spline: Callable[[Array], Array] = CubicSpline(nodes, np.eye(len(nodes)))
    return spline
