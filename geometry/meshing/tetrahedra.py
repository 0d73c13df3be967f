"""Mesh of tetrahedra for bodies of any shape, by fTetWild."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from eitskin.errors import ConfigurationError
from eitskin.extras import require
from eitskin.geometry.design.outline import Disc, Outline
from eitskin.geometry.design.patches import boundary_faces, electrode_contacts
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.delaunay import layer_surface, numbered_along_x
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import Mesh, scaled_jacobians, volumes

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

_CHORDS = 60  # of a circle, before points of its rim are put on it
_FACES = 16.0  # least edges of triangles along the body's longer side
_SPACING = 2.0  # of points along electrode edges, relative to the finest size
_AT_EDGES = 0.7  # of the size along electrode edges, where fTetWild gives 1.4 times as much
# fTetWild samples the surface at distances of its envelope, so that a small one takes long: the
# reference slab 4 s at 2e-3 of the diagonal, 100 s at 1e-4.
_WIDEST_ENVELOPE, _SLIMMEST_ENVELOPE = 2e-3, 1e-4
_REACH = 1.25  # of the snapping, in envelopes: a point near an edge is off two faces
_MAX_CELLS = 300_000
_SHARP = np.radians(30.0)  # of the angle between normals, or directions of edges
_POOR = 0.05  # scaled Jacobian below which no moved cell may fall


def tetrahedral_mesh(design: SensorDesign, grading: Grading) -> Mesh:
    """Mesh any body by tetrahedra, fine at the electrode edges (Hu et al. 2020, fTetWild).

    fTetWild may move the boundary by its envelope, here a quarter of the finest size at most;
    points of the boundary are then put back on the body's faces, edges and corners. Points are
    numbered by rising x. Interfaces between layers of different conductivity are not fitted.

    Two runs give different meshes of the same sizes and quality: fTetWild cannot be seeded, so
    that the simulator stores each.

    Args:
        design: the sensor.
        grading: edge lengths; `layers` is not used.

    Raises:
        ConfigurationError: where meshing at such small sizes would take many minutes, or where no
            mesh of the body was found.
        ImportError: where pytetwild is missing.
    """
    points, cells = tetrahedral_body(design, grading, design.edges(_SPACING * grading.finest))
    return Mesh(points, cells, electrode_contacts(points, cells, design.patches()), None)


def tetrahedral_body(design: SensorDesign, grading: Grading, edges: Array) -> tuple[Array, Numbers]:
    """Points (n, 3) [m] and corners (m, 4) of tetrahedra that fill the body.

    As `tetrahedral_mesh`, but without electrodes, and fine at points `edges` (k, 3) [m], which
    lie at distances of about twice the finest size.
    """
    tetwild = require("pytetwild", "mesh")
    surface = TriangleSurface.from_triangles(*_surface(design.outline, design.thickness))
    diagonal = float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    envelope = min(0.25 * grading.finest, _WIDEST_ENVELOPE * diagonal)
    _require_feasible(design, grading, envelope / diagonal, len(edges))
    places, tetrahedra, sizes = _sizing(edges, grading, surface.points)
    # fTetWild leaves a file in the working directory.
    with TemporaryDirectory() as scratch, contextlib.chdir(scratch):
        points, cells = tetwild.tetrahedralize(
            surface.points,
            surface.faces.astype(np.int32),
            edge_length_abs=grading.coarsest,
            epsilon=envelope / diagonal,
            num_threads=1,
            vtk_ordering=True,
            bg_vertices=places,
            bg_tets=tetrahedra,
            bg_values=sizes,
        )
    cells = _orient_cells(points, cells.astype(np.int64))
    points = snap_boundary(points, cells, surface, _REACH * envelope)
    if isinstance(design.outline, Disc):
        points = _on_circle(design.outline, points, cells)
    return numbered_along_x(points, cells)


def _surface(outline: Outline, thickness: float) -> tuple[Array, Numbers]:
    """Points (n, 3) [m] and faces (k, 3) of the body, counter-clockwise seen from outside."""
    if isinstance(outline, Surface):
        return outline.triangles()
    rim = np.arange(_CHORDS if isinstance(outline, Disc) else 0) / _CHORDS
    longest = max(outline.length, outline.width) / _FACES
    return layer_surface(outline, thickness, longest, rim * outline.perimeter)


def _sizing(edges: Array, grading: Grading, points: Array) -> tuple[Array, Numbers, Array]:
    """Sizing field on tetrahedra around the body: points, corners, and edge lengths there [m]."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.1 * float((high - low).max())
    step = max(2.0 * grading.coarsest, margin / 3.0)
    counts = np.ceil((high - low + 2.0 * margin) / step).astype(int) + 1
    lines = [
        np.linspace(a - margin, b + margin, n) for a, b, n in zip(low, high, counts, strict=True)
    ]
    lattice = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    # Random offsets avoid the tetrahedra without volume of a regular lattice.
    lattice += 1e-3 * step * np.random.default_rng(0).uniform(-1.0, 1.0, lattice.shape)
    tree = cKDTree(edges)
    far = tree.query(lattice)[0] > _SPACING * grading.finest
    places = np.unique(np.concatenate([edges, lattice[far]]).round(12), axis=0)
    tetrahedra = Delaunay(places).simplices
    solid = np.abs(volumes(places, tetrahedra)) > 1e-12 * step**3
    distance, _ = tree.query(places)
    sizes = np.minimum(grading.coarsest, _AT_EDGES * grading.finest + grading.growth * distance)
    return places, tetrahedra[solid].astype(np.int32), sizes


