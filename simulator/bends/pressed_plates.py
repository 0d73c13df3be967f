"""Presses on a sensor on plates, flat or bent by them, from tables that are solved once.

On plates the correction of a dent is another one than on a rigid base: the base gives way between
the plates, and a bend strains what is pressed. A table holds the difference of both,

    d = (u_d in the frame of the bent top + c_plates) - (u_d + c_rigid in the frame of the gel),

over place, angle and depth, divided by the depth. u_d is the dent of the unbounded stack, c are its
corrections (`finite_stack`), both solved on one mesh, so that most of its error cancels. By
symmetry a quarter of the sheet is solved. A press then is the bend, its dent and the tabulated
correction on a rigid base in the frame of the bent gel, and d.
"""

import dataclasses
import logging
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product
from typing import cast

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import Plates, SensorDesign
from eitskin.simulator.bends import bend_table
from eitskin.simulator.deformation.contact import BentState, ContactFrame, DentField
from eitskin.simulator.deformation.field import CubicSplines, Field
from eitskin.simulator.deformation.finite_stack import FiniteStack
from eitskin.simulator.deformation.indentation_tables import (
    Indentations,
    PressFields,
    solve_each,
    tabulate,
)
from eitskin.simulator.deformation.node_sums import (
    BOTH_MIRRORED,
    DIRECT,
    MIRRORED_X,
    MIRRORED_Y,
    NodeSums,
    sum_of,
)
from eitskin.simulator.deformation.press_table import indenter_samples
from eitskin.simulator.deformation.sensor_grid import SensorGrid
from eitskin.simulator.deformation.solution_store import (
    Arrays,
    Problem,
    Report,
    load_or_solve,
)
from eitskin.simulator.deformation.solution_table import Axis, SolutionTable
from eitskin.simulator.deformation.solved_correction import Correction
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.stack_mesh import Fineness
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

log = logging.getLogger(__name__)

# Version of the tables: raise it whenever they are solved in another way.
_VERSION = 4
ANGLES_DEG = (-20.0, 0.0, 25.0, 50.0)
_PARTS = (0.3, 0.6, 1.0)  # solved depths over the deepest of a place
# Deepest dent over the thickness of the stack, on a plate and in the middle between plates, where
# the stack sinks several times as deep as it is dented, and how it changes next to the plate's
# edge.
_DEEPEST, _IN_GAP, _BESIDE, _WITHIN = 0.32, 0.08, 0.1, 0.3
# Solved places over the thickness: from the edge of a plate outwards, between places in the gap,
# and beyond the least distance from a side.
_ON_PLATE, _BETWEEN, _FROM_SIDE = (
    (0.3, 0.75, 1.25, 1.9, 2.8, 4.0),
    0.42,
    (0.0, 0.45, 0.72, 1.0, 1.65, 2.5, 3.5, 5.0, 7.0),
)
_MIN_PLACE_OFFSET = 0.4  # least distance of places from the middle over the thickness
_FINENESS = Fineness(ends=0.0, sides=0.25, layers=2, rims=0.3, growth=1.5)
# Nodes of fields over the thickness: in the gap and up to a distance next to it, and beyond.
_FINE, _NEAR, _COARSE, _ACROSS, _DEGREE = 0.25, 1.8, 0.65, 19, 2
_TOLERANCE = 1e-3  # singular values, relative to the largest, that the table keeps
# A sensor over a gap gives way like a spring that its bend stiffens: fields are cubics of the
# inverse distance from this angle, by which solved angles follow best from the others [deg].
_SOFTEST_DEG = -100.0
_MINUTES = 110
_DEPTH_MARGIN = 0.02  # of the deepest dent, by which another may be deeper
_WORKERS = os.cpu_count() or 1


