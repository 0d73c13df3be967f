"""Prism meshes: a graded triangulation of the plan, extruded through the layers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Naming = Callable[[Array], str]
"""Name of the material or boundary at a position (3,) [mm]."""

_SAME = 1e-6  # [mm]


@dataclass(frozen=True, slots=True)
class Patch:
    """Elliptic patch of the top face that an indenter holds.

    Attributes:
        centre: (x, y) [mm].
        radii: semi-axes along x and y [mm].
    """

    centre: tuple[float, float]
    radii: tuple[float, float]

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (..., 2) [mm] lie in the patch, its polygon's corners included."""
        scaled = (np.asarray(points) - self.centre) / self.radii
        inside: NDArray[np.bool_] = np.sum(scaled**2, axis=-1) < 1.05
        return inside


@dataclass(frozen=True, slots=True)
class Sizes:
    """Edge lengths of the triangles [mm], and growth between them.

    Attributes:
        rim: along the rims of the patches.
        inside: within the patches.
        around: within `reach` radii of a patch.
        far: elsewhere.
        grading: growth of the triangles, 0 to 1; smaller is slower.
        reach: radius of the finer surroundings over that of the patch.
    """

    rim: float = 1.0
    inside: float = 2.5
    around: float = 5.0
    far: float = 12.0
    grading: float = 0.45
    reach: float = 1.8

    def scaled(self, factor: float) -> "Sizes":
        """Sizes with all lengths multiplied by a factor."""
        rim, inside, around, far = (
            factor * h for h in (self.rim, self.inside, self.around, self.far)
        )
        return Sizes(rim, inside, around, far, self.grading, self.reach)


def triangulated(
    box: tuple[float, float, float, float],
    lines: Sequence[tuple[tuple[float, float], tuple[float, float]]],
    patches: Sequence[Patch],
    sizes: Sizes,
) -> tuple[Array, Indices]:
    """Triangulation of a rectangle that resolves lines and patches.

    Args:
        box: x from, x to, y from, y to [mm].
        lines: straight segments that no triangle crosses, from and to (x, y) [mm].
        patches: in the box or cut by its sides.
        sizes: of the triangles.

    Returns points (n, 2) [mm] and triangles (m, 3), anticlockwise. The polygon of each patch has
    the area of its ellipse.
    """
    occ = require("netgen.occ", "reference")
    x0, x1, y0, y1 = box
    whole = _face(occ, np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]))
    parts, finest = [whole], []
    for patch in patches:
        for scale, size in ((1.0, sizes.inside), (sizes.reach, sizes.around)):
            parts.append(_face(occ, _polygon(patch, sizes.rim, scale)) * whole)
            finest.append((patch, scale, size))
    parts += [occ.Segment(occ.Pnt(*a, 0.0), occ.Pnt(*b, 0.0)) for a, b in lines]
    plan = occ.Glue(parts)
    for face in plan.faces:
        corners = np.array([[v.p.x, v.p.y] for v in face.vertices])
        near = [
            size
            for patch, scale, size in finest
            if np.all(patch.contains(patch.centre + (corners - patch.centre) / scale))
        ]
        face.maxh = min([sizes.far, *near])
    mesh = occ.OCCGeometry(plan, dim=2).GenerateMesh(maxh=sizes.far, grading=sizes.grading)
    points = np.array([point.p[:2] for point in mesh.Points()])
    triangles = np.array([[v.nr - 1 for v in cell.vertices] for cell in mesh.Elements2D()])
    a, b = (points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2))
    turned = a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]
    triangles[turned] = triangles[turned][:, ::-1]
    return points, triangles


def extruded(
    points: Array, triangles: Indices, heights: Sequence[float], material: Naming, boundary: Naming
) -> Any:
    """Mesh of prisms between all neighbouring heights, an `ngsolve.Mesh`.

    Args:
        points: of the plan, (n, 2) [mm].
        triangles: anticlockwise, (m, 3).
        heights: of the layers of prisms, rising [mm].
        material: name at the centroid of a prism.
        boundary: name at the centroid of a boundary facet.
    """
    ngsolve = require("ngsolve", "reference")
    netgen = require("netgen.meshing", "reference")
    mesh, count = netgen.Mesh(dim=3), len(points)
    levels = np.asarray(heights, dtype=float)
    numbers = [
        mesh.Add(netgen.MeshPoint(netgen.Pnt(*p, z))) for z in levels for p in points.tolist()
    ]
    names: dict[str, int] = {}
    for k in range(len(levels) - 1):
        for cell in triangles:
            centre = np.append(points[cell].mean(axis=0), levels[k : k + 2].mean())
            domain = names.setdefault(material(centre), len(names) + 1)
            corners = [numbers[count * k + v] for v in (*cell, *(cell + count))]
            mesh.Add(netgen.Element3D(domain, corners))
    faces: dict[str, int] = {}

    def add(corners: list[int], centre: Array) -> None:
        name = boundary(centre)
        if name not in faces:
            faces[name] = len(faces) + 1
            mesh.Add(netgen.FaceDescriptor(surfnr=len(faces), domin=1, bc=len(faces)))
        mesh.Add(netgen.Element2D(faces[name], [numbers[v] for v in corners]))

    top = count * (len(levels) - 1)
    for cell in triangles:
        middle = points[cell].mean(axis=0)
        add(list(cell[::-1]), np.append(middle, levels[0]))
        add(list(cell + top), np.append(middle, levels[-1]))
    for a, b in _rim(triangles):
        middle = 0.5 * (points[a] + points[b])
        for k in range(len(levels) - 1):
            quad = [a + count * k, b + count * k, b + count * (k + 1), a + count * (k + 1)]
            add(quad, np.append(middle, levels[k : k + 2].mean()))
    for name, domain in names.items():
        mesh.SetMaterial(domain, name)
    for name, face in faces.items():
        mesh.SetBCName(face - 1, name)
    return ngsolve.Mesh(mesh)


def _polygon(patch: Patch, side: float, scale: float) -> Array:
    """Corners of a polygon of equal area, symmetric in x and y, (n, 2) [mm]."""
    count = 4 * max(3, round(0.5 * np.pi * max(patch.radii) / side))
    angle = 2.0 * np.pi * np.arange(count) / count
    growth = scale * np.sqrt(2.0 * np.pi / (count * np.sin(2.0 * np.pi / count)))
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners: Array = patch.centre + growth * np.asarray(patch.radii) * around
    return corners


def _face(occ: Any, corners: Array) -> Any:
    """Face of a polygon."""
    pen = occ.WorkPlane(occ.Axes((0, 0, 0), n=occ.Z, h=occ.X)).MoveTo(*corners[0])
    for corner in corners[1:]:
        pen = pen.LineTo(*corner)
    return pen.Close().Face()


def _rim(triangles: Indices) -> Indices:
    """Edges of one triangle only, anticlockwise, (k, 2)."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    _, first, times = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True
    )
    return np.asarray(edges[first[times == 1]])
