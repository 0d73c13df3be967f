"""Bends and touches of a body from a surface file: solved once, kept in the store."""

import hashlib
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator.bodies.pressed_body import (
    MAX_TOUCHES,
    BodyPress,
    PressedBody,
    require_over_body,
)
from eitskin.simulator.bodies.tetrahedral_solid import (
    TetrahedralField,
    TetrahedralSolid,
    body_grading,
    mesh_body,
    require_surface,
)
from eitskin.simulator.deformation.press_table import indenter_samples
from eitskin.simulator.deformation.solution_store import Arrays, Problem, load_or_solve
from eitskin.simulator.mechanics import viscoelasticity as relaxation
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.turning_plates import TurningPlates
from eitskin.simulator.scene.indenters import Footprint
from eitskin.simulator.scene.scene import PressedTouch, Touch, neighbour_distance

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Version of the solutions: raise it whenever bodies are meshed or solved in another way.
_VERSION = 2
_MAX_KEPT = 16  # solutions in memory, each of some megabytes
_TOLERANCE = 1e-9  # [m]
_MIN_GRIPPED_NORMAL = math.cos(math.radians(45.0))  # |n_z| of faces that the plates hold, at least
_PER_THICKNESS = 4.0  # cells through the body at the edges of the plates
# of an edge length, by which corners are moved onto the edges of the plates
_MAX_CORNER_SHIFT = 0.5
_MAX_STEP = 10.0  # of the angle, at first [deg]
_MIN_CELL_VOLUME = 0.2  # of its volume that a cell keeps when its corners are moved


def solve_bend(
    design: SensorDesign, fixture: Fixture, mechanics: Mechanics, bend: Bend
) -> Deformation:
    """Deformation of a body by a fixture; clamped bodies are solved in a minute or more.

    Raises:
        ConfigurationError: for a bend out of reach, or a clamp that bodies cannot have.
        SolidError: where the clamped body has no stable equilibrium at the angle.
    """
    if not isinstance(fixture, Clamp):
        return fixture.flexure(design, bend)
    if fixture.compliance or fixture.faces != "both":
        raise ConfigurationError(
            "the plates of a clamp hold a body from a surface rigidly and from both sides, got a "
            f"compliance of {fixture.compliance:g} m/Pa and faces = '{fixture.faces}'; leave both "
            "out"
        )
    span, offset, angle = fixture.span, fixture.offset, bend.angle_deg

    def solve() -> Arrays:
        return _field_arrays(_clamped_body(design, span, offset, mechanics).solve_angle(angle))

    field, _ = _load_solution(_problem("bend", design, mechanics, [span, offset, angle], solve))
    return field


def pressed_body(
    design: SensorDesign, touches: tuple[Touch, ...], mechanics: Mechanics
) -> PressedBody:
    """Body under touches without history; the first time takes a minute or more.

    Raises SolidError, with the fraction of the load that was carried, where no stable equilibrium
    is found.
    """

    def solve() -> Arrays:
        solved = BodyPress(design, touches, mechanics).equilibrium()
        numbers = {f.name: getattr(solved, f.name) for f in fields(solved) if f.name != "field"}
        return numbers | _field_arrays(solved.field)

    described = [
        [t.x, t.y, t.force if t.depth is None else None, t.depth, indenter_samples(t.indenter)]
        for t in touches
    ]
    field, numbers = _load_solution(_problem("press", design, mechanics, described, solve))
    return PressedBody(field=field, **numbers)


def _problem(
    kind: str,
    design: SensorDesign,
    mechanics: Mechanics,
    loads: Sequence[Any],
    solve: Callable[[], Arrays],
) -> Problem:
    """Solution of a body under loads."""
    points, faces = require_surface(design).triangles()
    described = {
        "version": _VERSION,
        "kind": kind,
        "surface": hashlib.sha256(points.round(12).tobytes() + faces.tobytes()).hexdigest(),
        "gel": [type(mechanics.gel).__name__, *astuple(mechanics.gel)],
        "bulk_ratio": mechanics.bulk_ratio,
        "loads": loads,
    }

    return Problem("body", described, lambda _: solve())


def _field_arrays(field: TetrahedralField) -> Arrays:
    return {f"field {f.name}": getattr(field, f.name) for f in fields(field)}


@lru_cache(maxsize=_MAX_KEPT)
def _load_solution(problem: Problem) -> tuple[TetrahedralField, Arrays]:
    """Field and numbers of a solution."""
    arrays = load_or_solve(problem, dict)
    field = {f.name: arrays.pop(f"field {f.name}") for f in fields(TetrahedralField)}
    return TetrahedralField(**field), arrays


