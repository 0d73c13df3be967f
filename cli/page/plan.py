"""A sensor seen from above, for the live page: its rectangle, rim, grid and strips."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.contact_areas import Strip
from eitskin.geometry.design.outline import Disc
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface

if TYPE_CHECKING:
    from eitskin.training.pipeline.pipeline import Pipeline

Array = NDArray[np.float64]

_MARGIN = 0.0075  # m, shown around the positions on a sensor of unknown geometry
_RIM = 96  # points of an outline without corners
_MAX_PIECES = 40  # most steps along an electrode
_LINES = 10.0  # of the grid, about, along the longer side
_ROUND = np.array([1.0, 1.5, 2.0, 3.0, 5.0, 7.5, 10.0])


@dataclass(frozen=True, slots=True)
class Region:
    """Rectangle around a sensor, or around the positions on one of unknown geometry.

    Attributes:
        low, high: smallest and largest x and y [m].
    """

    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def from_design(cls, design: SensorDesign) -> "Region":
        """Bounding rectangle of a design's outline."""
        outline = design.outline
        if isinstance(outline, Surface):
            low, high = outline.bounds[:, :2].tolist()
            return cls(tuple(low), tuple(high))
        return cls((0.0, 0.0), (outline.length, outline.width))

    @classmethod
    def from_positions(cls, extent: ArrayLike, margin: float) -> "Region":
        """Rectangle around positions, smallest and largest x and y (2, 2) [m], and a margin [m]."""
        low, high = np.asarray(extent, dtype=float)
        return cls(tuple((low - margin).tolist()), tuple((high + margin).tolist()))

    @property
    def length(self) -> float:
        """Length along x [m]."""
        return self.high[0] - self.low[0]

    @property
    def width(self) -> float:
        """Width along y [m]."""
        return self.high[1] - self.low[1]

    @property
    def corners(self) -> NDArray[np.float64]:
        """Corners, counter-clockwise from the lowest (4, 2) [m]."""
        (x0, y0), (x1, y1) = self.low, self.high
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])

    def contains(self, position: Array) -> bool:
        """Whether a position (2,) [m] lies inside or on the edge."""
        return bool((position >= self.low).all() and (position <= self.high).all())


def sensor_or_region(pipeline: "Pipeline") -> SensorDesign | Region:
    """Sensor of a pipeline, or the region of the positions that it was trained with.

    Raises ConfigurationError where a pipeline shows neither.
    """
    layout = pipeline.layout
    if layout.known_design is not None:
        return layout.known_design
    if layout.extent is None:
        raise ConfigurationError(
            "expected a pipeline that knows its sensor, for the page, got touch positions of "
            "version 0.1; leave out --page, or train them again"
        )
    return Region.from_positions(layout.extent, _MARGIN)


def plan_outline(design: SensorDesign) -> Array:
    """Vertices of the body seen from above (k, 2) [m]; the convex hull for one from a file."""
    outline = design.outline
    if isinstance(outline, Surface):
        from scipy.spatial import ConvexHull

        points = outline.triangles()[0][:, :2]
        hull: Array = points[ConvexHull(points).vertices]
        return hull
    if isinstance(outline, Disc):
        return outline.rim_points(np.arange(_RIM) * (outline.perimeter / _RIM))
    return outline.vertices


def grid_spacing(length: float, width: float) -> float:
    """Distance between two lines of the grid on a sensor, a round number [m]."""
    target_spacing = max(length, width) / _LINES
    power = 10.0 ** math.floor(math.log10(target_spacing))
    return float(power * _ROUND[np.abs(np.log(_ROUND * power / target_spacing)).argmin()])


def arc_lengths(strip: Strip, spacing: float) -> Array:
    """Arc lengths along a strip (k,) [m], with those of the outline's corners within it."""
    turns = np.array([[-1.0], [0.0], [1.0]]) * strip.outline.perimeter
    corners = (turns + strip.outline.corners).ravel()
    within = corners[(corners > strip.start) & (corners < strip.end)]
    even = np.linspace(strip.start, strip.end, 1 + count_pieces(strip.end - strip.start, spacing))
    return np.unique(np.concatenate([even, within]))


def count_pieces(length: float, spacing: float) -> int:
    """Number of pieces of a length [m], each about as long as the spacing [m]."""
    return int(np.clip(np.ceil(length / spacing), 1, _MAX_PIECES))
