"""Mesh of triangular prisms: a plane outline triangulated and extruded."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.patches import electrode_contacts
from eitskin.geometry.design.placement import ContactArea, placed
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.side_contacts import Strip
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.delaunay import triangulated
from eitskin.geometry.meshing.grading import Grading, layer_heights
from eitskin.geometry.meshing.mesh import Mesh

Array = NDArray[np.float64]


def triangulated_mesh(design: SensorDesign, grading: Grading) -> Mesh:
    """Mesh a plane outline by triangular prisms whose faces fit the ends of electrodes on the side.

    Electrodes on top, at the bottom and inside are refined around their rims, not fitted.
    Points are numbered upwards first, then by rising x.

    Args:
        design: the sensor; its outline must be plane.
        grading: longest edges of the triangles, and layers.

    Raises ConfigurationError for a surface, and for more than half a million points in the plane.
    """
    outline = design.outline
    if isinstance(outline, Surface):
        raise ConfigurationError(
            "prisms need a plane outline, got a Surface; use tetrahedra for bodies of any shape"
        )
    contacts = placed(design.electrodes, outline, design.thickness)
    strips = [contact for contact in contacts if isinstance(contact, Strip)]
    ends = np.array([end for strip in strips for end in (strip.start, strip.end)])
    rims = [c.edges(np.inf if _full(c) else grading.finest) for c in contacts]
    edges = cKDTree(np.unique(np.concatenate(rims)[:, :2].round(12), axis=0))

    def size(points: Array) -> Array:
        distance, _ = edges.query(points)
        return grading.size(distance)

    plane, triangles = triangulated(outline, ends, size)
    heights = layer_heights(design, grading)
    count = len(heights)
    points = np.column_stack([np.repeat(plane, count, axis=0), np.tile(heights, len(plane))])
    lower = (triangles[:, None] * count + np.arange(count - 1)[:, None]).reshape(-1, 3)
    cells = np.hstack([lower, lower + 1])
    return Mesh(points, cells, electrode_contacts(points, cells, design.patches()), heights)


def _full(contact: ContactArea) -> bool:
    """Whether a contact covers the full thickness, so that only its ends are edges in the plane."""
    return isinstance(contact, Strip) and contact.high - contact.low >= contact.thickness
