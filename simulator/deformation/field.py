"""Displacement fields of the gel: products of functions along x and y and over the height."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from types import ModuleType
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.polynomial import chebyshev, legendre
from numpy.typing import NDArray
from scipy.interpolate import BSpline, NdBSpline, make_interp_spline

Array = NDArray[np.float64]

_DEGREE = 3
_UPRIGHT = 4  # polynomials over the height that the kernel takes
_KNOT_TOLERANCE = 1e-9
_VALUE = (0, 0)  # orders of derivatives by x and y


class CubicSplines:
    """B-splines of degree 3 that interpolate values at nodes, without a knot at the second node.

    Beyond the nodes they keep their values. Source: de Boor, A Practical Guide to Splines, chapters
    IX, X and XIII.

    Attributes:
        nodes: rising, four or more, (n,).
        knots: positions where the pieces of the splines meet, (n + 4,).
    """

    def __init__(self, nodes: Array) -> None:
        """Place the knots."""
        self.nodes = nodes
        first, last = np.full(_DEGREE + 1, nodes[0]), np.full(_DEGREE + 1, nodes[-1])
        self.knots: Array = np.concatenate([first, nodes[2:-2], last])

    @cached_property
    def fit(self) -> Array:
        """Coefficients of the splines by the values at the nodes, (n, n)."""
        return _spline_fit(tuple(self.nodes.tolist()))

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the interval."""
        return float(self.nodes[0]), float(self.nodes[-1])

    def dense(self, x: Array) -> Array:
        """All splines at points (m,), (m, n)."""
        splines = BSpline(self.knots, np.eye(len(self.nodes)), _DEGREE)
        return np.asarray(splines(np.clip(x, *self.ends)))


@lru_cache(maxsize=64)
def _spline_fit(nodes: tuple[float, ...]) -> Array:
    return np.asarray(make_interp_spline(nodes, np.eye(len(nodes)), k=_DEGREE).c)


@dataclass(frozen=True, slots=True)
class Polynomials:
    """Chebyshev polynomials on an interval, which vanish beyond it or keep their values.

    They are those of s, x = middle + half length * sinh(k s) / sinh(k), which resolves the middle
    as finely as is wanted; k = 0 leaves x as it is.

    Attributes:
        low, high: ends of the interval.
        count: number of polynomials.
        stretch: k.
        vanish: whether the polynomials are zero beyond the ends.
    """

    low: float
    high: float
    count: int
    stretch: float = 0.0
    vanish: bool = False

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the interval."""
        return self.low, self.high

    @property
    def nodes(self) -> Array:
        """Points at which functions are interpolated, (count,)."""
        s = chebyshev.chebpts1(self.count)
        if self.stretch:
            s = np.sinh(self.stretch * s) / math.sinh(self.stretch)
        return np.asarray(0.5 * (self.low + self.high) + 0.5 * (self.high - self.low) * s)

    @property
    def fit(self) -> Array:
        """Coefficients by the values at the nodes, (count, count)."""
        values = chebyshev.chebvander(chebyshev.chebpts1(self.count), self.count - 1)
        return np.asarray(np.linalg.inv(values))

    def dense(self, x: Array) -> Array:
        """All polynomials at points (m,), (m, count)."""
        s = (2.0 * x - self.low - self.high) / (self.high - self.low)
        outside = np.abs(s) > 1.0 + _KNOT_TOLERANCE
        s = np.clip(s, -1.0, 1.0)
        if self.stretch:
            s = np.arcsinh(s * math.sinh(self.stretch)) / self.stretch
        values = np.asarray(chebyshev.chebvander(s, self.count - 1), dtype=np.float64)
        if self.vanish:
            values[outside] = 0.0
        return values


Basis: TypeAlias = CubicSplines | Polynomials


class Frame(NamedTuple):
    """Frame about the vertical: origin (x, y) [m], cosine and sine from the sensor's x axis."""

    x: float
    y: float
    cos: float
    sin: float


