"""Spline fields on a box: cubic splines in the plane, Legendre polynomials over the height."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from eitskin.compiled import compiled
from eitskin.simulator.mechanics.cubic_splines import CubicSplines, cubic_splines, in_plane
from eitskin.simulator.presses.fields.smooth_field import Box, SmoothField

Array = NDArray[np.float64]

_UPRIGHT = 4  # polynomials over the height, at most in all tables


@dataclass(frozen=True, slots=True, eq=False)
class SplineField:
    """Field on a box, which may vary within some cells of the plane much more than elsewhere.

    Points beyond the box have the values of its faces.

    Attributes:
        nodes: of the splines along x and along y, (nx,) and (ny,) [m].
        height: of the box, from 0 [m].
        coefficients: of k components, (nx, ny, nz, k).
    """

    nodes: tuple[Array, Array]
    height: float
    coefficients: Array

    @classmethod
    def of(
        cls, field: Callable[[Array], Array], nodes: tuple[Array, Array], height: float, degree: int
    ) -> "SplineField":
        """Interpolate `field`, which gives (..., k) at points (..., 3) [m]."""
        levels = legendre.leggauss(degree + 1)[0]
        z = 0.5 * height * (levels + 1.0)
        values = field(np.stack(np.meshgrid(*nodes, z, indexing="ij"), axis=-1))
        along, across = (cubic_splines(tuple(each.tolist())).fit for each in nodes)
        upright = np.linalg.inv(legendre.legvander(levels, degree))
        fitted = np.einsum("ai,bj,cl,ijlk->abck", along, across, upright, values, optimize=True)
        return cls(nodes, height, np.ascontiguousarray(fitted))

    @property
    def box(self) -> Box:
        """Box of the field."""
        (x, *_, x_end), (y, *_, y_end) = (each.tolist() for each in self.nodes)
        return Box((x, y, 0.0), (x_end, y_end, self.height))

    @property
    def splines(self) -> tuple[CubicSplines, CubicSplines]:
        """Splines along x and along y."""
        along, across = self.nodes
        return cubic_splines(tuple(along.tolist())), cubic_splines(tuple(across.tolist()))

    def scaled(self, factor: float) -> "SplineField":
        """The field times a factor."""
        return SplineField(self.nodes, self.height, factor * self.coefficients)

    def raised(self, factor: float) -> "SplineField":
        """The displacement field of a box `factor` times as high."""
        upward = np.ones(self.coefficients.shape[-1])
        upward[2] = factor
        return SplineField(self.nodes, factor * self.height, self.coefficients * upward)

    def values(self, columns: Array) -> Array:
        """All components (k, h, n) at columns of points (n, h, 3) [m]."""
        heights, _ = self.over_height(columns[..., 2])
        return np.asarray(np.einsum("nzk,nhz->khn", self._in_plane(columns)[:, 0], heights))

    def moved(self, columns: Array) -> Array:
        """First three components and their derivatives by x, y, z, (12, h, n)."""
        found = self.in_frame((0.0, 0.0, 1.0, 0.0), (math.inf, math.inf), self._inside(columns))
        if found is not None:
            return found
        sums = self._in_plane(columns)[..., :3]
        heights, rates = self.over_height(columns[..., 2])
        found = np.empty((4, 3, columns.shape[1], len(columns)))
        both = ((0, heights), (1, heights), (2, heights), (0, rates))
        for each, (part, height) in zip(found, both, strict=True):
            each[:] = np.einsum("nzk,nhz->khn", sums[:, part], height)
        gradient = found[1:].swapaxes(0, 1).reshape(9, *found.shape[2:])
        return np.concatenate([found[0], gradient])

    def in_frame(
        self, frame: tuple[float, float, float, float], half: tuple[float, float], columns: Array
    ) -> Array | None:
        """First three components and their derivatives, (12, h, n), of the field in a frame.

        By compiled kernels; None without, where heights differ, and for higher polynomials.

        Args:
            frame: x, y [m], cosine and sine of the angle from the x axis to the frame's.
            half: half the length and width beyond which the field is left out [m].
            columns: of points (n, h, 3) [m].
        """
        kernels = compiled("eitskin.simulator.presses.fields.spline_field_kernels")
        nx, ny, nz, _ = self.coefficients.shape
        even = bool((columns[..., 2] == columns[:1, :, 2]).all())
        if kernels is None or not even or nz > _UPRIGHT:
            return None
        cubic = np.zeros((nx, ny, _UPRIGHT, 3))
        cubic[:, :, :nz] = self.coefficients[..., :3]
        upright = np.zeros((2, columns.shape[1], _UPRIGHT))
        for each, given in zip(upright, self.over_height(columns[:1, :, 2].ravel()), strict=True):
            each[:, :nz] = given
        found = np.zeros((12, columns.shape[1], len(columns)))
        knots = (axis.knots for axis in self.splines)
        places = columns[:, 0, :2].T.copy()
        kernels.move(frame, half, *knots, cubic.reshape(nx, ny, -1), *upright, *places, found)
        return found

    def _inside(self, columns: Array) -> Array:
        """Columns moved onto the box along x and y."""
        (x, x_end), (y, y_end) = ((each[0], each[-1]) for each in self.nodes)
        low, high = np.array([x, y, -math.inf]), np.array([x_end, y_end, math.inf])
        return np.asarray(np.clip(columns, low, high))

    def _in_plane(self, columns: Array) -> Array:
        """Polynomials over the height, and their slopes by x and y, (n, 3, nz, k)."""
        points = self._inside(columns[:, :1])[:, 0, :2]
        shape = self.coefficients.shape
        flat = self.coefficients.reshape(*shape[:2], -1)
        return in_plane(self.splines, flat, points).reshape(len(points), 3, *shape[2:])

    def over_height(self, z: Array) -> tuple[Array, Array]:
        """Legendre polynomials (..., nz) at heights z (...), and their derivatives [1/m]."""
        degree = self.coefficients.shape[2] - 1
        s = np.clip(2.0 * z / self.height - 1.0, -1.0, 1.0)
        values = np.asarray(legendre.legvander(s, degree), dtype=np.float64)
        slope = legendre.legder(np.eye(degree + 1))
        rates: Array = values[..., : len(slope)] @ slope * (2.0 / self.height)
        return values, rates


def spline_sum(
    fields: Iterable[SmoothField | SplineField], nodes: tuple[Array, Array]
) -> SplineField:
    """Sum of fields over the same height, as splines on common nodes.

    One evaluation serves all fields, at points that need not lie on a grid. Boxes of polynomials
    have the same sides along y.

    Args:
        fields: one or more.
        nodes: of the splines along x and along y, (nx,) and (ny,) [m].
    """
    fields = list(fields)
    x, y = nodes
    nz, k = (max(field.coefficients.shape[axis] for field in fields) for axis in (2, 3))
    values = np.zeros((len(x), nz, k, len(y)))
    for field in fields:
        nx, ny, height, _ = field.coefficients.shape
        if isinstance(field, SmoothField):
            along, across = (field.basis(axis, at).values for axis, at in enumerate(nodes))
        else:
            along, across = (axis.at(at) for axis, at in zip(field.splines, nodes, strict=True))
        lines = (along @ field.coefficients.reshape(nx, -1)).reshape(len(x), ny, height, k)
        values[:, :height] += np.tensordot(lines, across, (1, 1))
    along, across = (cubic_splines(tuple(each.tolist())).fit for each in nodes)
    fitted = (along @ values.reshape(len(x), -1)).reshape(values.shape) @ across.T
    coefficients = np.ascontiguousarray(np.moveaxis(fitted, -1, 1))
    return SplineField(nodes, max(field.box.high[2] for field in fields), coefficients)
