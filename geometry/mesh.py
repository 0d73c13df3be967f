"""A mesh of the conductive layer and the facets on which its electrodes sit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Points, cells and electrode facets.

    The mesh is an extrusion: a plane mesh repeated at each height. Points and cells are numbered
    upwards first, so point `i` of the plane mesh at height `k` is point `i * len(heights) + k`.

    Attributes:
        points: (n, 3) [m].
        cells: (m, 8) hexahedra, point numbers in VTK's order.
        electrode_facets: per electrode (k, 4) quadrilaterals, point numbers around the facet.
        heights: z of the layers of points, rising [m].
    """

    points: NDArray[np.float64]
    cells: NDArray[np.int64]
    electrode_facets: tuple[NDArray[np.int64], ...]
    heights: NDArray[np.float64]