def _on_circle(disc: Disc, points: Array, cells: Numbers) -> Array:
    """Points (n, 3) with those of the wall moved from chords onto the circle."""
    boundary = np.unique(boundary_faces(cells)[0])
    _, depth = disc.nearest(points[boundary, :2])
    rim = boundary[depth < 1.001 * disc.radius * (1.0 - np.cos(np.pi / _CHORDS))]
    arc, _ = disc.nearest(points[rim, :2])
    moved = points.copy()
    moved[rim, :2] = disc.rim_points(arc)
    return moved


def _require_feasible(design: SensorDesign, grading: Grading, envelope: float, edges: int) -> None:
    """Raise ConfigurationError where fTetWild would take far too long.

    With edges of length s there are about 8.5 tetrahedra in s^3; around a straight electrode edge
    of length l on a wall, given by points, there are 8.5 pi l / (2 growth^2 finest) more.
    """
    outline = design.outline
    volume = outline.length * outline.width * design.thickness
    length = edges * _SPACING * grading.finest
    around = 0.5 * np.pi * length / (grading.growth**2 * grading.finest)
    cells = 8.5 * (volume / grading.coarsest**3 + around)
    if cells > _MAX_CELLS or envelope < _SLIMMEST_ENVELOPE:
        least = grading.finest * max(1.0, _SLIMMEST_ENVELOPE / envelope)
        raise ConfigurationError(
            f"about {cells:.2g} tetrahedra with edges down to {grading.finest:g} m would take too "
            f"long: at most {_MAX_CELLS:.0e} with edges of at least {least:.2g} m are possible; "
            "choose larger sizes or more growth, or use hexahedra or prisms"
        )


def _orient_cells(points: Array, cells: Numbers) -> Numbers:
    """Cells oriented to positive volume; raises ConfigurationError if there are none."""
    if not len(cells):
        raise ConfigurationError(
            "fTetWild found no tetrahedra inside the body; choose smaller sizes, or repair the "
            "surface where it meets itself"
        )
    inverted = volumes(points, cells) < 0.0
    cells[inverted] = cells[inverted][:, [0, 2, 1, 3]]
    return cells


