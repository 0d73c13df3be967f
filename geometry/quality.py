"""How well shaped the cells of a mesh are, and a gate for those that no solver should see."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.errors import ConfigurationError
from eitskin.geometry.mesh import Mesh

Array = NDArray[np.float64]

LEAST_SCALED_JACOBIAN = 1e-3

# Of each cell in VTK's order: for every corner the three neighbours that its edges lead to, such
# that their triple product is positive in a cell that is not inside out.
_NEIGHBOURS = {
    8: [[1, 3, 4], [2, 0, 5], [3, 1, 6], [0, 2, 7], [7, 5, 0], [4, 6, 1], [5, 7, 2], [6, 4, 3]],
    6: [[1, 2, 3], [2, 0, 4], [0, 1, 5], [5, 4, 0], [3, 5, 1], [4, 3, 2]],
    4: [[1, 2, 3], [2, 0, 3], [0, 1, 3], [2, 1, 0]],
}
# What makes a cube, a right prism over an equilateral triangle and a regular tetrahedron one.
_SCALE = {8: 1.0, 6: 2.0 / np.sqrt(3.0), 4: np.sqrt(2.0)}


@dataclass(frozen=True, slots=True)
class Quality:
    """The shape of a mesh's cells.

    Attributes:
        cells, points: how many.
        volume: of all cells [m3].
        scaled_jacobian: smallest of any cell; 1 is a box, a right prism over an equilateral
            triangle or a regular tetrahedron, 0 is flat, below 0 is inside out.
        median_scaled_jacobian: of all cells.
        aspect_ratio: longest over shortest edge of a cell, largest of any cell.
        median_aspect_ratio: of all cells.
        worst: number of the cell with the smallest scaled Jacobian.
    """

    cells: int
    points: int
    volume: float
    scaled_jacobian: float
    median_scaled_jacobian: float
    aspect_ratio: float
    median_aspect_ratio: float
    worst: int


def quality(mesh: Mesh) -> Quality:
    """Measure all cells of a mesh."""
    scaled, ratio = scaled_jacobian(mesh), _aspect_ratio(mesh)
    return Quality(
        cells=len(mesh.cells),
        points=len(mesh.points),
        volume=float(_volumes(mesh).sum()),
        scaled_jacobian=float(scaled.min()),
        median_scaled_jacobian=float(np.median(scaled)),
        aspect_ratio=float(ratio.max()),
        median_aspect_ratio=float(np.median(ratio)),
        worst=int(scaled.argmin()),
    )


def check_quality(mesh: Mesh, least: float = LEAST_SCALED_JACOBIAN) -> None:
    """Raise ConfigurationError, naming the worst cell, below a scaled Jacobian of `least`.

    Long thin boxes pass: a graded mesh needs them, and their angles are right.
    """
    if not np.all(np.isfinite(mesh.points)):
        raise ConfigurationError("the mesh has points that are not finite numbers")
    scaled = scaled_jacobian(mesh)
    # NaN, from an edge of no length, fails the comparison too.
    poor = np.flatnonzero(~(scaled >= least))
    if not len(poor):
        return
    worst = poor[np.nanargmin(np.nan_to_num(scaled[poor], nan=-1.0))]
    x, y, z = mesh.points[mesh.cells[worst]].mean(axis=0)
    raise ConfigurationError(
        f"{len(poor)} of {len(scaled)} cells are flat or inside out; the worst, cell {worst} at "
        f"({x:.4g}, {y:.4g}, {z:.4g}) m, has a scaled Jacobian of {scaled[worst]:.2g}, and at "
        f"least {least:g} is needed. Use a smaller growth or finer cells, or mend the surface there"
    )


def scaled_jacobian(mesh: Mesh) -> Array:
    """Smallest triple product of edges at a corner over the product of their lengths, (cells,).

    A tetrahedron's is taken over its largest product of lengths, as its triple product is the same
    everywhere. Source: the Verdict library (Knupp et al. 2006).
    """
    corners = mesh.points[mesh.cells]
    kind = mesh.cells.shape[1]
    edges = corners[:, np.array(_NEIGHBOURS[kind])] - corners[:, :, None]
    triple = np.einsum("cki,cki->ck", np.cross(edges[:, :, 0], edges[:, :, 1]), edges[:, :, 2])
    lengths = np.linalg.norm(edges, axis=-1).prod(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = triple[:, 0] / lengths.max(axis=1) if kind == 4 else (triple / lengths).min(axis=1)
    scaled: Array = _SCALE[kind] * ratio
    return scaled


def _aspect_ratio(mesh: Mesh) -> Array:
    corners = mesh.points[mesh.cells]
    edges = corners[:, np.array(_NEIGHBOURS[mesh.cells.shape[1]])] - corners[:, :, None]
    lengths = np.linalg.norm(edges, axis=-1).reshape(len(corners), -1)
    ratio: Array = lengths.max(axis=1) / lengths.min(axis=1)
    return ratio


def _volumes(mesh: Mesh) -> Array:
    """Of tetrahedra, and of columns of prisms and boxes, whose sides stand upright, (cells,)."""
    corners = mesh.points[mesh.cells]
    if mesh.cells.shape[1] == 4:
        edges = corners[:, 1:] - corners[:, :1]
        tetrahedra: Array = np.abs(np.linalg.det(edges)) / 6.0
        return tetrahedra
    half = mesh.cells.shape[1] // 2
    x, y = corners[:, :half, 0], corners[:, :half, 1]
    base = 0.5 * np.abs((x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1))
    upright: Array = base * (corners[:, half, 2] - corners[:, 0, 2])
    return upright