def solve_presses(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> PressedBody | None:
    """Body under the touches of a scene; None where all dents have faded.

    A body that creeps under a force has the shape of an elastic one under a greater force, as the
    slabs of `viscoelasticity` have; a fading dent is that of a smaller one.
    """
    felt = tuple(touch for touch in _elastic(touches, design, mechanics) if touch is not None)
    return pressed_body(design, felt, mechanics) if felt else None


def pressed_body_touches(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> tuple[PressedTouch, ...]:
    """Depth, contact and pressure of each touch on a body."""
    solved = solve_presses(touches, design, mechanics)
    felt = [touch is not None for touch in _elastic(touches, design, mechanics)]
    rows = iter(range(sum(felt)))
    return tuple(
        _result(touch, touches, mechanics, solved, next(rows) if there else None)
        for touch, there in zip(touches, felt, strict=True)
    )


def require_pressable(surface: Surface, touches: tuple[Touch, ...]) -> None:
    """Raise ConfigurationError for touches that a body cannot have."""
    if len(touches) > MAX_TOUCHES:
        raise ConfigurationError(
            f"a body is pressed by at most {MAX_TOUCHES} touches at once, got {len(touches)}"
        )
    for touch in touches:
        require_over_body(surface, touch)
        if isinstance(touch.indenter, Footprint):
            raise ConfigurationError(
                "a body from a surface file is pressed by bodies of revolution, got a footprint; "
                "give a cylinder, sphere or profile"
            )


def _elastic(
    touches: tuple[Touch, ...], design: SensorDesign, mechanics: Mechanics
) -> list[Touch | None]:
    """Touches without history that leave the dents of the given ones; None for faded dents."""
    prony = mechanics.gel_relaxation
    first = [replace(touch, held=None, released=0.0, before=()) for touch in touches]
    pushed: Array | None = None  # forces at the first moment
    found: list[Touch | None] = []
    for k, (touch, one) in enumerate(zip(touches, first, strict=True)):
        force = touch.force
        if touch.depth is not None and touch.released:
            # A depth that was released leaves the dent of a force, after the first moment's.
            if pushed is None:
                pushed = pressed_body(design, tuple(first), mechanics).forces
            lasted = touch.held or 0.0, touch.released
            force = relaxation.elastic_force_at_depth(prony, float(pushed[k]), *lasted)
        elif touch.depth is None and touch.held is not None:
            loads = (touch.force, touch.held, touch.released), *touch.before
            force = sum(relaxation.elastic_force(prony, *load) for load in loads)
        if touch.depth is not None and not touch.released:
            found.append(one)
        else:
            left = force > relaxation.FADED * touch.force
            found.append(replace(one, depth=None, force=force) if left else None)
    return found


def _result(
    touch: Touch,
    touches: tuple[Touch, ...],
    mechanics: Mechanics,
    pressed_body: PressedBody | None,
    row: int | None,
) -> PressedTouch:
    """Result of one touch, number `row` of the solution; none where its dent has faded."""
    force = depth = radius = peak = thinning = 0.0
    if pressed_body is not None and row is not None:
        elastic = float(pressed_body.forces[row])
        depth, thinning = float(pressed_body.depths[row]), float(pressed_body.thinnings[row])
        acting = elastic if touch.depth is not None else touch.force
        if touch.depth is not None and touch.held is not None:
            acting *= float(mechanics.gel_relaxation.relaxation(touch.held))
        if not touch.released:
            force = acting
            radius = math.sqrt(float(pressed_body.contact_areas[row]) / math.pi)
            peak = float(pressed_body.peak_pressures[row]) * force / elastic
    return PressedTouch(
        touch=touch,
        force=force,
        depth=depth,
        contact_radius=radius,
        peak_pressure=peak,
        thinning=thinning,
        edge_distance=math.inf,
        neighbour_distance=neighbour_distance(touch, touches),
        signal_error=None,
        caution="touches press the bare body of a surface file, without its encapsulation, with an "
        "unmeasured error",
    )


class ClampedBody:
    """Body between the plates of a hinge, meshed once for all angles.

    The plates hold, without slip, the faces that look up or down to within 45 degrees wherever
    |x| >= span / 2 from the middle of the body, and turn by +-theta/2 about an axis along y at
    the distance `offset` below the middle. The rest of the boundary is free.

    Attributes:
        body: the meshed body.
        plates: plates that hold it; with all equilibria, their energies and moments.
    """

    def __init__(
        self,
        design: SensorDesign,
        span: float,
        offset: float,
        mechanics: Mechanics | None = None,
        grading: Grading | None = None,
    ) -> None:
        """Mesh the body.

        Args:
            design: the sensor, with a surface as outline.
            span: free length between the plates [m].
            offset: offset of the hinge axis below the middle of the body [m].
            mechanics: materials; only the gel's law and bulk ratio are used.
            grading: finest at the edges of the plates, `layers` is not used; a quarter of the
                body's smaller extent along y and z when omitted.

        Raises:
            ConfigurationError: for a plane outline, a span that leaves nothing to clamp, or a body
                that needs too many cells.
        """
        surface, self._centre = require_surface(design), np.array(design.centre)
        if not 0.0 < span < surface.length:
            raise ConfigurationError(
                f"the span must be above 0 and below the body's length of {surface.length:g} m, "
                f"where the plates hold its ends, got {span:g} m"
            )
        self._half_span = 0.5 * span
        smaller = min(surface.width, surface.height)
        grading = grading or body_grading(design, smaller / _PER_THICKNESS)
        finest = grading.finest
        mesh = mesh_body(design, grading, self._plate_edges(surface, finest))
        for side in (-1.0, 1.0):
            mesh = _snap_corners_to_plane(mesh, self._centre[0] + side * self._half_span, finest)
        self.body = TetrahedralSolid(mesh, mechanics or Mechanics())
        held = {side: self._clamped_nodes(side) for side in (-1.0, 1.0)}
        nodes = np.concatenate([*held.values()])
        fixed = np.sort(self.body.solid.displacement_unknowns(nodes))
        axis, longest = self._centre - np.array([0.0, 0.0, offset]), _MAX_STEP
        self.plates = TurningPlates(self.body.solid, held, axis, fixed, None, longest)

    def solve_angle(self, angle_deg: float) -> TetrahedralField:
        """Deformation by an angle between the plates [deg].

        Raises SolidError, naming the angle reached, where no stable equilibrium is found.
        """
        return self.body.field(self.plates.equilibrium(angle_deg))

    def _plate_edges(self, surface: Surface, finest: float) -> Array:
        """Points along the edges of the plates on the body's surface, (k, 3) [m]."""
        points, faces = surface.triangles()
        ends = self._centre[0] + self._half_span * np.array([-1.0, 1.0])
        return _sections(points[faces], ends.tolist(), 2.0 * finest)

    def _clamped_nodes(self, side: float) -> Indices:
        """Nodes held by the plate at small or at large x, of the side -1 or 1."""
        body = self.body
        gripped = np.abs(body.normals[:, 2]) > _MIN_GRIPPED_NORMAL
        along = side * (body.middles[:, 0] - self._centre[0])
        near = body.solid.facet_nodes(body.facets[gripped & (along > self._half_span)])
        x = side * (body.solid.nodes[near, 0] - self._centre[0])
        nodes: Indices = near[x > self._half_span - _TOLERANCE]
        if len(nodes) < 3:
            raise ConfigurationError(
                f"the plates with a span of {2 * self._half_span:g} m find no face of the body "
                "to hold, looking up or down to within 45 deg; choose a shorter span"
            )
        return nodes


_clamped_body = lru_cache(maxsize=2)(ClampedBody)


def _sections(corners: Array, planes: Sequence[float], spacing: float) -> Array:
    """Points (k, 3) [m], `spacing` apart, on sections of triangles (n, 3, 3) by planes of x."""
    sections = []
    for x in planes:
        side = np.sign(corners[..., 0] - x)
        for triangle in corners[(side.min(axis=1) < 0.0) & (side.max(axis=1) > 0.0)]:
            ends = [
                a + (x - a[0]) / (b[0] - a[0]) * (b - a)
                for a, b in itertools.combinations(triangle, 2)
                if min(a[0], b[0]) <= x <= max(a[0], b[0]) and a[0] != b[0]
            ]
            count = 2 + math.ceil(float(np.linalg.norm(ends[0] - ends[-1])) / spacing)
            sections.append(np.linspace(ends[0], ends[-1], count))
    return np.concatenate(sections)


def _snap_corners_to_plane(mesh: skfem.MeshTet, x: float, finest: float) -> skfem.MeshTet:
    """Mesh with the boundary corners nearest to a plane of x [m] moved onto the plane.

    Corners are moved along x only, and only where all cells around them keep a good part of their
    volume: edges of plates then lie between cells.
    """
    points, cells = mesh.p.copy(), mesh.t
    rim = mesh.boundary_nodes()
    near = rim[np.abs(points[0, rim] - x) < _MAX_CORNER_SHIFT * finest]
    whole = _volumes(points, cells)
    for node in near[np.argsort(np.abs(points[0, near] - x))]:
        around = np.any(cells == node, axis=0)
        before = points[0, node]
        points[0, node] = x
        volume_ratios = _volumes(points, cells[:, around]) / whole[around]
        if volume_ratios.min() < _MIN_CELL_VOLUME:
            points[0, node] = before
    return skfem.MeshTet(points, cells)


def _volumes(points: Array, cells: Indices) -> Array:
    """Signed volumes of cells (4, n) [m3], (n,)."""
    corners = points[:, cells]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(2, 1, 0)
    return np.asarray(np.linalg.det(edges) / 6.0)