@dataclass(frozen=True, slots=True)
class PlatesCase:
    """Sensor on plates and its indenter, about which a table is solved.

    Attributes:
        design: design on the support `Plates`, of rectangular outline; its electrodes do not
            matter.
        clamp: clamp of the plates.
        mechanics: materials.
        indenter: rigid body that presses.
    """

    design: SensorDesign
    clamp: Clamp
    mechanics: Mechanics
    indenter: Indenter

    def problem(self) -> Problem:
        """Table of the case."""
        design, mechanics, clamp, outline = self.design, self.mechanics, self.clamp, self.outline
        gel = mechanics.gel.shear_modulus
        described = {
            "version": _VERSION,
            "sizes": [outline.length, outline.width],
            "heights": [design.thickness, design.encapsulated_thickness],
            "clamp": [clamp.span, clamp.offset, clamp.compliance * gel],
            "laws": [
                [type(law).__name__, law.shear_modulus / gel, getattr(law, "alpha", 2.0)]
                for law in (mechanics.gel, mechanics.encapsulation)
            ],
            "margin": mechanics.margin,
            "bulk_ratio": mechanics.bulk_ratio,
            "indenter": indenter_samples(self.indenter),
            "angles_deg": ANGLES_DEG,
        }
        return Problem("plates", described, self._solve, divided=True)

    @property
    def outline(self) -> Rectangle:
        """Outline of the gel."""
        return cast("Rectangle", self.design.outline)

    @property
    def indentations(self) -> Indentations:
        """Stack and indenter of all presses."""
        stack = self.mechanics.stack(self.design)
        return Indentations(stack, self.mechanics, self.design.support, self.indenter)

    def axes(self) -> tuple[Axis, ...]:
        """Solved places, angles and parts of the deepest dent."""
        outline, about = self.outline, self.indentations
        edge, H = 0.5 * (outline.length - self.clamp.span), about.thickness
        inside = math.ceil((0.5 * outline.length - edge) / (_BETWEEN * H))
        along = edge - H * np.array(_ON_PLATE)[::-1]
        along = along[along > about.least] if along[-1] > about.least else np.array([about.least])
        x = np.concatenate([along, np.linspace(edge, 0.5 * outline.length, inside + 1)])
        across, middle = about.least + H * np.array(_FROM_SIDE), 0.5 * outline.width
        y = np.append(across[across < middle - _MIN_PLACE_OFFSET * H], middle)
        return (
            Axis("x", "mirrored", x),
            Axis("y", "mirrored", y),
            Axis("angle", "spline", np.array(ANGLES_DEG)),
            Axis("part", "polynomial", np.array(_PARTS)),
        )

    def deepest(self, x: Array | float) -> Array:
        """Deepest tabulated dents at places along the sensor [m]."""
        outline, H = self.outline, self.design.encapsulated_thickness
        within = 0.5 * self.clamp.span - np.abs(x - 0.5 * outline.length)
        on_plate = 1.0 / (1.0 + np.exp((within / H - _BESIDE) / _WITHIN))
        return np.asarray(H * (_IN_GAP + (_DEEPEST - _IN_GAP) * on_plate))

    def bases(self) -> tuple[CubicSplines, CubicSplines]:
        """Splines of the fields along x and y."""
        outline, H = self.outline, self.design.encapsulated_thickness
        middle, edge = 0.5 * outline.length, 0.5 * (outline.length - self.clamp.span)
        near = max(edge - _NEAR * H, 0.0)
        far = np.linspace(0.0, near, max(1, math.ceil(near / (_COARSE * H))) + 1)[:-1]
        fine = np.linspace(near, middle, math.ceil((middle - near) / (_FINE * H)) + 1)
        half = np.concatenate([far, fine])
        x = np.concatenate([half, outline.length - half[-2::-1]])
        turned = 0.5 * (1.0 - np.cos(np.linspace(0.0, math.pi, _ACROSS)))
        return CubicSplines(x), CubicSplines(outline.width * turned)

    def _solve(self, report: Report) -> Arrays:
        axes, about = self.axes(), self.indentations
        places = [(float(x), float(y)) for x in axes[0].nodes for y in axes[1].nodes]
        log.info("solving presses on plates, about %d minutes of one core", _MINUTES)
        solved = solve_each(partial(solve_place, self), report, _WORKERS, places)
        x = self.bases()[0].nodes
        table = tabulate(about, axes, solved, _TOLERANCE, self.strains, nodes=x)
        return table.arrays(np.float16)

    def strains(self, fields: Array) -> Array:
        """Displacement gradients (n, m) of fields (n, nx, ny, nz, 4), on which signals depend.

        At the nodes, each times the root of its volume. Displacements themselves are largest in
        the gap, where the stack sinks without much strain.
        """
        bases, height = self.bases(), self.indentations.height
        levels, parts = legendre.leggauss(fields.shape[3])
        grid = *(basis.nodes for basis in bases), 0.5 * height * (levels + 1.0)
        moved = np.stack([Field(bases, height, one).on_grid(*grid)[..., :3] for one in fields])
        slopes = np.gradient(moved, *grid, axis=(1, 2, 3), edge_order=2)
        along, across = (np.gradient(nodes) for nodes in grid[:2])
        roots = np.sqrt(along[:, None, None] * across[:, None] * parts)[..., None]
        return np.concatenate([(roots * one).reshape(len(fields), -1) for one in slopes], axis=1)


