"""Mesh of a design: graded hexahedra, triangular prisms, or tetrahedra."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.contact_areas import ContactArea, Strip, contact_areas
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.inclusion import Inclusion, require_inside
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.patches import electrode_contacts
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.delaunay import triangulate
from eitskin.geometry.meshing.grading import Grading, graded_lines, require_possible
from eitskin.geometry.meshing.mesh import Mesh, check_quality

Array = NDArray[np.float64]
Lines = NDArray[np.float64]


def triangulated_mesh(
    design: SensorDesign, grading: Grading, inclusions: Sequence[Inclusion] = ()
) -> Mesh:
    """Mesh a plane outline by triangular prisms whose faces fit the ends of electrodes on the side.

    Electrodes on top, at the bottom and inside are refined around their rims, not fitted.
    Points are numbered upwards first, then by rising x.

    Args:
        design: the sensor; its outline must be plane.
        grading: longest edges of the triangles, and layers.
        inclusions: inclusions at whose rims prisms have faces.

    Raises ConfigurationError for a surface, inclusions that do not lie inside, and for more than
    half a million points in the plane.
    """
    outline = design.outline
    if isinstance(outline, Surface):
        raise ConfigurationError(
            "prisms need a plane outline, got a Surface; use tetrahedra for bodies of any shape"
        )
    contacts = contact_areas(design.electrodes, outline, design.thickness)
    strips = [contact for contact in contacts if isinstance(contact, Strip)]
    ends = np.array([end for strip in strips for end in (strip.start, strip.end)])
    rims = [c.edges(np.inf if _full(c) else grading.finest) for c in contacts]
    edges = cKDTree(np.unique(np.concatenate(rims)[:, :2].round(12), axis=0))

    def size(points: Array) -> Array:
        distance, _ = edges.query(points)
        return grading.size(distance)

    require_inside(inclusions, outline, design.thickness)
    plane, triangles = triangulate(outline, ends, size, inclusions)
    faces = [z for each in inclusions for z in (each.low, each.high or 0.0)]
    heights = layer_heights(design, grading, faces)
    count = len(heights)
    points = np.column_stack([np.repeat(plane, count, axis=0), np.tile(heights, len(plane))])
    lower = (triangles[:, None] * count + np.arange(count - 1)[:, None]).reshape(-1, 3)
    cells = np.hstack([lower, lower + 1])
    return Mesh(points, cells, electrode_contacts(points, cells, design.patches()), heights)


def _full(contact: ContactArea) -> bool:
    """Whether a contact covers the full thickness, so that only its ends are edges in the plane."""
    return isinstance(contact, Strip) and contact.high - contact.low >= contact.thickness


def structured_mesh(design: SensorDesign, grading: Grading, breaks: Sequence[float] = ()) -> Mesh:
    """Mesh a rectangular design by boxes whose faces fit the electrode edges.

    Points are numbered along z, then y, then x, so that matrices are block tridiagonal in x.

    Args:
        design: the sensor; its outline must be a Rectangle.
        grading: cell sizes.
        breaks: further x at which the mesh must have a face, as where F jumps [m].

    Raises ConfigurationError for another outline, and for too many points.

    Example:
        >>> from eitskin.geometry import SensorDesign, structured_mesh
        >>> from eitskin.geometry.meshing.grading import Grading
        >>> mesh = structured_mesh(SensorDesign.reference(), Grading(2e-3, 1e-2, 1.0))
        >>> len(mesh.cells) > 100
        True
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


def _edge_heights(electrode: Electrode, thickness: float) -> tuple[float, ...]:
    """Heights of the level edges of an electrode, where potentials are singular [m]."""
    if electrode.on == "side":
        if electrode.height is None:
            return ()
        z = 0.5 * thickness if electrode.z is None else electrode.z
        ends = (z - 0.5 * electrode.height, z + 0.5 * electrode.height)
        # At the rim of the layer the potential continues mirrored.
        return tuple(end for end in ends if 1e-9 < end / thickness < 1.0 - 1e-9)
    return (float({"top": thickness, "bottom": 0.0}.get(electrode.on, electrode.z or 0.0)),)


