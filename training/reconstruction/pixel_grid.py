"""Pixels of images of an outline: linear model, figures of merit, and regions of an image."""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, vstack
from scipy.spatial import cKDTree

from eitskin.bounds import LEAST, MOST, require_axes
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import old_names
from eitskin.geometry.design.outline import Outline, PlaneOutline
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.mesh_body import MeshOutline
from eitskin.protocol import Protocol

if TYPE_CHECKING:
    from eitskin.simulator.electrical.forward_model import ForwardModel
    from eitskin.simulator.electrical.resolution import Discretisation, Resolution


Array = NDArray[np.float64]

PIXELS = 2250  # squares of 2 mm on the reference sensor
MAX_PIXELS = 40_000
AMPLITUDE_SHARE = 0.25  # of the largest value, from which on pixels belong to the found blob
MIN_SHARE = 0.3  # of the picture's largest change, below which the other sign is none
EDGE_SHARE = 0.6  # of a region's largest change, at its edge, since images are wider than changes
MIN_AREA = 0.003  # of the sensor, below which a region is none


@old_names(gathered="sum_pixels", of="from_outline")
@dataclass(frozen=True, eq=False)
class PixelGrid:
    """Pixels of an image, rows along y and columns along x, over the bounding box of an outline.

    A pixel is inside where its centre is. P counts the pixels inside, in the order of the rows.

    Attributes:
        outline: outline of the sensor.
        shape: number of rows and of columns.

    Example:
        >>> from eitskin.geometry import Rectangle
        >>> from eitskin.training import PixelGrid
        >>> PixelGrid.from_outline(Rectangle(0.150, 0.060), 400).shape
        (13, 32)
    """

    outline: PlaneOutline | MeshOutline
    shape: tuple[int, int]

    @classmethod
    def from_outline(cls, outline: Outline | MeshOutline, pixels: int = PIXELS) -> "PixelGrid":
        """Grid of about `pixels` squares on the bounding box.

        Raises ConfigurationError for a surface, which has no image in the plane, and for a number
        that is out of range.
        """
        if isinstance(outline, Surface):
            raise ConfigurationError(
                "expected a plane outline (rectangle, disc or polygon) for a picture, got a "
                "surface; its sensitivity by cells is that of ForwardModel.sensitivity"
            )
        if not 4 <= pixels <= MAX_PIXELS:
            raise ConfigurationError(f"pixels must be from 4 to {MAX_PIXELS}, got {pixels}")
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
        x: Array = np.asarray((np.arange(self.shape[1]) + 0.5) * self.sides[0])
        return x + self.outline.corner[0]

    @cached_property
    def y(self) -> Array:
        """Centres of the rows, (rows,) [m]."""
        y: Array = np.asarray((np.arange(self.shape[0]) + 0.5) * self.sides[1])
        return y + self.outline.corner[1]

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
        """Images (..., rows, columns) from values (..., P) of the pixels inside; NaN outside."""
        inner = np.asarray(values, dtype=float)
        require_axes("values", inner, len(self))
        picture = np.full((*inner.shape[:-1], *self.shape), np.nan)
        picture[..., self.inside] = inner
        return picture

    def sum_pixels(self, columns: NDArray[np.floating]) -> Array:
        """Sums (..., P) of values (..., rows * columns) of all pixels, such as a Jacobian's.

        A pixel that the rim cuts and whose centre is outside adds to the nearest pixel inside.
        """
        require_axes("columns", columns, self.inside.size)
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
            both_inside = (own >= 0) & (other >= 0)
            ends = np.concatenate([own[both_inside], other[both_inside]])
            signs = np.repeat([-1.0, 1.0], both_inside.sum())
            entries = (signs, (np.tile(own[both_inside], 2), ends))
            parts.append(csr_array(entries, shape=(len(self), len(self))))
        return csr_array(vstack(parts))

    def discs(self, centres: ArrayLike, radius: float) -> Array:
        """Share of each pixel that lies in a disc, (n, P), for centres (n, 2) [m], radius [m].

        Exact for pixels far from the rim of the disc; at the rim linear in the distance over one
        pixel's side, and of the disc's area in sum where the disc lies inside the outline.
        Raises ConfigurationError for numbers that are no position or radius.
        """
        places = np.asarray(centres, dtype=float)
        require_axes("centres", places, None, 2)
        if not (np.all(np.abs(places) <= MOST) and 0.0 <= radius <= MOST):
            raise ConfigurationError(f"discs need finite centres and a radius in m, got {radius}")
        away = np.linalg.norm(places[:, None] - self.centres, axis=2)
        shares: Array = np.clip((radius - away) / math.sqrt(self.area) + 0.5, 0.0, 1.0)
        return shares


