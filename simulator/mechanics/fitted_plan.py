"""Plan of a mesh that follows the rim of an outline: a fitted grid, and a ring around it.

The cells of a grid whose middles lie within the gel end in stairs; their nodes are moved onto the
rim, and others follow smoothly. A ring of cells along the rim makes the margin.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import LaplacianNd, spsolve

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.simulator.mechanics.box_fields import QuadraticField

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

UNIT = np.array([0.0, 1.0])  # heights of a plan's fields, which do not depend on them
_TOLERANCE = 1e-9  # [m]
_GAUSS = 0.5 - math.sqrt(0.15)  # first point of the rule of three points
_MIN_JACOBIAN = 0.02  # at such points, over that of the grid
_STEPS, _CLOSE = 30, 1e-12  # of Newton's method for a place on the grid; its end [m]
_TOO_NARROW = (
    "the outline has parts that are narrower than the cells under this touch; make them wider, or "
    "press with a smaller indenter"
)
_MAX_LOST = 4  # cells of a part in a sharp corner that may be left out
_MAX_MITRE = 2.0  # length over the width of the margin
_RING_CELLS = 0.5  # width of cells of the ring over the thickness of the stack


class Contact(NamedTuple):
    """Area under an indenter, an ellipse of the flat face.

    Attributes:
        x, y: its middle [m].
        radius: radius of the indenter [m].
        stretches: factors by which a bend makes it longer along x and y, to a circle.
        punch: radius of the largest circle within a flat punch, all of whose field the mesh has to
            resolve; 0 for others [m].
    """

    x: float
    y: float
    radius: float
    stretches: tuple[float, float] = (1.0, 1.0)
    punch: float = 0.0

    @property
    def spans(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Middle and half-length along x and along y [m]."""
        along, across = self.stretches
        return (self.x, self.radius / along), (self.y, self.radius / across)


@dataclass(frozen=True, slots=True, eq=False)
class FittedPlan:
    """Quadrilaterals of the gel, then those of its margin.

    Attributes:
        points: corners (n, 2) [m].
        quads: corners of each cell, counter-clockwise, (m, 4).
        gel_quads: number of them that are of gel.
        places: corners before they were fitted, those of the margin as they are, (n, 2) [m].
        shift: shift of places on the grid by fitting (..., 3) [m]; heights have no effect.
    """

    points: Array
    quads: Indices
    gel_quads: int
    places: Array
    shift: QuadraticField

    def in_gel(self, cells: int) -> NDArray[np.bool_]:
        """Which of the extruded cells, (cells,), are over or under the gel."""
        return np.arange(cells) % len(self.quads) < self.gel_quads


def unfit(shift: QuadraticField, points: Array) -> tuple[Array, Array]:
    """Places (..., 3) on the grid of points (..., 3) [m], and their derivative (..., 3, 3).

    By Newton's method, for the `shift` of a plan.
    """
    places, slope = points.copy(), np.zeros((*points.shape, 3))
    for _ in range(_STEPS):
        slope[..., :2, :] = shift.derivative(places)
        inverse = np.asarray(np.linalg.inv(np.eye(3) + slope), dtype=np.float64)
        away = points - places
        away[..., :2] -= shift(places)
        if np.abs(away).max(initial=0.0) < _CLOSE:
            break
        places += (inverse @ away[..., None])[..., 0]
    return places, inverse


def fit_plan(
    outline: PlaneOutline,
    lines: tuple[Array, Array],
    margin: float,
    thickness: float,
    contacts: Sequence[Contact],
) -> FittedPlan:
    """Plan of the gel on a grid fitted to its rim, with a margin; nodes under contacts stay.

    Raises ConfigurationError where the grid is too coarse for the outline.
    """
    nodes = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    middles = 0.25 * (nodes[1:, 1:] + nodes[1:, :-1] + nodes[:-1, 1:] + nodes[:-1, :-1])
    within = _select_connected(outline.contains(middles))
    moved = _shift_to_rim(outline, nodes, within, contacts)
    numbers = np.arange(nodes[..., 0].size).reshape(nodes.shape[:2])
    corners = [numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:]]
    quads = np.stack(corners, axis=-1)[within]
    used, quads = np.unique(quads, return_inverse=True)
    quads = quads.reshape(-1, 4)
    places = nodes.reshape(-1, 2)[used]
    points = places + moved.reshape(-1, 2)[used]
    whole = np.zeros((2 * len(lines[0]) - 1, 2 * len(lines[1]) - 1, 3, 2))
    whole[::2, ::2] = moved[:, :, None]
    whole[1::2] = 0.5 * (whole[:-1:2] + whole[2::2])
    whole[:, 1::2] = 0.5 * (whole[:, :-1:2] + whole[:, 2::2])
    shift = QuadraticField((*lines, UNIT), whole)
    gel_quads = len(quads)
    if margin > 0.0:
        outer, ring = _ring(outline, points, quads, margin, thickness)
        points, quads = np.concatenate([points, outer]), np.concatenate([quads, ring])
        places = np.concatenate([places, outer])
    if _least_jacobian(points[quads].swapaxes(0, 1)).min() <= 0.0:
        raise ConfigurationError(_TOO_NARROW)
    return FittedPlan(points, quads, gel_quads, places, shift)


def extrude(plan: FittedPlan, heights: Array) -> skfem.MeshHex:
    """Hexahedra over a plan between heights [m], those of each layer in its order."""
    n, layers = len(plan.points), len(heights) - 1
    points = np.column_stack([np.tile(plan.points, (layers + 1, 1)), np.repeat(heights, n)])
    low = (plan.quads + n * np.arange(layers)[:, None, None]).reshape(-1, 4).T
    a, b, c, d = low
    cells = np.array([a, d, b, a + n, c, d + n, b + n, c + n])
    return skfem.MeshHex(np.ascontiguousarray(points.T), cells)


