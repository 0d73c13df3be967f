"""Box mesh of a whole stack on its support, for presses."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.geometry.design.outline import Disc, PlaneOutline, Rectangle
from eitskin.geometry.design.sensor import Free, Plates, Support
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator.mechanics.fitted_plan import Contact, FittedPlan, extrude, fit_plan
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.mechanics.materials import Law

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_TOLERANCE = 1e-9  # [m]
_MIN_LARGEST_CELL = 0.5  # least size of the largest cells, over the radius of an indenter
_SAMPLES, _SPARE = 4001, 1e-6
# Largest cells over the length of the sensor: far from presses on a thin stack nothing happens.
_MAX_CELL_SIZE = 1.0 / 20.0
_MAX_FINE_QUADS = 1400  # cells of a fitted plan, above which layers are one cell thick
_RIM_CELLS = 0.4  # of the thickness: cells at sides that do not run along x or y


@dataclass(frozen=True, slots=True)
class Fineness:
    """Fineness of a mesh where a correction varies most: at the faces of the gel.

    Attributes:
        ends, sides: cells at the faces across x and across y, over the thickness of the stack; 0
            for no refinement.
        layers: cells through each layer.
        rims: cells at the rims of contacts, over the radius of the indenter.
        growth: growth of cells with the distance from the rims.
    """

    ends: float = 0.2
    sides: float = 0.2
    layers: int = 2
    rims: float = 0.5
    growth: float = 0.5


# A stack that bends under an indenter has a kink at the rim of the contact.
_LOOSE = Fineness(rims=0.1, growth=1.0)
_PUNCH_CELLS = 0.15  # cells at the rims of flat punches, which have no dent to start from


@dataclass(frozen=True, slots=True, eq=False)
class StackMesh:
    """Boxes through gel, margin and the layers above and below, heights over the base.

    Attributes:
        mesh: the boxes, or hexahedra that follow the rims; x and y as in the design.
        lines: grid lines along x, y and z [m].
        stack: the layers.
        laws: different materials, that of the encapsulation last. Pressures jump between them.
        gel_cells: numbers of the cells of gel.
        gap: least and greatest x of the free part of the base, equal where there is none [m].
        free: whether the sides are held instead of the base.
        plan: plan of hexahedra that follow the rims; None for boxes.
    """

    mesh: skfem.MeshHex
    lines: tuple[Array, Array, Array]
    stack: Stack
    laws: tuple[Law, ...]
    gel_cells: Indices
    gap: tuple[float, float]
    free: bool
    plan: FittedPlan | None = None

    @property
    def law_of_cell(self) -> Indices:
        """Number of the material of each cell; in the margin that of the encapsulation."""
        laws = self.layer_materials(self.mesh.p[2, self.mesh.t].mean(axis=0))
        margin = self.stack.layer_number(self.mesh.p[2, self.mesh.t].mean(axis=0)) == self.stack.gel
        margin[self.gel_cells] = False
        laws[margin] = len(self.laws) - 1
        return laws

    def layer_materials(self, heights: Array) -> Indices:
        """Number of the material of the layer at heights over the base [m], as under a dent."""
        numbers = [self.laws.index(sheet.law) for sheet in self.stack.sheets]
        materials: Indices = np.array(numbers, dtype=np.int64)[self.stack.layer_number(heights)]
        return materials

    def facets(self, face: Literal["top", "sides", "held"]) -> Indices:
        """Boundary facets of the upper face, of the sides, or of what the support holds."""
        facets = self.mesh.boundary_facets().astype(np.int64)
        x, _, z = self.mesh.p[:, self.mesh.facets[:, facets]].mean(axis=1)
        top, base, (low, high) = z > self.lines[2][-1] - _TOLERANCE, z < _TOLERANCE, self.gap
        sides = ~(top | base)
        held = sides if self.free else base & ((x < low + _TOLERANCE) | (x > high - _TOLERANCE))
        return np.asarray(facets[{"top": top, "sides": sides, "held": held}[face]])


def stack_mesh(
    outline: PlaneOutline,
    stack: Stack,
    mechanics: Mechanics,
    support: Support,
    contacts: Sequence[Contact],
    fineness: Fineness | None = None,
) -> StackMesh:
    """Box mesh of a stack, refined around contacts.

    Args:
        outline: outline of the gel. Boxes follow sides along x and y; where there are others, the
            boxes within the gel are fitted to its rim, and a ring around them makes the margin.
        stack: the layers.
        mechanics: margin next to the gel, and its material.
        support: support of the base.
        contacts: contacts of the indenters.
        fineness: fineness at the faces, and through each layer.
    """
    radius = min(contact.punch or contact.radius for contact in contacts)
    height = stack.levels[-1]
    faces = _faces(outline)
    fitted = faces is None
    if fineness is None:
        loose = isinstance(support, Free | Plates)
        even = Fineness(layers=2 if isinstance(outline, Rectangle) else 1)
        fineness = Fineness(0.0, 0.0) if fitted else _LOOSE if loose else even
        if any(contact.punch for contact in contacts):
            fineness = dataclasses.replace(fineness, rims=_PUNCH_CELLS, growth=1.0)
        if all(contact.punch for contact in contacts):  # what a punch does fades without a jump
            fineness = dataclasses.replace(fineness, ends=0.0, sides=0.0)
    far = max(height, _MIN_LARGEST_CELL * radius, _MAX_CELL_SIZE * outline.length)
    coarsest = _RIM_CELLS * height if fitted else far
    finest = min(fineness.rims * radius, 0.5 * height, coarsest)
    grading = Grading(finest, coarsest, fineness.growth)
    whole = outline.length
    gap = support.gap(outline) if isinstance(support, Plates) else (0.5 * whole, 0.5 * whole)
    free = isinstance(support, Free)
    if free:
        gap = (-mechanics.margin - whole, 2.0 * whole + mechanics.margin)
    plates = gap if isinstance(support, Plates) else ()
    x, y = (
        _cross_lines(
            extent,
            mechanics.margin,
            [contact.spans[axis] for contact in contacts],
            edges,
            [] if faces is None else faces[axis],
            grading,
            height * (fineness.ends, fineness.sides)[axis],
        )
        for axis, (extent, edges) in enumerate(((whole, plates), (outline.width, ())))
    )
    plan = fit_plan(outline, (x, y), mechanics.margin, height, contacts) if fitted else None
    many = plan is not None and len(plan.quads) > _MAX_FINE_QUADS
    layers = 1 if many else fineness.layers
    ends = np.array(stack.levels)
    steps = [np.linspace(a, b, layers + 1)[1:] for a, b in itertools.pairwise(ends)]
    heights = np.concatenate([ends[:1], *steps])
    if plan is not None:
        mesh = extrude(plan, heights)
    else:
        mesh = skfem.MeshHex.init_tensor(x, y, heights)
        if not isinstance(outline, Rectangle):
            middles = mesh.p[:2, mesh.t].mean(axis=1).T
            mesh = mesh.restrict(np.flatnonzero(outline.contains(middles, -mechanics.margin)))
    middles = mesh.p[:, mesh.t].mean(axis=1)
    inside = outline.contains(middles[:2].T) if plan is None else plan.in_gel(mesh.t.shape[1])
    cells = np.flatnonzero(inside & (stack.layer_number(middles[2]) == stack.gel))
    around = mechanics.encapsulation
    laws = (*dict.fromkeys(s.law for s in stack.sheets if s.law != around), around)
    return StackMesh(mesh, (x, y, heights), stack, laws, cells, gap, free, plan)


def _faces(outline: PlaneOutline) -> list[list[tuple[float, float]]] | None:
    """Sides across x and across y within the extent, each with its outward direction.

    None for an outline that has others.
    """
    if isinstance(outline, Disc):
        return None
    corners = outline.vertices
    steps = np.roll(corners, -1, axis=0) - corners
    along = np.abs(steps) > _TOLERANCE
    if (along.sum(axis=1) != 1).any():
        return None
    # Counter-clockwise, the outward normal of a side (dx, dy) is (dy, -dx).
    normals = np.sign(np.where(along, steps, 0.0)[:, ::-1] * np.array([1.0, -1.0]))
    spans: list[list[tuple[float, float]]] = [[], []]
    for corner, normal in zip(corners, normals, strict=True):
        axis = int(np.abs(normal).argmax())
        at, extent = float(corner[axis]), (outline.length, outline.width)[axis]
        if _TOLERANCE < at < extent - _TOLERANCE:
            spans[axis].append((at, float(normal[axis])))
    return spans


def _cross_lines(
    extent: float,
    margin: float,
    contacts: Sequence[tuple[float, float]],
    edges: Sequence[float],
    inner: Sequence[tuple[float, float]],
    grading: Grading,
    side: float,
) -> Array:
    """Grid lines across the sensor, fine under contacts (position, radius), at edges and sides.

    Sides within the extent, `inner`, come with their outward direction, 1 or -1; their margin has
    grid lines too.
    """
    rims = [at + way * radius for at, radius in contacts for way in (-1.0, 1.0)]
    whole = extent + 2.0 * margin
    faces = margin + np.array([0.0, extent, *(at for at, _ in inner)])
    ends = margin + np.array([at + way * margin for at, way in inner])
    ends = ends[(ends > _TOLERANCE) & (ends < whole - _TOLERANCE)]
    near = [x + margin for x in (*rims, *edges) if -margin < x < extent + margin]
    samples = np.linspace(0.0, whole, _SAMPLES)
    middles = 0.5 * (samples[1:] + samples[:-1])
    size = grading.size(np.abs(middles[:, None] - np.array(near)).min(axis=1))
    if side:
        beside = Grading(side, grading.coarsest, grading.growth)
        size = np.minimum(size, beside.size(np.abs(middles[:, None] - faces).min(axis=1)))
    # Grid lines are at equal steps of the cumulative number of cells.
    count = np.append(0.0, np.cumsum(np.diff(samples) / size))
    fixed = np.unique(np.round([0.0, whole, *faces, *ends, *near], 12))
    parts = [fixed[:1]]
    for start, end in itertools.pairwise(fixed):
        first, last = np.interp([start, end], samples, count)
        cells = max(1, math.ceil(last - first - _SPARE))
        parts.append(np.interp(np.linspace(first, last, cells + 1), count, samples)[1:])
        parts[-1][-1] = end
    lines = np.array([0.0, *faces, *ends, whole])
    return (
        _without_slivers(np.concatenate(parts), lines, 0.25 * min(grading.finest, side or 1.0))
        - margin
    )


def _without_slivers(lines: Array, fixed_lines: Array, min_width: float) -> Array:
    """Grid lines without those nearer than `min_width` to one that must be kept."""
    distance = np.abs(lines[:, None] - fixed_lines).min(axis=1)
    chosen: Array = lines[(distance < _TOLERANCE) | (distance > min_width)]
    return chosen