@dataclass(frozen=True, slots=True)
class FiguresOfMerit:
    """Figures of merit of one image of one small target (Adler et al. 2009).

    The blob is the set of pixels of at least a quarter of the image's largest value, and the
    circle is that of the blob's area about its centroid.

    Attributes:
        amplitude: integral of the image over that of the target; ideally the same for every
            position.
        shift: shift from the target's centre to the blob's centroid, along x and y [m].
        resolution: square root of the blob's area over the sensor's; small is sharp.
        shape_deformation: share of the blob outside the circle, 0 to 1.
        ringing: values of the wrong sign outside the circle, relative to the sum within.

    Example:
        >>> from eitskin.training import FiguresOfMerit
        >>> FiguresOfMerit(1.0, (0.0, 0.001), 0.2, 0.05, 0.1).resolution
        0.2
    """

    amplitude: float
    shift: tuple[float, float]
    resolution: float
    shape_deformation: float
    ringing: float

    @property
    def position_error(self) -> float:
        """Distance from the target's centre to the blob's centroid [m]."""
        return math.hypot(*self.shift)


def figures_of_merit(
    values: ArrayLike, grid: PixelGrid, centre: tuple[float, float], integral: float
) -> FiguresOfMerit:
    """Figures of merit of an image of one target.

    Args:
        values: values of the pixels inside the outline (P,).
        grid: the pixels.
        centre: centre of the target [m].
        integral: integral of the target's change over its area, signed [m2].

    Raises:
        DataError: for an image without values of the target's sign, and for numbers that are not
            finite or too large or small to divide by.

    Example:
        >>> import numpy as np
        >>> from eitskin.geometry import Disc
        >>> from eitskin.training import PixelGrid, figures_of_merit
        >>> grid = PixelGrid.from_outline(Disc(0.050), 900)
        >>> values = np.zeros(716)
        >>> values[350:353] = 1.0
        >>> figures_of_merit(values, grid, (0.050, 0.050), 0.005).amplitude > 0
        True
    """
    numbers = np.array([*np.ravel(values), *centre], dtype=float)
    if not (np.all(np.abs(numbers) <= MOST) and LEAST <= abs(integral) <= MOST):
        raise DataError(
            f"expected a picture and a centre up to {MOST:g}, and an integral from {LEAST:g}, got "
            f"{np.abs(numbers).max(initial=0.0):g} and {integral:g}"
        )
    picture = np.asarray(values, dtype=float)
    require_axes("values", picture, len(grid), more=False)
    picture = picture * math.copysign(1.0, integral)
    largest = float(picture.max(initial=0.0))
    if not largest > 0.0:
        raise DataError("expected a picture with values of the target's sign, got none")
    blob = picture >= AMPLITUDE_SHARE * largest
    centroid = grid.centres[blob].mean(axis=0)
    radius = math.sqrt(blob.sum() * grid.area / math.pi)
    circle = np.linalg.norm(grid.centres - centroid, axis=1) <= radius
    wrong = np.minimum(picture[~circle], 0.0).sum()
    within = float(picture[circle].sum())
    return FiguresOfMerit(
        amplitude=float(picture.sum()) * grid.area / abs(integral),
        shift=(float(centroid[0] - centre[0]), float(centroid[1] - centre[1])),
        resolution=math.sqrt(blob.sum() / len(grid)),
        shape_deformation=float((blob & ~circle).sum() / blob.sum()),
        ringing=-float(wrong) / within if within > 0.0 else math.inf,
    )


