"""Structured mesh of hexahedra, graded to the electrode edges."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.patches import electrode_contacts
from eitskin.geometry.design.placement import placed
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading, graded_lines, layer_heights, require_possible
from eitskin.geometry.meshing.mesh import Mesh

Lines = NDArray[np.float64]


def structured_mesh(design: SensorDesign, grading: Grading, breaks: Sequence[float] = ()) -> Mesh:
    """Mesh a rectangular design by boxes whose faces fit the electrode edges.

    Points are numbered along z, then y, then x, so that matrices are block tridiagonal in x.

    Args:
        design: the sensor; its outline must be a Rectangle.
        grading: cell sizes.
        breaks: further x at which the mesh must have a face, as where F jumps [m].

    Raises ConfigurationError for another outline, and for too many points.
    """
    if not isinstance(design.outline, Rectangle):
        raise ConfigurationError(
            "structured hexahedra need a rectangular outline, got "
            f"{type(design.outline).__name__}; use prisms or tetrahedra"
        )
    along, across = electrode_lines(design)
    lines = (
        graded_lines(design.outline.length, along, breaks, grading),
        graded_lines(design.outline.width, across, (), grading),
        layer_heights(design, grading),
    )
    shape = tuple(len(line) for line in lines)
    require_possible(float(np.prod(shape, dtype=float)), grading)
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(points)).reshape(shape)
    lower, upper = number[:, :, :-1], number[:, :, 1:]
    corners = [
        corner
        for plane in (lower, upper)
        for corner in (plane[:-1, :-1], plane[1:, :-1], plane[1:, 1:], plane[:-1, 1:])
    ]
    cells = np.stack(corners, axis=-1).reshape(-1, 8)
    return Mesh(points, cells, electrode_contacts(points, cells, design.patches()), lines[2])


def electrode_lines(design: SensorDesign) -> tuple[set[float], set[float]]:
    """Positions along x and y [m] of lines through both ends of the electrodes' bounding boxes.

    The edges of the electrodes lie on these lines.
    """
    contacts = placed(design.electrodes, design.outline, design.thickness)
    boxes = [contact.edges(np.inf) for contact in contacts]
    ends = np.concatenate([[box.min(axis=0), box.max(axis=0)] for box in boxes]).round(12)
    return set(ends[:, 0].tolist()), set(ends[:, 1].tolist())
