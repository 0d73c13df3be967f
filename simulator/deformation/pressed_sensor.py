"""Sensor that is touched: the dents of its touches, and their solution in 3D."""

import math
from dataclasses import replace
from functools import lru_cache, partial
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Clamp
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.sensor import Free, Plates, SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.deformation.contact import (
    BentState,
    ContactFrame,
    DentField,
    PunchedArea,
)
from eitskin.simulator.deformation.dents import TabulatedDent
from eitskin.simulator.deformation.finite_stack import FiniteStack, require_on_stack
from eitskin.simulator.deformation.node_sums import NodeSums
from eitskin.simulator.deformation.press_table import indenter_samples, press_table
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid
from eitskin.simulator.deformation.solution_store import Problem, load_or_solve
from eitskin.simulator.deformation.solved_correction import Correction
from eitskin.simulator.deformation.tabled_corrections import is_tabulable
from eitskin.simulator.mechanics import viscoelasticity as relaxation
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.fitted_plan import Contact
from eitskin.simulator.mechanics.layer_stack import Indentation, Mechanics, Stack
from eitskin.simulator.mechanics.stack_mesh import stack_mesh
from eitskin.simulator.scene.indenters import Cylinder, Footprint
from eitskin.simulator.scene.scene import AnyIndenter, Touch

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
TouchModel = Literal["tabulated", "solved"]

# Search for depths: their error, first dent where the base gives way over the thickness of the
# stack, largest step, and least sinking over a dent's depth.
DEPTH_TOLERANCE, _FIRST_DENT = 1e-3, 0.1
_LARGEST_STEP, _LEAST_SUNK = math.log(4.0), -0.9
_SHALLOW = 0.05  # typical depth of a flat punch over the thickness of the stack
_COMPACT = 1.5  # slenderness of a punch up to which small cells at its extents suffice
_INNER = 1.0 / 3.0  # extents within those of a slender one at which cells are small, over these
_CELL = 1.0 / 40.0  # finest of the axisymmetric press, over the radius of the indenter
_MAX_SCENES = 64  # in memory
_VERSION = 2  # of solved presses: raise it whenever they are solved in another way


class PlatesUnder(Protocol):
    """Plates under a sensor at one angle, as its presses see them."""

    @property
    def clamp(self) -> Clamp:
        """Clamp of the plates."""
        ...

    @property
    def angle_deg(self) -> float:
        """Angle between the plates; 0 where they are flat."""
        ...

    @property
    def bend(self) -> Deformation | None:
        """Bend of the gel; None where the plates are flat."""
        ...

    @property
    def state(self) -> BentState | None:
        """Equilibrium of the whole bent stack, which takes seconds; None where it is flat."""
        ...

    def problem(self, indenter: AnyIndenter) -> Problem:
        """Table of what the plates change of presses by an indenter."""
        ...

    def deepest(self, indenter: AnyIndenter, x: float) -> float:
        """Deepest dent at x that the table reaches [m]; 0 at an angle that it does not reach."""
        ...

    def evaluate(
        self,
        indenter: AnyIndenter,
        places: Array,
        angles_deg: Array,
        scenes: Indices,
        sums: NodeSums | None,
    ) -> Array:
        """Add what plates at angles (n,) change of presses (x, y, depth), (n, 3) [m], to sums.

        There presses have scenes (n,). Returns by how much deeper each sinks [m], (n,).
        """
        ...


class PressedSensor(NamedTuple):
    """Sensor that is touched.

    Attributes:
        design: design of the sensor, with its support.
        mechanics: materials.
        model: way to the corrections of dents; None chooses.
        grid: nominal values about which tables are solved.
        plates: plates that hold the sensor and may bend it; None on another support.
    """

    design: SensorDesign
    mechanics: Mechanics
    model: TouchModel | None = None
    grid: SensorGrid = OWN_GRID
    plates: PlatesUnder | None = None

    @property
    def is_tabulable(self) -> bool:
        """Whether corrections of its presses can be tabulated."""
        on_plates = isinstance(self.design.support, Plates)
        return is_tabulable(self.design) and on_plates == (self.plates is not None)

    @property
    def is_bent(self) -> bool:
        """Whether plates bend it."""
        return self.plates is not None and self.plates.angle_deg != 0.0

    @property
    def bend(self) -> Deformation | None:
        """Bend by the plates, in which the sensor is pressed; None for one pressed flat."""
        return None if self.plates is None else self.plates.bend

    @property
    def state(self) -> BentState | None:
        """Equilibrium of the bent stack, solved in some seconds; None for one pressed flat."""
        return None if self.plates is None else self.plates.state

    def solve(self, presses: tuple[Touch, ...]) -> Correction:
        """Correction of presses in 3D, by `solved_presses`; seconds to some minutes.

        That of presses by footprints is stored.
        """
        solved = partial(solved_presses, self.design, self.mechanics, presses)
        if not any(isinstance(press.indenter, Footprint) for press in presses):
            return solved(self.state)
        stack, mechanics = self.mechanics.stack(self.design), self.mechanics
        fixed = self.design.outline, self.design.support, mechanics.encapsulation, mechanics.margin
        held = None if self.plates is None else (self.plates.clamp, self.plates.angle_deg)
        described = {
            "version": _VERSION,
            "sensor": repr((stack, fixed, held)),
            "presses": [
                [press.x, press.y, press.force, press.depth, _describe(press.indenter)]
                for press in presses
            ],
        }
        problem = Problem("presses", described, lambda _: solved(self.state).arrays())
        return load_or_solve(problem, Correction.from_arrays)

    def frames(self, shape: BentState | Deformation, places: Array) -> list[ContactFrame]:
        """Frames of the top of the bent stack under places (n, 2) [m]."""
        return ContactFrame.from_places(shape, places, self.mechanics.stack(self.design))