def solve_place(case: PlatesCase, place: tuple[float, float]) -> PressFields:
    """Fields d over the depth of presses at a place [m], (angles, parts, nx, ny, nz, 4)."""
    about, (x, y), outline = case.indentations, place, case.outline
    dents = about.with_depths(
        [part * float(case.deepest(x)) / about.thickness for part in _PARTS]
    ).dents
    body, middle = about.mesh(outline, [place], _FINENESS), 0.5 * outline.length

    def solve_dents(
        stack: FiniteStack, frame: ContactFrame | None, neighbours: Sequence[Correction]
    ) -> list[Correction]:
        found = list(neighbours[:0])
        for k, dent in enumerate(dents):
            start = neighbours[k].unknowns if neighbours else None
            if k and start is None:
                start = found[-1].unknowns * dent.depth / dents[k - 1].depth
            found.append(stack.correction([DentField(x, y, case.indenter, dent, frame)], start))
        return found

    rigid = solve_dents(FiniteStack(dataclasses.replace(body, gap=(middle, middle))), None, [])
    bent: dict[float, list[Correction]] = {}
    frames: dict[float, tuple[ContactFrame | None, ContactFrame | None]] = {}
    for angle in sorted(ANGLES_DEG, key=abs):
        fixed, state = (case.design, case.clamp, case.mechanics, Bend(angle)), None
        frames[angle] = None, None
        if angle:
            state = bend_table.equilibrium(*fixed)
            shapes = state, bend_table.bend(*fixed)
            top, gel = (ContactFrame.from_bent_top(shape, x, y, about.stack) for shape in shapes)
            frames[angle] = top, gel
        near = bent[min(bent, key=lambda each: abs(each - angle))] if bent else []
        bent[angle] = solve_dents(FiniteStack(body, 1, state), frames[angle][0], near)
    fields, extra = [], []
    for angle, (k, dent) in product(ANGLES_DEG, enumerate(dents)):
        there, here = bent[angle][k], rigid[k]
        turned = [DentField(x, y, case.indenter, dent, frame) for frame in frames[angle]]
        values = partial(_difference, there, here, turned)
        field = Field.from_function(values, case.bases(), about.height, _DEGREE)
        fields.append(field.coefficients / dent.depth)
        extra.append((there.sunk[0] - here.sunk[0]) / dent.depth)
    shape = len(ANGLES_DEG), len(_PARTS)
    every = np.array(fields)
    return PressFields(every.reshape(*shape, *every.shape[1:]), np.reshape(extra, shape))


def _difference(
    pressed: Correction, flat: Correction, frames: Sequence[DentField], points: Array
) -> Array:
    """d [m] and its mean stress [Pa], (..., 4), at points of the gel (..., 3) [m]."""
    values = pressed.in_gel(points)
    rigid = flat.in_gel(points)
    bent, gel = frames
    if gel.frame is not None:
        rigid[..., :3] = gel.frame.rotate_vectors(rigid[..., :3])
        over_base = (points + np.array([0.0, 0.0, pressed.bottom])).reshape(-1, 3)
        for dent, sign in ((bent, 1.0), (gel, -1.0)):
            at = dent.evaluate(over_base)
            stacked = np.concatenate([at.displacement, at.mean_stress[:, None]], axis=1)
            values += sign * stacked.reshape(values.shape)
    return np.asarray(values - rigid)