def level_edges(design: SensorDesign) -> set[float]:
    """Heights of the level edges of all electrodes, where potentials are singular [m]."""
    return {z for each in design.electrodes for z in _edge_heights(each, design.thickness)}


def layer_heights(design: SensorDesign, grading: Grading, faces: Sequence[float] = ()) -> Lines:
    """Heights of the layers of points, through sheets, `faces` and graded to electrode edges [m].

    Where electrodes span the full thickness, every sheet has `grading.layers` equal cells.
    """
    thickness = design.thickness
    edges = level_edges(design)
    interfaces = np.cumsum([layer.thickness for layer in design.layers])[:-1]
    within = [z for z in faces if 0.0 < z < thickness]
    interfaces = np.unique(np.concatenate([interfaces, within]).round(12))
    if edges:
        finest = grading.level or grading.finest
        largest = max(min(grading.coarsest, thickness / grading.layers), finest)
        upright = replace(grading, finest=finest, coarsest=largest)
        return graded_lines(thickness, edges, interfaces, upright)
    sheets = np.array([0.0, *interfaces, thickness])
    steps = [np.linspace(a, b, grading.layers + 1)[:-1] for a, b in itertools.pairwise(sheets)]
    return np.concatenate([*steps, [thickness]])


def electrode_lines(design: SensorDesign) -> tuple[set[float], set[float]]:
    """Positions along x and y [m] of lines through both ends of the electrodes' bounding boxes.

    The edges of the electrodes lie on these lines.
    """
    contacts = contact_areas(design.electrodes, design.outline, design.thickness)
    boxes = [contact.edges(np.inf) for contact in contacts]
    ends = np.concatenate([[box.min(axis=0), box.max(axis=0)] for box in boxes]).round(12)
    return set(ends[:, 0].tolist()), set(ends[:, 1].tolist())


CellKind = Literal["hexahedra", "prisms", "tetrahedra"]


def natural_cells(design: SensorDesign) -> CellKind:
    """Default kind of cells of a design.

    Hexahedra for rectangles, prisms for other plane outlines, tetrahedra for surfaces.
    """
    if isinstance(design.outline, Surface):
        return "tetrahedra"
    return "hexahedra" if isinstance(design.outline, Rectangle) else "prisms"


def mesh_design(
    design: SensorDesign,
    grading: Grading,
    cells: CellKind | None = None,
    breaks: Sequence[float] = (),
    inclusions: Sequence[Inclusion] = (),
) -> Mesh:
    """Mesh a design and check the quality of the cells.

    Args:
        design: the sensor.
        grading: cell sizes.
        cells: kind of cells; `natural_cells(design)` when omitted.
        breaks: further x at which hexahedra have faces [m]; other cells ignore them.
        inclusions: inclusions at whose rims prisms have faces.

    Raises:
        ConfigurationError: where the cells cannot fill the outline, or some are misshapen.
        ImportError: for tetrahedra without the extra "mesh".
    """
    cells = cells or natural_cells(design)
    if cells not in get_args(CellKind):
        raise ConfigurationError(
            f"cells must be one of {', '.join(get_args(CellKind))}, got {cells!r}"
        )
    if inclusions and cells != "prisms":
        raise ConfigurationError(
            f"only prisms have faces at the rims of inclusions, got cells={cells!r}; leave cells "
            "out, and give bodies from surface files meshes of their own"
        )
    if cells == "hexahedra":
        mesh = structured_mesh(design, grading, breaks)
    elif cells == "prisms":
        mesh = triangulated_mesh(design, grading, inclusions)
    else:
        from eitskin.geometry.meshing.tetrahedra import tetrahedral_mesh

        mesh = tetrahedral_mesh(design, grading)
    check_quality(mesh)
    return mesh