class Fade(Protocol):
    """Factor of a field that varies over the plane of its frame."""

    def weight(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Factor (n,) at points of the frame (n,) [m], and its slopes along x and y (2, n)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Field of displacements [m] and further scalars on a box of the gel.

    Along x and y it consists of `bases`, over the height of Legendre polynomials. Heights beyond
    the box have the values of its faces.

    Attributes:
        bases: splines along x and y of the frame.
        height: height of the box, from 0 [m].
        coefficients: coefficients of k components, (nx, ny, nz, k).
        frame: axes about the middle of the box, at whose sides the field ends. None for the
            sensor's own, in which the bases say what is beyond.
        fade: factor of the field; 1 when omitted.
    """

    bases: tuple[Basis, Basis]
    height: float
    coefficients: Array
    frame: Frame | None = None
    fade: Fade | None = None

    @classmethod
    def from_function(
        cls,
        function: Callable[[Array], Array],
        bases: tuple[Basis, Basis],
        height: float,
        degree: int,
    ) -> "Field":
        """Interpolate a function, which gives (..., k) at points (..., 3) [m]."""
        levels = legendre.leggauss(degree + 1)[0]
        axes = [basis.nodes for basis in bases], 0.5 * height * (levels + 1.0)
        values = function(np.stack(np.meshgrid(*axes[0], axes[1], indexing="ij"), axis=-1))
        return cls.from_values(values, bases, height, levels)

    @classmethod
    def from_values(
        cls, values: Array, bases: tuple[Basis, Basis], height: float, levels: Array
    ) -> "Field":
        """Interpolate values (nx, ny, nz, k) at the nodes of the bases and at levels in [-1, 1]."""
        upright = np.linalg.inv(legendre.legvander(levels, len(levels) - 1))
        fits = [basis.fit for basis in bases]
        nx, ny, nz, k = values.shape
        fitted = (fits[0] @ values.reshape(nx, -1)).reshape(nx, ny, -1)
        return cls(bases, height, upright @ (fits[1] @ fitted).reshape(nx, ny, nz, k))

    def on_grid(self, x: Array, y: Array, z: Array) -> Array:
        """All components (nx, ny, nz, k) on a grid of the sensor's own frame [m]."""
        along, across = (basis.dense(at) for basis, at in zip(self.bases, (x, y), strict=True))
        heights = self._height_polynomials(z)[0]
        return np.asarray(
            np.einsum(
                "ai,bj,cl,ijlk->abck", along, across, heights, self.coefficients, optimize=True
            )
        )

    def rotate(self, rotation: Array) -> "Field":
        """The field whose displacements (3,) are turned by a rotation (3, 3) at their places."""
        if self.frame is not None:
            c, s = self.frame.cos, self.frame.sin
            Q = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            rotation = Q.T @ rotation @ Q
        coefficients = self.coefficients.copy()
        coefficients[..., :3] = coefficients[..., :3] @ rotation.T
        return replace(self, coefficients=coefficients)

    def values(self, columns: Array) -> Array:
        """All components (k, h, n) at columns of points (n, h, 3) [m]."""
        x, y, within = self._in_frame(columns)
        sums = self._in_plane(x, y, self.coefficients, _VALUE)
        heights, _ = self._height_polynomials(columns[..., 2])
        values = np.einsum("nzk,nhz->khn", sums[:, 0], heights) * within
        if self.frame is not None:
            c, s = self.frame.cos, self.frame.sin
            values[:2] = c * values[0] - s * values[1], s * values[0] + c * values[1]
        if self.fade is not None:
            values *= self.fade.weight(x, y)[0]
        return np.asarray(values)

    def displacement_and_gradient(self, columns: Array) -> Array:
        """Displacements [m] and their derivatives by x, y, z, (12, h, n), at columns (n, h, 3)."""
        moved = self._moved_plainly(columns)
        if self.fade is not None:
            x, y, _ = self._in_frame(columns)
            c, s = (1.0, 0.0) if self.frame is None else (self.frame.cos, self.frame.sin)
            weight, (along, across) = self.fade.weight(x, y)
            gradient = moved[3:].reshape(3, 3, *moved.shape[1:])
            gradient *= weight
            gradient[:, 0] += moved[:3] * (c * along - s * across)
            gradient[:, 1] += moved[:3] * (s * along + c * across)
            moved[:3] *= weight
        return moved

    def accumulate(self, kernels: ModuleType, points: Array, places: Array, F: Array) -> None:
        """Add the displacement to places (n, 3) [m], and its gradient to F (n, 9), at points."""
        if self.fade is not None or self.coefficients.shape[2] > _UPRIGHT:
            moved = self.displacement_and_gradient(points[:, None])[:, 0].T
            places += moved[:, :3]
            F += moved[:, 3:]
            return
        frame, half = Frame(0.0, 0.0, 1.0, 0.0), (math.inf, math.inf)
        if self.frame is not None:
            frame, half = self.frame, (self.bases[0].ends[1], self.bases[1].ends[1])
        kernels.add_field(
            tuple(map(float, frame)), half, self.height, *field_powers(self), points, places, F
        )

    def _moved_plainly(self, columns: Array) -> Array:
        x, y, within = self._in_frame(columns)
        places, orders = (x[within], y[within]), (_VALUE, (1, 0), (0, 1))
        sums = self._in_plane(*places, self.coefficients[..., :3], *orders)
        heights, rates = self._height_polynomials(columns[within, :, 2])
        parts = ((0, heights), (1, heights), (2, heights), (0, rates))
        terms = [np.einsum("nzk,nhz->khn", sums[:, part], height) for part, height in parts]
        u, G = terms[0], np.stack(terms[1:], axis=1)
        if self.frame is not None:
            c, s = self.frame.cos, self.frame.sin
            Q = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            u = np.einsum("ij,jhn->ihn", Q, u)
            G = np.einsum("ij,jkhn,lk->ilhn", Q, G, Q, optimize=True)
        moved = np.zeros((12, columns.shape[1], len(columns)))
        moved[..., within] = np.concatenate([u, G.reshape(9, *u.shape[1:])])
        return moved

    def _in_frame(self, columns: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Places of columns in the frame (n,) [m], and whether they are within a frame's box."""
        x, y = columns[:, 0, 0], columns[:, 0, 1]
        if self.frame is None:
            x, y = (
                np.clip(at, *basis.ends) if isinstance(basis, CubicSplines) else at
                for at, basis in zip((x, y), self.bases, strict=True)
            )
            return x, y, np.ones(len(x), dtype=bool)
        dx, dy = x - self.frame.x, y - self.frame.y
        x = self.frame.cos * dx + self.frame.sin * dy
        y = self.frame.cos * dy - self.frame.sin * dx
        length, width = (basis.ends[1] for basis in self.bases)
        return x, y, (np.abs(x) < length) & (np.abs(y) < width)

    def _in_plane(self, x: Array, y: Array, coefficients: Array, *orders: tuple[int, int]) -> Array:
        """Polynomials over the height, or their slopes by x and y, (n, orders, nz, k)."""
        along, across = self.bases
        if isinstance(along, CubicSplines) and isinstance(across, CubicSplines):
            knots, points = (along.knots, across.knots), np.stack([x, y], axis=-1)
            sums = NdBSpline(knots, np.ascontiguousarray(coefficients), _DEGREE)
            return np.stack([sums(points, nu=nu) for nu in orders], axis=1)
        if orders != (_VALUE,):
            raise TypeError("only splines have slopes; `NodeSums` makes them of polynomials")
        lines = along.dense(x), across.dense(y)
        powers = np.einsum("ni,nj,ijzk->nzk", *lines, coefficients, optimize=True)
        return np.asarray(powers[:, None])

    def _height_polynomials(self, z: Array) -> tuple[Array, Array]:
        """Legendre polynomials (..., nz) at heights z (...), and their derivatives [1/m]."""
        degree = self.coefficients.shape[2] - 1
        s = np.clip(2.0 * z / self.height - 1.0, -1.0, 1.0)
        values = np.asarray(legendre.legvander(s, degree), dtype=np.float64)
        slope = legendre.legder(np.eye(degree + 1))
        rates: Array = values[..., : len(slope)] @ slope * (2.0 / self.height)
        return values, rates


@lru_cache(maxsize=16)  # cells and contacts of a mesh, and scenes of one bend, follow each other
def field_powers(field: Field) -> tuple[Array, Array, Array]:
    """Knots along x and y, and coefficients (nx, ny, 3 powers) of the powers of the level.

    Levels go from -1 to 1 over the height; each power has the three components of the
    displacement.
    """
    along, across = field.bases
    if not (isinstance(along, CubicSplines) and isinstance(across, CubicSplines)):
        raise TypeError("only splines have slopes; `NodeSums` makes them of polynomials")
    nx, ny, nz, k = field.coefficients.shape
    powers = field.coefficients.reshape(nx * ny, -1) @ _powers(nz, k)
    return along.knots, across.knots, powers.reshape(nx, ny, -1)


@lru_cache(maxsize=8)
def _powers(count: int, components: int) -> Array:
    """Coefficients of the powers of three components, (count * components, 3 * count)."""
    powers = np.stack(
        [np.pad(legendre.leg2poly(e), (0, _UPRIGHT - i - 1)) for i, e in enumerate(np.eye(count))]
    )
    return np.asarray(np.kron(powers[:, :count], np.eye(components, 3)), dtype=np.float64)
