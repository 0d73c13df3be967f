"""Indenter from a file: the lower side of a convex body, averaged about its axis."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.scene.indenters import Profile

Array = NDArray[np.float64]

_RADII, _AZIMUTHS = 48, 72
_UPRIGHT = 0.02  # facets of the hull whose normals point down by less are its wall
_ROUND = 0.1  # largest difference of height round the axis, of the radius


@dataclass(frozen=True, slots=True)
class ScannedIndenter:
    """Lower side of the convex hull of a closed surface, such as a scanned fingertip.

    The axis is upright through the lowest point, z up. Presses are those of bodies of revolution:
    heights are averaged round the axis.

    Attributes:
        file: path of the surface (STL, OBJ, PLY, OFF ...); made absolute.
        scale: metres per unit of the file, 1e-3 for millimetres.
        rough: whether the indenter sticks to the touched face.
    """

    file: Path
    scale: float = 1.0
    rough: bool = True

    def __post_init__(self) -> None:
        """Load the surface; raises ConfigurationError where the surface is no indenter."""
        object.__setattr__(self, "file", Path(self.file).absolute())
        self._profile()

    @property
    def rims(self) -> tuple[float, float]:
        """Smallest and largest radius at which contact may end under any load [m]."""
        return self._profile().rims

    def profile(self, r: Array) -> tuple[Array, Array, Array]:
        """Height h(r) over the lowest point [m], dh/dr, and d2h/dr2 [1/m] at distance r [m]."""
        return self._profile().profile(r)

    def _profile(self) -> Profile:
        return _of_surface(Surface(self.file, self.scale), self.rough)


@lru_cache(maxsize=16)
def _of_surface(surface: Surface, rough: bool) -> Profile:
    """Mean profile of the hull; raises ConfigurationError where the hull is far from round."""
    points, _ = surface.triangles()
    hull = ConvexHull(points)
    corners = points[hull.vertices]
    low = corners[corners[:, 2] < corners[:, 2].min() + 1e-6 * np.ptp(corners[:, 2])]
    tip = (low.min(axis=0) + low.max(axis=0)) / 2.0
    azimuth = np.arange(_AZIMUTHS) * (2.0 * np.pi / _AZIMUTHS)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth)])
    # Largest radius that the body reaches in every direction.
    radius = float(((corners - tip)[:, :2] @ directions).max(axis=0).min())
    if radius <= 0.0:
        raise ConfigurationError(
            f"the indenter in {surface.file.name} must reach outwards from its lowest point in "
            "every direction; turn it so that it presses, downwards, with the side that is meant to"
        )
    r = np.linspace(0.0, radius, _RADII)
    # The lower side of a convex body is the highest of the planes of its lower facets.
    normals, offset = hull.equations[:, :3], hull.equations @ np.append(tip, 1.0)
    under = normals[:, 2] < -_UPRIGHT
    along = normals[under, :2] @ directions
    planes = -(np.multiply.outer(r, along) + offset[under, None]) / normals[under, 2, None]
    heights = np.maximum(planes.max(axis=1), 0.0)
    spread = np.ptp(heights, axis=1).max()
    if spread > _ROUND * radius:
        raise ConfigurationError(
            f"the indenter in {surface.file.name} must be round about an upright axis through its "
            f"lowest point, z up: its height differs by {spread:.2g} m round the axis, more than "
            f"{_ROUND:.0%} of its radius of {radius:.2g} m. Turn it, or give a cylinder, sphere "
            "or profile near it"
        )
    mean = heights.mean(axis=1)
    return Profile(tuple(r.tolist()), tuple((mean - mean[0]).tolist()), rough)
