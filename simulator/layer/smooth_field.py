"""Polynomial interpolation of fields that are smooth on a box."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev, legendre
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Box(NamedTuple):
    """Box by its lowest and highest corner (x, y, z) [m]."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def distance(self, x: float, y: float) -> float:
        """Distance of the vertical line at (x, y) [m] from the box [m]."""
        gaps = [
            max(low - at, at - high, 0.0)
            for low, at, high in zip(self.low, (x, y), self.high, strict=False)
        ]
        return math.hypot(*gaps)

    def scaled(self, points: Array) -> Array:
        """Points (..., 3) [m] in coordinates from -1 to 1 in the box."""
        low, high = np.array(self.low), np.array(self.high)
        scaled: Array = (2.0 * points - low - high) / (high - low)
        return scaled


@dataclass(frozen=True, slots=True, eq=False)
class SmoothField:
    """Field on a box as a product of Chebyshev (x, y) and Legendre (z) polynomials.

    Attributes:
        box: domain of the field.
        degrees: numbers of polynomials along x, y and z.
        coefficients: of k components, (k, z, x * y).
    """

    box: Box
    degrees: tuple[int, int, int]
    coefficients: Array

    @classmethod
    def of(
        cls, field: Callable[[Array], Array], box: Box, degrees: tuple[int, int, int]
    ) -> "SmoothField":
        """Interpolate `field`, which gives (k, h, n) at columns of points (n, h, 3) [m]."""
        nodes, across, upright = _interpolation(degrees)
        low, high = np.array(box.low), np.array(box.high)
        values = field(low + 0.5 * (nodes + 1.0) * (high - low))
        return cls(box, degrees, upright @ values @ across.T)

    def __call__(self, columns: Array) -> Array:
        """Values (k, h, n) of the field at columns of points (n, h, 3) [m]."""
        at = self.box.scaled(columns)
        alike = len(at) and bool((at[..., 2] == at[0, :, 2]).all())
        if not alike:
            at = at.reshape(-1, 1, 3)
        x, y = (
            chebyshev.chebvander(at[:, 0, axis], count - 1)
            for axis, count in enumerate(self.degrees[:2])
        )
        across = (x[:, :, None] * y[:, None]).reshape(len(at), -1)
        if alike:
            upright = legendre.legvander(at[0, :, 2], self.degrees[2] - 1)
            coefficients = (upright @ self.coefficients).reshape(-1, across.shape[1])
            found: Array = (coefficients @ across.T).reshape(-1, len(upright), len(at))
            return found
        upright = legendre.legvander(at[:, 0, 2], self.degrees[2] - 1)
        values = np.einsum("kzn,nz->kn", self.coefficients @ across.T, upright)
        return np.ascontiguousarray(values.reshape(-1, *columns.shape[:2]).swapaxes(1, 2))


@lru_cache(maxsize=4)
def _interpolation(degrees: tuple[int, int, int]) -> tuple[Array, Array, Array]:
    """Nodes (x * y, z, 3) from -1 to 1, and matrices from values to coefficients."""
    flat = [chebyshev.chebpts1(count) for count in degrees[:2]]
    heights, weights = legendre.leggauss(degrees[2])
    nodes = np.stack(np.meshgrid(*flat, heights, indexing="ij"), axis=-1)
    across = np.kron(*(np.linalg.inv(chebyshev.chebvander(line, len(line) - 1)) for line in flat))
    upright = legendre.legvander(heights, degrees[2] - 1) * weights[:, None]
    upright = upright * (np.arange(degrees[2]) + 0.5)
    return nodes.reshape(-1, degrees[2], 3), across, upright.T
