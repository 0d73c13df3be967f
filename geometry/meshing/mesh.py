"""Mesh of the conductive layer, the quality of its cells, and a check that refuses bad ones."""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.patches import FACES, Contacts

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
# For every corner of a cell the corners at the other ends of its three edges, right-handed.
_CORNERS = {
    8: [[1, 3, 4], [2, 0, 5], [3, 1, 6], [0, 2, 7], [7, 5, 0], [4, 6, 1], [5, 7, 2], [6, 4, 3]],
    6: [[1, 2, 3], [2, 0, 4], [0, 1, 5], [5, 4, 0], [3, 5, 1], [4, 3, 2]],
    4: [[1, 2, 3], [2, 0, 3], [0, 1, 3], [1, 0, 2]],
}
# Scales that make the ideal cell's value 1: cube, upright equilateral prism, regular tetrahedron.
_IDEAL = {8: 1.0, 6: 2.0 / np.sqrt(3.0), 4: np.sqrt(2.0)}
# A scaled Jacobian of 10^-k costs a linear solver about k digits.
_MIN_SCALED_JACOBIAN = 1e-3


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

    Example:
        >>> from eitskin.geometry import SensorDesign, structured_mesh
        >>> from eitskin.geometry.meshing.grading import Grading
        >>> mesh = structured_mesh(SensorDesign.reference(), Grading(2e-3, 1e-2, 1.0))
        >>> mesh.points.shape[1], mesh.cells.shape[1]
        (3, 8)
    """

    points: NDArray[np.float64]
    cells: NDArray[np.int64]
    contacts: Contacts
    heights: NDArray[np.float64] | None

    @property
    def electrode_facets(self) -> tuple[NDArray[np.int64], ...]:
        """Per electrode the cell faces in contact, (k, 3) or (k, 4) point numbers."""
        return self.contacts.facets


@dataclass(frozen=True, slots=True)
class Quality:
    """Size of a mesh and quality of its worst cells.

    Attributes:
        cells, points: numbers of cells and points.
        volume: volume of all cells [m3].
        scaled_jacobian: least over all cells and corners of the determinant of the three unit
            edge vectors; 1 for cubes, equilateral prisms and regular tetrahedra, not above 0 for
            an inverted cell (Verdict: "scaled Jacobian").
        worst: number of the cell with the least scaled Jacobian.
        aspect_ratio: greatest over all cells of longest to shortest edge (Verdict: "edge ratio").
        median_aspect_ratio: the same for the median cell.
        smallest_angle, largest_angle: angle between two faces of a cell [degree] (Verdict:
            "dihedral angle").
    """

    cells: int
    points: int
    volume: float
    scaled_jacobian: float
    worst: int
    aspect_ratio: float
    median_aspect_ratio: float
    smallest_angle: float
    largest_angle: float


def quality(mesh: Mesh) -> Quality:
    """Size and quality of a mesh.

    Formulas: Stimpson et al., The Verdict Geometric Quality Library, SAND2007-1751, as in VTK;
    for hexahedra without its extra value at the centre.
    """
    shapes = scaled_jacobians(mesh.points, mesh.cells)
    corners = mesh.points[mesh.cells]
    ratios, angles = _edge_ratios(corners), _dihedral_angles(corners)
    return Quality(
        cells=len(mesh.cells),
        points=len(mesh.points),
        volume=float(volumes(mesh.points, mesh.cells).sum()),
        scaled_jacobian=float(shapes.min()),
        worst=int(shapes.argmin()),
        aspect_ratio=float(ratios.max()),
        median_aspect_ratio=float(np.median(ratios)),
        smallest_angle=float(angles.min()),
        largest_angle=float(angles.max()),
    )


def check_quality(mesh: Mesh, quality: float = _MIN_SCALED_JACOBIAN) -> None:
    """Raise ConfigurationError where a cell is inverted or degenerate, or a point not finite.

    Args:
        mesh: any mesh. Thin boxes and prisms pass: their edges are upright on each other.
        quality: scaled Jacobian that every cell must have.
    """
    lost = np.flatnonzero(~np.isfinite(mesh.points).all(axis=1))
    if len(lost):
        raise ConfigurationError(
            f"point {lost[0]} of the mesh, and {len(lost) - 1} others, are not finite: "
            f"{mesh.points[lost[0]]}; check the outline and the deformation for sizes out of range"
        )
    shapes = scaled_jacobians(mesh.points, mesh.cells)
    worst = int(shapes.argmin())
    if shapes[worst] < quality:
        x, y, z = mesh.points[mesh.cells[worst]].mean(axis=0)
        state = "inverted" if shapes[worst] < 0.0 else "degenerate"
        raise ConfigurationError(
            f"{(shapes < quality).sum()} of {len(shapes)} cells are inverted or degenerate; the "
            f"worst, cell {worst} at ({x:.6g}, {y:.6g}, {z:.6g}) m, is {state} with a scaled "
            f"Jacobian of {shapes[worst]:.3g}, at least {quality:g} is needed. Give the mesh other "
            "sizes there, or move electrode ends that nearly meet each other or a corner"
        )


def scaled_jacobians(points: Array, cells: Numbers) -> Array:
    """Least scaled Jacobian of each cell, (m,); 0 where an edge has no length."""
    kind = cells.shape[1]
    corners = points[cells]
    shapes = np.full(len(corners), np.inf)
    for corner, ends in enumerate(_CORNERS[kind]):
        edges = corners[:, ends] - corners[:, corner, None]
        volume = np.einsum("ni,ni->n", np.cross(edges[:, 0], edges[:, 1]), edges[:, 2])
        lengths = np.linalg.norm(edges, axis=2).prod(axis=1)
        shape = np.divide(volume, lengths, out=np.zeros_like(volume), where=lengths > 0.0)
        np.minimum(shapes, shape, out=shapes)
    shapes *= _IDEAL[kind]
    return shapes


def volumes(points: Array, cells: Numbers) -> Array:
    """Volume of each cell (m,) [m3], negative when inverted (divergence theorem)."""
    corners = points[cells]
    middle = corners.mean(axis=1)
    total = np.zeros(len(corners))
    for area, face in zip(_face_vectors(corners), FACES[cells.shape[1]], strict=True):
        total += np.einsum("ni,ni->n", area, corners[:, face[0]] - middle) / 3.0
    return total


def _edge_ratios(corners: Array) -> Array:
    """Longest over shortest edge of each cell, (m,)."""
    pairs = {
        tuple(sorted((a, b))) for a, ends in enumerate(_CORNERS[corners.shape[1]]) for b in ends
    }
    ends = np.array(sorted(pairs))
    lengths = np.linalg.norm(corners[:, ends[:, 0]] - corners[:, ends[:, 1]], axis=2)
    with np.errstate(divide="ignore"):
        ratios: Array = lengths.max(axis=1) / lengths.min(axis=1)
    return ratios


def _dihedral_angles(corners: Array) -> Array:
    """Angles between faces that share an edge, (m, edges) [degree]."""
    faces = FACES[corners.shape[1]]
    tiny = np.finfo(float).tiny
    normals = [
        v / np.maximum(np.linalg.norm(v, axis=1), tiny)[:, None] for v in _face_vectors(corners)
    ]
    angles = [
        180.0 - np.degrees(np.arccos(np.clip((normals[a] * normals[b]).sum(axis=1), -1.0, 1.0)))
        for a, b in itertools.combinations(range(len(faces)), 2)
        if len(np.intersect1d(faces[a], faces[b])) == 2
    ]
    return np.column_stack(angles)


def _face_vectors(corners: Array) -> list[Array]:
    """Area times outward normal (m, 3) [m2] of each face of cells with `corners` (m, k, 3)."""
    vectors = []
    for face in FACES[corners.shape[1]]:
        # Half the cross product of the diagonals; of two edges for a triangle.
        a, b, c, d = (corners[:, k] for k in (*face, face[-1])[:4])
        vectors.append(0.5 * np.cross(c - a, d - b))
    return vectors