def _describe(indenter: AnyIndenter) -> object:
    return repr(indenter) if isinstance(indenter, Footprint) else indenter_samples(indenter)


@lru_cache(maxsize=_MAX_SCENES)
def solved_presses(
    design: SensorDesign,
    mechanics: Mechanics,
    presses: tuple[Touch, ...],
    bend: BentState | None = None,
) -> Correction:
    """Correction of presses on a design, flat or bent, solved in 3D; seconds to some minutes.

    The depths of bodies of revolution are those in the unbounded stack; those of footprints are
    prescribed, or follow from their forces.

    Raises ConfigurationError for a press that overhangs the stack, SolidError where presses are not
    carried.
    """
    if isinstance(design.outline, Surface):
        raise ConfigurationError("touches on a body from a surface file are solved on tetrahedra")
    stack, contacts = mechanics.stack(design), []
    dents: list[DentField] = []
    punches: list[PunchedArea] = []
    for press in presses:
        x, y, depth, indenter = press.x, press.y, press.depth, press.indenter
        frame = None if bend is None else ContactFrame.from_bent_top(bend, x, y, stack)
        along, across = (1.0, 1.0) if frame is None else frame.stretches.tolist()
        if isinstance(indenter, Footprint):
            deep = _SHALLOW * stack.levels[-1] if depth is None else depth
            force = press.force if depth is None else None
            punches.append(PunchedArea(x, y, indenter, deep, force, frame))
            punches[-1].require_room(design.outline, mechanics.margin)
            low, high = punches[-1].bounds
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            radius, (along, across) = float(half.max()), (half.max() / half).tolist()
            at_x, at_y = middle.tolist()
            within = float(indenter.depth_inside(indenter.middle)) - punches[-1].inset
            # Long edges that cross cells need small ones all over.
            crossing = not indenter.is_aligned and indenter.slenderness > _COMPACT
            for part in (1.0, _INNER) if crossing else (1.0,):
                contacts.append(Contact(at_x, at_y, part * radius, (along, across), within))
            continue
        if depth is None:
            raise ConfigurationError("touches are solved to depths, got one without")
        require_on_stack(design.outline, x, y, indenter.rims[1] - mechanics.margin)
        contacts.append(Contact(x, y, indenter.rims[1], (along, across)))
        dents.append(DentField(x, y, indenter, _dent(stack, indenter, depth), frame))
    body = stack_mesh(design.outline, stack, mechanics, design.support, contacts)
    motions = len(presses) + 2 * sum(punch.tilts for punch in punches)
    found = FiniteStack(body, motions, bend).correction(dents, None, punches)
    order = np.argsort([isinstance(press.indenter, Footprint) for press in presses], kind="stable")
    place = np.argsort(order)
    return replace(found, sunk=found.sunk[place], holding=found.holding[place])


@lru_cache(maxsize=_MAX_SCENES)
def _dent(stack: Stack, indenter: AnyIndenter, depth: float) -> Indentation:
    """Axisymmetric press to a depth [m] on an unbounded stack."""
    return AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1]).to_depth(depth)


class DentedTouch(NamedTuple):
    """Touch with its dent in the unbounded stack.

    Attributes:
        touch: touch of the scene.
        force: force on the indenter [N]; of a footprint that presses to a depth over that at the
            first moment.
        press: instantaneous press that leaves the same dent: to its depth, or of a footprint with a
            force or to a depth; None where it has faded.
        dent: dent of a body of revolution; None of a footprint, which is solved as a whole.
    """

    touch: Touch
    force: float
    press: Touch | None
    dent: TabulatedDent | None = None

    @property
    def depth(self) -> float:
        """Depth in the unbounded stack [m]; 0 without a dent."""
        return 0.0 if self.dent is None else self.dent.depth


def dent_touch(touch: Touch, depth: float, sensor: PressedSensor) -> DentedTouch:
    """Dent of a touch at its time.

    `depth` is that of the first moment's dent [m] where a body of revolution presses to a depth.
    """
    if isinstance(touch.indenter, Footprint):
        return _press_footprint(touch, sensor)
    table = press_table(sensor.design, sensor.mechanics, touch.indenter, sensor.grid)
    by_force = touch.depth is None
    dent = table.dent_from_force(touch.force) if by_force else table.dent_from_depth(depth)
    elastic, force = _relax(touch, dent.force, dent.share, sensor.mechanics)
    if not elastic > 0.0:
        return DentedTouch(touch, force, None)
    if touch.held is not None:
        dent = table.dent_from_force(elastic)
    press = Touch(touch.x, touch.y, indenter=touch.indenter, depth=dent.depth)
    return DentedTouch(touch, force, press, dent)