@dataclass(frozen=True, slots=True)
class PlateBend:
    """Sensor on plates at one angle, as touches press it.

    Attributes:
        design: design on the support `Plates`, of rectangular outline.
        clamp: clamp of the plates.
        mechanics: materials.
        grid: nominal values about which tables are solved.
        angle_deg: angle between the plates; 0 where they are flat.
    """

    design: SensorDesign
    clamp: Clamp
    mechanics: Mechanics
    grid: SensorGrid
    angle_deg: float = 0.0

    @property
    def bend(self) -> Deformation | None:
        """Bend of the gel by tables; None where the plates are flat."""
        return _bend(self) if self.angle_deg else None

    @property
    def state(self) -> BentState | None:
        """Equilibrium of the whole bent stack, solved in some seconds; None where it is flat."""
        if not self.angle_deg:
            return None
        fixed = self.design, self.clamp, self.mechanics, Bend(self.angle_deg)
        return bend_table.equilibrium(*fixed)

    def problem(self, indenter: Indenter) -> Problem:
        """Table of presses by an indenter."""
        return _problem(self._case(indenter))

    def deepest(self, indenter: Indenter, x: float) -> float:
        """Deepest dent at x that the table reaches [m]; 0 at an angle that it does not reach."""
        depth = self._deepest(self._case(indenter), x) * (1.0 + _DEPTH_MARGIN)
        return float(depth) if ANGLES_DEG[0] <= self.angle_deg <= ANGLES_DEG[-1] else 0.0

    def check(self, indenter: Indenter, x: float, depth: float) -> None:
        """Raise ConfigurationError for a dent at x to a depth [m] that the table does not reach."""
        self._require_reach(indenter, np.array([[x, 0.0, depth]]), np.array([self.angle_deg]))

    def evaluate(
        self,
        indenter: Indenter,
        places: Array,
        angles_deg: Array,
        scenes: Indices,
        sums: NodeSums | None = None,
    ) -> Array:
        """Add what plates at angles change of presses on a rigid base to scenes (n,) of sums.

        Places are (x, y, depth) of presses, (n, 3) [m]; angles (n,) replace that of these plates.
        Returns by how much deeper each sinks [m]. Raises ConfigurationError beyond the table.
        """
        self._require_reach(indenter, places, angles_deg)
        case = self._case(indenter)
        table, (along, across) = load_or_solve(_problem(case), _table), case.bases()
        (x, y, depth), higher = places.T, self.design.thickness / table.size("height")
        images = DIRECT, MIRRORED_Y, MIRRORED_X, BOTH_MIRRORED
        every = sum_of(table, (table,), sums.components if sums else 3, images)
        # Beyond the outermost solved place the plates change nearly nothing.
        first, nominal = float(table.nodes("x")[0]), self._nominal_places(case, x)
        place = {"x": np.clip(nominal, first, self.design.outline.length - first), "y": y}
        part = depth / self._deepest(case, x)
        amounts, extra = every.amounts(
            [1.0], self.design.thickness, **place, angle=_stiffening(angles_deg), part=part
        )
        if sums:
            amounts = amounts * (depth / higher)[:, None]
            functions = along.dense(sums.nodes[0]), across.dense(sums.nodes[1])
            sums.add(every.modes, amounts, *functions, scenes)
        return np.asarray(extra * depth / higher)

    def _is_reached(
        self, indenter: Indenter, x: Array | float, depth: Array | float, angle_deg: Array | float
    ) -> Array:
        """Whether dents at x to depths [m] are within the table."""
        deepest = self._deepest(self._case(indenter), x) * (1.0 + _DEPTH_MARGIN)
        in_angle = (ANGLES_DEG[0] <= np.asarray(angle_deg)) & (angle_deg <= ANGLES_DEG[-1])
        return np.asarray(in_angle & (depth <= deepest))

    def _require_reach(self, indenter: Indenter, places: Array, angles_deg: Array) -> None:
        """Raise ConfigurationError for places (x, y, depth) that the table does not reach."""
        reached = self._is_reached(indenter, places[:, 0], places[:, 2], angles_deg)
        if reached.all():
            return
        number = int(reached.argmin())
        x, _, depth = places[number].tolist()
        deepest = float(self._deepest(self._case(indenter), x))
        raise ConfigurationError(
            f"touches on plates are tabulated from {ANGLES_DEG[0]:g} to {ANGLES_DEG[-1]:g} deg, "
            f"and at x = {x:g} m to dents of {1e3 * deepest:.2f} mm, got "
            f"{angles_deg[number]:g} deg and {1e3 * depth:.2f} mm; press less or farther from the "
            "gap (in a recipe by from_middle), bend less, or solve scenes with "
            "touch_model='solved'"
        )

    def _case(self, indenter: Indenter) -> PlatesCase:
        return nominal_case(self.design, self.clamp, self.mechanics, indenter, self.grid)

    def _deepest(self, case: PlatesCase, x: Array | float) -> Array:
        """Deepest tabulated dents at x of this sensor [m]."""
        higher = self.design.thickness / case.design.thickness
        return higher * case.deepest(self._nominal_places(case, x))

    def _nominal_places(self, case: PlatesCase, x: Array | float) -> Array:
        """Places of the nominal sensor as far from the edge of its plate [m]."""
        middle = 0.5 * self.design.outline.length
        away = np.abs(x - middle) - 0.5 * (self.clamp.span - case.clamp.span)
        return np.asarray(middle + np.copysign(np.maximum(away, 0.0), x - middle))


