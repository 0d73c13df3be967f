"""Pixel grid of a plane outline: squares over the bounding box, and those inside the outline."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, vstack
from scipy.spatial import cKDTree

from eitskin.bounds import MOST
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Outline, PlaneOutline
from eitskin.geometry.design.surface import Surface

Array = NDArray[np.float64]

PIXELS = 2250  # squares of 2 mm on the reference sensor
MOST_PIXELS = 40_000


@dataclass(frozen=True, eq=False)
class PixelGrid:
    """Pixels of a picture, rows along y and columns along x, over the bounding box of an outline.

    A pixel is inside where its centre is. P counts the pixels inside, in the order of the rows.

    Attributes:
        outline: of the sensor.
        shape: number of rows and of columns.
    """

    outline: PlaneOutline
    shape: tuple[int, int]

    @classmethod
    def of(cls, outline: Outline, pixels: int = PIXELS) -> "PixelGrid":
        """Grid of about `pixels` squares on the bounding box.

        Raises ConfigurationError for a surface, which has no picture in the plane, and for a number
        that is out of range.
        """
        if isinstance(outline, Surface):
            raise ConfigurationError(
                "expected a plane outline (rectangle, disc or polygon) for a picture, got a "
                "surface; its sensitivity by cells is that of ForwardModel.sensitivity"
            )
        if not 4 <= pixels <= MOST_PIXELS:
            raise ConfigurationError(f"pixels must be from 4 to {MOST_PIXELS}, got {pixels}")
        side = math.sqrt(outline.length * outline.width / pixels)
        rows, columns = (max(1, round(extent / side)) for extent in (outline.width, outline.length))
        return cls(outline, (rows, columns))

    def __len__(self) -> int:
        """Number of pixels inside, P."""
        return len(self.centres)

    @property
    def sides(self) -> tuple[float, float]:
        """Extents of a pixel along x and y [m]."""
        rows, columns = self.shape
        return self.outline.length / columns, self.outline.width / rows

    @property
    def area(self) -> float:
        """Area of a pixel [m2]."""
        return math.prod(self.sides)

    @cached_property
    def x(self) -> Array:
        """Centres of the columns, (columns,) [m]."""
        return np.asarray((np.arange(self.shape[1]) + 0.5) * self.sides[0], dtype=np.float64)

    @cached_property
    def y(self) -> Array:
        """Centres of the rows, (rows,) [m]."""
        return np.asarray((np.arange(self.shape[0]) + 0.5) * self.sides[1], dtype=np.float64)

    @cached_property
    def _points(self) -> Array:
        """Centres of all pixels, (rows, columns, 2) [m]."""
        return np.stack(np.meshgrid(self.x, self.y), axis=-1)

    @cached_property
    def inside(self) -> NDArray[np.bool_]:
        """Mask of the pixels inside, (rows, columns)."""
        return self.outline.contains(self._points)

    @cached_property
    def centres(self) -> Array:
        """Centres of the pixels inside, (P, 2) [m]."""
        centres: Array = self._points[self.inside]
        return centres

    @property
    def middle(self) -> int:
        """Number of the pixel inside that is nearest to the mean of all."""
        away = np.linalg.norm(self.centres - self.centres.mean(axis=0), axis=1)
        return int(away.argmin())

    def image(self, values: ArrayLike) -> Array:
        """Pictures (..., rows, columns) from values (..., P) of the pixels inside; NaN outside."""
        inner = np.asarray(values, dtype=float)
        picture = np.full((*inner.shape[:-1], *self.shape), np.nan)
        picture[..., self.inside] = inner
        return picture

    def gathered(self, columns: NDArray[np.floating]) -> Array:
        """Sums (..., P) of values (..., rows * columns) of all pixels, such as a Jacobian's.

        A pixel that the rim cuts and whose centre is outside adds to the nearest pixel inside.
        """
        _, nearest = cKDTree(self.centres).query(self._points.reshape(-1, 2))
        count = self.inside.size
        share = csr_array((np.ones(count), (np.arange(count), nearest)), (count, len(self)))
        sums: Array = (share.T @ columns.reshape(-1, count).T).T
        return sums.reshape(*columns.shape[:-1], len(self))

    @cached_property
    def differences(self) -> csr_array:
        """Differences of neighbours per pixel side, (2 P, P): along x first, then along y.

        Zero for a pixel without a neighbour to its right or above, which leaves no flux through the
        rim.
        """
        number = np.full(self.shape, -1)
        number[self.inside] = np.arange(len(self))
        neighbours = ((number[:, :-1], number[:, 1:]), (number[:-1], number[1:]))
        parts = []
        for own, other in neighbours:
            both = (own >= 0) & (other >= 0)
            ends = np.concatenate([own[both], other[both]])
            signs = np.repeat([-1.0, 1.0], both.sum())
            entries = (signs, (np.tile(own[both], 2), ends))
            parts.append(csr_array(entries, shape=(len(self), len(self))))
        return csr_array(vstack(parts))

    def discs(self, centres: ArrayLike, radius: float) -> Array:
        """Share of each pixel that lies in a disc, (n, P), for centres (n, 2) [m], radius [m].

        Exact for pixels far from the rim of the disc; at the rim linear in the distance over one
        pixel's side, and of the disc's area in sum where the disc lies inside the outline.
        Raises ConfigurationError for numbers that are no place or radius.
        """
        places = np.asarray(centres, dtype=float)
        if not (np.all(np.abs(places) <= MOST) and 0.0 <= radius <= MOST):
            raise ConfigurationError(f"discs need finite centres and a radius in m, got {radius}")
        away = np.linalg.norm(places[:, None] - self.centres, axis=2)
        shares: Array = np.clip((radius - away) / math.sqrt(self.area) + 0.5, 0.0, 1.0)
        return shares