def _press_footprint(touch: Touch, sensor: PressedSensor) -> DentedTouch:
    """Instantaneous press of a footprint in place of a touch at its time."""
    by_force, share = touch.depth is None, 0.0
    if touch.released and not by_force:
        raise ConfigurationError(
            "a footprint that was released needs the force with which it pressed, got a depth of "
            f"{touch.depth} m; `Simulator.presses` of the scene before the release gives it"
        )
    if touch.held is not None:  # it relaxes as the default cylinder does at its mean pressure
        disc = Cylinder(rough=touch.indenter.rough)
        table = press_table(sensor.design, sensor.mechanics, disc, sensor.grid)
        alike = touch.force * (disc.rims[1] / touch.indenter.rims[1]) ** 2
        share = table.dent_from_force(min(alike, table.largest_force)).share
    elastic, force = _relax(touch, touch.force if by_force else 1.0, share, sensor.mechanics)
    press = replace(touch, held=None, released=0.0, before=())
    if by_force and elastic > 0.0:
        press = replace(press, force=elastic)
    return DentedTouch(touch, force, press if elastic > 0.0 else None)


def _relax(touch: Touch, force: float, share: float, mechanics: Mechanics) -> tuple[float, float]:
    """Elastic force of a touch and the force on its indenter [N], from that of the first moment.

    The gel has a share of the force. Elastic forces of loads in turn add up (Boltzmann).
    """
    if touch.held is None:
        return force, force
    prony = relaxation.mixture(
        (mechanics.gel_relaxation, mechanics.encapsulation_relaxation), (share, 1.0 - share)
    )
    if touch.depth is None:
        loads = ((touch.force, touch.held, touch.released), *touch.before)
        elastic = sum(relaxation.elastic_force(prony, *load) for load in loads)
        acting = touch.force
    else:
        elastic = relaxation.elastic_force_at_depth(prony, force, touch.held, touch.released)
        acting = force * float(prony.relaxation(touch.held))
    return elastic if elastic > relaxation.FADED * force else 0.0, 0.0 if touch.released else acting


class DepthSearch:
    """Search for dents whose depths, with what the finite stack sinks, are the prescribed ones.

    Broyden's method (Broyden 1965) for the logarithms of the depths, since dents and sinking grow
    nearly in proportion; for one touch it is the secant method. Over a gap the stack sinks much
    more than a dent is deep, so that a fixed-point iteration would not converge.

    Attributes:
        depths: depths of the dents in the unbounded stack to try next [m]; NaN for prescribed
            forces and for footprints, which have no dents.
        is_needed: whether any depth is prescribed.
    """

    def __init__(self, touches: tuple[Touch, ...], design: SensorDesign) -> None:
        bodies = [None if isinstance(t.indenter, Footprint) else t.depth for t in touches]
        target_depths = [math.nan if depth is None else depth for depth in bodies]
        self._wanted = np.array(target_depths)
        self.depths = np.array(
            [
                min(depth, _FIRST_DENT * design.encapsulated_thickness)
                if _gives_way(touch, design)
                else depth
                for touch, depth in zip(touches, target_depths, strict=True)
            ]
        )
        self._given = np.isfinite(self.depths)
        self.is_needed = bool(self._given.any())
        self._jacobian = np.eye(int(self._given.sum()))
        self._last: tuple[Array, Array] | None = None

    def advance(self, dents: Array, sunk: Array) -> bool:
        """Whether the wanted depths are met; otherwise `depths` are those to try next.

        Args:
            dents: present depths of the dents, which may have faded since their release [m].
            sunk: length by which each indenter now sinks deeper than its dent [m].
        """
        part = np.divide(sunk, dents, out=np.zeros(len(dents)), where=dents > 0.0)[self._given]
        tried = np.log(self.depths[self._given])
        reached = tried + np.log1p(np.maximum(part, _LEAST_SUNK))
        error = reached - np.log(self._wanted[self._given])
        if np.all(np.abs(error) < DEPTH_TOLERANCE):
            return True
        if self._last is not None:
            step, change = tried - self._last[0], error - self._last[1]
            self._jacobian += np.outer(change - self._jacobian @ step, step) / (step @ step)
        self._last = tried, error
        step = -np.linalg.lstsq(self._jacobian, error)[0]
        step *= min(1.0, _LARGEST_STEP / np.abs(step).max())
        self.depths[self._given] = np.exp(tried + step)
        return False


def _gives_way(touch: Touch, design: SensorDesign) -> bool:
    """Whether the base under a touch is free, so that the stack may sink more than it is dented."""
    if isinstance(design.support, Free):
        return True
    if not isinstance(design.support, Plates) or isinstance(design.outline, Surface):
        return False
    start, end = design.support.gap(design.outline)
    beside = design.encapsulated_thickness
    return start - beside < touch.x < end + beside
