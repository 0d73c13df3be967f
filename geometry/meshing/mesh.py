"""Mesh of the conductive layer."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.patches import Contacts


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Points, cells and electrode contacts of a meshed layer.

    Hexahedra and wedges form an extrusion: a plane mesh repeated at each height. Points and cells
    are then numbered upwards first, so point `i` of the plane mesh at height `k` is point
    `i * len(heights) + k`.

    Attributes:
        points: (n, 3) [m].
        cells: (m, 8) hexahedra, (m, 6) wedges or (m, 4) tetrahedra, point numbers in VTK's order.
        contacts: pieces of cell faces in contact with the electrodes.
        heights: z of the layers of points, rising [m]; None for tetrahedra.
    """

    points: NDArray[np.float64]
    cells: NDArray[np.int64]
    contacts: Contacts
    heights: NDArray[np.float64] | None

    @property
    def electrode_facets(self) -> tuple[NDArray[np.int64], ...]:
        """Per electrode the cell faces in contact, (k, 3) or (k, 4) point numbers."""
        return self.contacts.facets