def snap_boundary(points: Array, cells: Numbers, surface: "TriangleSurface", reach: float) -> Array:
    """Mesh points with those of the boundary projected onto a surface.

    Points move to the nearest face within `reach`, then to the nearest sharp edge, then to the
    nearest corner; points of cells that a move would flatten stay.

    Args:
        points: (n, 3) [m].
        cells: (m, 4) tetrahedra.
        surface: target of the boundary.
        reach: largest distance of a move [m].

    Returns:
        points: (n, 3) [m].
    """
    boundary = np.unique(boundary_faces(cells)[0])
    least = np.minimum(scaled_jacobians(points, cells), _POOR)
    for target in surface.targets(points[boundary], reach):
        moved = points.copy()
        moved[boundary] = target
        while (poor := scaled_jacobians(moved, cells) < least).any():
            moved[cells[poor]] = points[cells[poor]]
        points = moved
    return points


@dataclass(frozen=True, slots=True, eq=False)
class TriangleSurface:
    """Closed triangle surface with its sharp edges and corners.

    Attributes:
        points: (n, 3) [m].
        faces: (k, 3), counter-clockwise seen from outside.
        edges: sharp edges, where normals differ by more than 30 degrees, (e, 2) point numbers.
        corners: points where sharp edges end, fork or turn by more than 30 degrees, (c,).
    """

    points: Array
    faces: Numbers
    edges: Numbers
    corners: Numbers

    @classmethod
    def from_triangles(cls, points: Array, faces: Numbers) -> "TriangleSurface":
        """Find the sharp edges and corners of a closed surface."""
        mesh = require("trimesh", "mesh").Trimesh(points, faces, process=False)
        edges = mesh.face_adjacency_edges[mesh.face_adjacency_angles > _SHARP]
        return cls(points, faces, edges, _corners(points, edges))

    def targets(self, points: Array, reach: float) -> Iterator[Array]:
        """Targets of points (n, 3) [m]: on faces within reach, then on edges, then on corners."""
        closest_on_face = require("trimesh", "mesh").triangles.closest_point
        target = points.copy()
        shapes = (
            (self.points[self.faces], closest_on_face),
            (
                self.points[self.edges],
                _closest_on_segment,
            ),
        )
        for corners, closest in shapes:
            middle = corners.mean(axis=1)
            radius = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1) + reach
            near = cKDTree(points).query_ball_point(middle, radius)
            shape = np.repeat(np.arange(len(corners)), [len(n) for n in near])
            number = np.array([number for numbers in near for number in numbers], dtype=np.int64)
            _move(target, points, number, closest(corners[shape], points[number]), reach)
            yield target.copy()
        if len(self.corners):
            _, corner = cKDTree(self.points[self.corners]).query(points)
            number = np.arange(len(points))
            _move(target, points, number, self.points[self.corners[corner]], reach)
            yield target


def _move(targets: Array, points: Array, number: Numbers, target: Array, reach: float) -> None:
    """Set the target of each point to the nearest of its candidates within reach."""
    distance = np.linalg.norm(target - points[number], axis=1)
    within = np.flatnonzero(distance <= reach)
    farthest_first = within[np.argsort(-distance[within], kind="stable")]
    targets[number[farthest_first]] = target[farthest_first]


def _closest_on_segment(segments: Array, points: Array) -> Array:
    """Nearest point (n, 3) of each segment (n, 2, 3) to each point (n, 3)."""
    step = segments[:, 1] - segments[:, 0]
    share = ((points - segments[:, 0]) * step).sum(axis=1) / (step**2).sum(axis=1)
    closest: Array = segments[:, 0] + np.clip(share, 0.0, 1.0)[:, None] * step
    return closest


def _corners(points: Array, edges: Numbers) -> Numbers:
    """Points where sharp edges (e, 2) end, fork or turn."""
    ends, other = edges.ravel(), edges[:, ::-1].ravel()
    away = points[other] - points[ends]
    away /= np.linalg.norm(away, axis=1)[:, None]
    count = np.bincount(ends, minlength=len(points))
    total = np.zeros_like(points)
    np.add.at(total, ends, away)
    # Two directions a and b with -a . b above the limit: |a + b|^2 = 2 + 2 a . b.
    straight = (count == 2) & ((total**2).sum(axis=1) < 2.0 - 2.0 * np.cos(_SHARP))
    return np.flatnonzero((count > 0) & ~straight)
