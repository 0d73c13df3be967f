"""Projection of the boundary points of a mesh onto the surface that they approximate."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from eitskin.extras import require
from eitskin.geometry.design.patches import boundary_faces
from eitskin.geometry.meshing.quality import scaled_jacobians

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

_SHARP = np.cos(np.radians(30.0))  # of the angle between normals, or directions of edges
_POOR = 0.05  # scaled Jacobian below which no moved cell may fall


def snapped(points: Array, cells: Numbers, surface: "TriangleSurface", reach: float) -> Array:
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
    def of(cls, points: Array, faces: Numbers) -> "TriangleSurface":
        """Find the sharp edges and corners of a closed surface."""
        sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        edges, edge_of = np.unique(sides, axis=0, return_inverse=True)
        corners = points[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)[:, None]
        # The two faces of edge i are numbers 2 i and 2 i + 1 of the sides, sorted by edge.
        pairs = normals[np.argsort(edge_of.ravel(), kind="stable") // 3].reshape(-1, 2, 3)
        edges = edges[(pairs[:, 0] * pairs[:, 1]).sum(axis=1) < _SHARP]
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
    straight = (count == 2) & ((total**2).sum(axis=1) < 2.0 - 2.0 * _SHARP)
    return np.flatnonzero((count > 0) & ~straight)
