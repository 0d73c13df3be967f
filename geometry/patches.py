"""Where electrodes touch a body: convex regions of its boundary, cut out of a mesh exactly."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A convex part of space that cuts a part out of a body's boundary.

    Attributes:
        planes: (m, 4); the set {x: planes[:, :3] @ x <= planes[:, 3]}, rows of unit normals [m].
        normal: (3,) unit vector; boundary whose outward unit normal n has n . normal > 0.5 counts.
    """

    planes: Array
    normal: Array


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """The contact area of one electrode.

    Attributes:
        regions: convex sets that do not overlap; their union cuts the electrode out of the
            boundary. Empty for a sheet.
        area: of the electrode [m2].
        sheet: (k, 3) corners in turn of a plane convex polygon inside the body [m]; None for
            an electrode on the boundary.
    """

    regions: tuple[Region, ...]
    area: float
    sheet: Array | None = None
