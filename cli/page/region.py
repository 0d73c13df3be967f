"""Rectangle of the sensor's plane that the live page shows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface


@dataclass(frozen=True, slots=True)
class Region:
    """Rectangle around a sensor, or around the positions on one of unknown geometry.

    Attributes:
        low, high: smallest and largest x and y [m].
    """

    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def around(cls, design: SensorDesign) -> "Region":
        """Bounding rectangle of a design's outline."""
        outline = design.outline
        if isinstance(outline, Surface):
            low, high = outline.bounds[:, :2].tolist()
            return cls(tuple(low), tuple(high))
        return cls((0.0, 0.0), (outline.length, outline.width))

    @classmethod
    def of_positions(cls, extent: ArrayLike, margin: float) -> "Region":
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

    def contains(self, x: float, y: float) -> bool:
        """Whether a position [m] lies inside or on the edge."""
        return self.low[0] <= x <= self.high[0] and self.low[1] <= y <= self.high[1]