class PictureRegion(NamedTuple):
    """Connected part of an image.

    Attributes:
        sign: -1 for lower conductivity, +1 for higher.
        area: [m2].
        centre: x and y [m].
        change: mean relative change of conductivity, whose values are at least -1.
    """

    sign: int
    area: float
    centre: tuple[float, float]
    change: float


def segment(values: Array, grid: PixelGrid) -> NDArray[np.int8]:
    """Classes -1, 0 and +1 of an image (rows, columns), 0 outside the outline, too.

    Regions reach to `EDGE_SHARE` of their own largest change; small ones are left out. A sign whose
    changes are small next to the other's is none.
    """
    from scipy import ndimage  # which few commands need

    inside = np.nan_to_num(values)
    classes = np.zeros(values.shape, dtype=np.int8)
    for sign in (-1, 1):
        part = np.maximum(sign * inside, 0.0)
        if part.max() <= MIN_SHARE * np.abs(inside).max():
            continue
        labels, count = ndimage.label(part > MIN_SHARE * part.max())
        for label in range(1, count + 1):
            own = np.where(labels == label, part, 0.0)
            region = own > EDGE_SHARE * own.max()
            if region.sum() >= MIN_AREA * len(grid):
                classes[region] = sign
    return classes


def picture_regions(values: Array, grid: PixelGrid) -> list[PictureRegion]:
    """Regions of an image (rows, columns), the largest first."""
    from scipy import ndimage  # which few commands need

    classes, regions = segment(values, grid), []
    for sign in (-1, 1):
        labels, count = ndimage.label(classes == sign)
        for label in range(1, count + 1):
            mine = (labels == label)[grid.inside]
            x, y = grid.centres[mine].mean(axis=0).tolist()
            change = float(np.maximum(values[grid.inside][mine], -1.0).mean())
            regions.append(PictureRegion(sign, float(mine.sum() * grid.area), (x, y), change))
    return sorted(regions, key=lambda region: -region.area)


@dataclass(frozen=True, slots=True, eq=False)
class LinearModel:
    """Measurements of the flat, untouched sensor to first order in the conductivity of pixels.

    Attributes:
        impedance: impedance at the nominal conductivity (measurements,) [ohm].
        sensitivity: derivative by the logarithm of each pixel's conductivity, (measurements,
            pixels) [ohm]; all pixels of the bounding box, row by row.
    """

    impedance: NDArray[np.inexact]
    sensitivity: NDArray[np.inexact]

    @property
    def relative(self) -> Array:
        """Relative Jacobian (measurements, pixels), d log R / d log sigma, dimensionless."""
        R = np.real(self.impedance)
        J: Array = np.real(self.sensitivity).astype(float) / R[:, None]
        return J


@lru_cache(maxsize=4)  # several pipelines and pictures are made for one sensor
def linear_model(
    design: "SensorDesign | ForwardModel",
    protocol: Protocol,
    pixels: tuple[int, int],
    resolution: "Resolution | Discretisation" = "fast",
) -> LinearModel:
    """Linear model of the nominal sensor; all callers share the arrays.

    dR = - int grad u_drive . sigma grad u_sense d sigma / sigma (adjoint method, Geselowitz 1971).

    Args:
        design: the sensor, or a model of it, whose resolution then counts.
        protocol: the measurements.
        pixels: number of rows along y and of columns along x.
        resolution: resolution of the forward model.
    """
    # A trained pipeline runs without: this takes longer to import than all the rest of it.
    from eitskin.simulator.electrical.sensor_impedances import model_family

    def conductivity(x: Array) -> Array:
        own = design if isinstance(design, SensorDesign) else design.design
        return np.asarray(own.evaluate_conductivity(x))[..., None, None] * np.eye(3)

    if isinstance(design, SensorDesign):
        model, sigma = model_family(design, resolution).base, conductivity
    else:
        model, sigma = design, None
    cells = np.asarray(getattr(model.design, "conductivity", 0.0))
    along = cells if cells.ndim == 1 else conductivity
    sensitivity = model.sensitivity(protocol, sigma, pixels, along=along)
    impedance = protocol.measure(model.impedance(sigma))
    for values in (sensitivity, impedance):
        values.flags.writeable = False
    return LinearModel(impedance, sensitivity)