def _select_connected(within: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells that hang together by their edges; single ones in sharp corners are left out.

    Raises ConfigurationError where more would be.
    """
    from scipy import ndimage  # which every other command would load for nothing

    while True:
        a, b, c, d = within[:-1, :-1], within[1:, :-1], within[:-1, 1:], within[1:, 1:]
        joined = within.copy()  # cells that meet at a node alone get one between them
        joined[:-1, :-1] |= b & c & ~d
        joined[1:, :-1] |= a & d & ~c
        if (joined == within).all():
            break
        within = joined
    labels, _ = ndimage.label(within)
    count = np.bincount(labels[within])
    if np.delete(count, count.argmax()).max(initial=0) > _MAX_LOST:
        raise ConfigurationError(_TOO_NARROW)
    return np.asarray(labels == count.argmax())


def _shift_to_rim(
    outline: PlaneOutline,
    nodes: Array,
    within: NDArray[np.bool_],
    contacts: Sequence[Contact],
) -> Array:
    """Displacement (nx, ny, 2) [m] of a grid that brings its stairs onto the rim."""
    moved, held = np.zeros_like(nodes), np.zeros(nodes.shape[:2], dtype=bool)
    for contact in contacts:
        away = np.abs(nodes - [contact.x, contact.y]) - [half for _, half in contact.spans]
        held |= (away < _TOLERANCE).all(axis=-1)
    around = np.pad(within, 1).astype(int)
    count = around[1:, 1:] + around[1:, :-1] + around[:-1, 1:] + around[:-1, :-1]
    rim = (count > 0) & (count < 4)
    moved[rim] = outline.rim_points(outline.nearest(nodes[rim])[0]) - nodes[rim]
    for corner in outline.rim_points(outline.corners):
        apart = np.where(rim, np.linalg.norm(nodes + moved - corner, axis=-1), np.inf)
        nearest = np.unravel_index(apart.argmin(), apart.shape)
        moved[nearest] = corner - nodes[nearest]
    held |= rim
    net = LaplacianNd(nodes.shape[:2], boundary_conditions="neumann", dtype=np.float64)
    springs = -csr_array(net.tosparse())
    flat, loose = moved.reshape(-1, 2), np.flatnonzero(~held)
    flat[loose] = spsolve(springs[loose][:, loose].tocsc(), -(springs[loose] @ flat))
    least = _MIN_JACOBIAN * _least_jacobian(_cell_corners(nodes))
    for _ in range(_STEPS):
        turned = within & (_least_jacobian(_cell_corners(nodes + moved)) < least)
        if not turned.any():
            return moved
        again = np.pad(turned, 1)
        again = again[1:, 1:] | again[1:, :-1] | again[:-1, 1:] | again[:-1, :-1]
        moved[again] *= 0.8
    return moved


def _cell_corners(nodes: Array) -> Array:
    """Corners of the cells of a plane grid, counter-clockwise, (4, nx - 1, ny - 1, 2) [m]."""
    return np.stack([nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]])


def _least_jacobian(corners: Array) -> Array:
    """Least Jacobian (...) of cells (4, ..., 2) at the outer points of a Gauss rule [m2]."""
    step, back = np.roll(corners, -1, axis=0) - corners, np.roll(corners, 1, axis=0) - corners
    own = step[..., 0] * back[..., 1] - step[..., 1] * back[..., 0]  # bilinear in between
    near, far = np.roll(own, 1, axis=0) + np.roll(own, -1, axis=0), np.roll(own, 2, axis=0)
    w = _GAUSS
    return np.asarray(((1 - w) ** 2 * own + w * (1 - w) * near + w**2 * far).min(axis=0))


def _ring(
    outline: PlaneOutline, points: Array, quads: Indices, margin: float, thickness: float
) -> tuple[Array, Indices]:
    """Nodes and cells of the margin around the cells of the gel."""
    ends = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges, count = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    single = {tuple(edge) for edge in edges[count == 1].tolist()}
    rim = np.array([end for end in ends.tolist() if tuple(sorted(end)) in single])
    before, after = (rim[np.argsort(rim[:, way])] for way in (1, 0))
    loop = after[:, 0]
    normals = []
    for edge in (before, after):
        along = points[edge[:, 1]] - points[edge[:, 0]]
        outward = np.column_stack([along[:, 1], -along[:, 0]])
        normals.append(outward / np.linalg.norm(outward, axis=1, keepdims=True))
    mitre = sum(normals) / (1.0 + (normals[0] * normals[1]).sum(axis=1, keepdims=True))
    length = np.linalg.norm(mitre, axis=1, keepdims=True)
    mitre *= np.minimum(1.0, _MAX_MITRE / length)
    # At re-entrant corners the ring ends half-way to what is across.
    width = np.full(len(loop), margin)
    for _ in range(_STEPS):
        gap = -outline.nearest(points[loop] + width[:, None] * mitre)[1]
        width = np.where(gap < 0.9 * width, 0.9 * width, width)
    layers = max(1, math.ceil(margin / (_RING_CELLS * thickness)))
    offsets = width[:, None] * mitre
    shells = [points[loop] + offsets * layer / layers for layer in range(1, layers + 1)]
    number = np.full(len(points), -1)
    number[loop] = np.arange(len(loop))
    starts, stops = number[after[:, 0]], number[after[:, 1]]
    rows = [loop, *(len(points) + len(loop) * k + np.arange(len(loop)) for k in range(layers))]
    ring = [
        np.column_stack([inner[starts], outer[starts], outer[stops], inner[stops]])
        for inner, outer in pairwise(rows)
    ]
    return np.concatenate(shells), np.concatenate(ring)