def held_by_plates(
    design: SensorDesign,
    fixture: Fixture,
    mechanics: Mechanics,
    grid: SensorGrid,
    angle_deg: float = 0.0,
) -> PlateBend | None:
    """Sensor on plates that its clamp bends while it is pressed; None on another support.

    Other fixtures than a clamp bend it afterwards.
    """
    support = design.support
    if not isinstance(support, Plates) or not isinstance(design.outline, Rectangle):
        return None
    clamp = fixture if isinstance(fixture, Clamp) else Clamp()
    held = dataclasses.replace(clamp, span=support.span)
    return PlateBend(design, held, mechanics, grid, angle_deg if clamp is fixture else 0.0)


def _table(arrays: Arrays) -> SolutionTable:
    """Stored table, over the stiffening by its angles."""
    table = SolutionTable.from_arrays(arrays)
    axes = (
        axis._replace(nodes=_stiffening(axis.nodes)) if axis.name == "angle" else axis
        for axis in table.axes
    )
    return dataclasses.replace(table, axes=tuple(axes))


def _stiffening(angles_deg: Array) -> Array:
    """Rising measure of angles, in which fields over a gap are nearly straight."""
    return np.asarray(1.0 / (_SOFTEST_DEG - angles_deg))


@lru_cache(maxsize=128)
def _bend(plate_bend: PlateBend) -> Deformation:
    fixed = plate_bend.design, plate_bend.clamp, plate_bend.mechanics, Bend(plate_bend.angle_deg)
    return bend_table.bend(*fixed, plate_bend.grid)


@lru_cache(maxsize=64)
def _problem(case: PlatesCase) -> Problem:
    return case.problem()


@lru_cache(maxsize=64)
def nominal_case(
    design: SensorDesign, clamp: Clamp, mechanics: Mechanics, indenter: Indenter, grid: SensorGrid
) -> PlatesCase:
    """Case about which presses on a design on plates are solved."""
    thickness, span = grid.thickness or design.thickness, grid.span or clamp.span
    offset = clamp.offset if grid.offset is None else grid.offset
    gel = mechanics.gel.shear_modulus
    ratio = grid.ratio or mechanics.encapsulation.shear_modulus / gel
    nominal = SensorDesign(
        design.outline,
        thickness,
        uniform(design.outline, 2),
        encapsulated_thickness=thickness * design.encapsulated_thickness / design.thickness,
        support=Plates(span),
    )
    around = dataclasses.replace(mechanics.encapsulation, shear_modulus=ratio * gel)
    return PlatesCase(
        nominal,
        dataclasses.replace(clamp, span=span, offset=offset, faces="bottom"),
        dataclasses.replace(mechanics, encapsulation=around),
        indenter,
    )
