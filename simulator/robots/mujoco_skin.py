"""Skin on a body of a robot that MuJoCo simulates: touches of contacts, and fast frames of them."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline, make_interp_spline
from scipy.spatial import ConvexHull

from eitskin.errors import ConfigurationError
from eitskin.extras import require
from eitskin.frame import Frame
from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator.deformation.solution_store import Arrays, Problem, load_or_solve
from eitskin.simulator.instrument.drift import Session
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.indenters import Cylinder, Footprint, Sphere, distance
from eitskin.simulator.scene.scene import AnyIndenter, Scene, Touch
from eitskin.simulator.simulator import Simulator

PERIOD = 0.3  # s, of a frame of the AD5940
_SIZE_TOLERANCE = 0.01  # relative, of the box and the gel
_MIN_NORMAL_COSINE = 0.5  # cosine of the angle between a contact's normal and that of the face
_ON_TIME = 1e-9  # s, rounding of the time of a simulation
Array = NDArray[np.float64]
SPACING = 0.0025  # m, at most, between places of the table
FORCES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)  # of the table, over the strongest
_LEAST_RADIUS, _ROUNDED = 1e-3, 5e-4  # half the width of an edge; of corners of faces [m]
MIN_PLACES = 4  # places along an axis, for cubic splines
_VERSION = 1  # raise it whenever the table is solved in another way


@dataclass(frozen=True, slots=True)
class TouchRules:
    """Which contacts become touches, and within which limits.

    The defaults keep every touch within the tables of the reference sensor.

    Attributes:
        indenter: indenter of all touches by faces that are not larger; None for the shape of the
            body that presses: presses of a sphere or capsule its `Sphere`, of a cylinder its flat
            end. Faces are `Footprint`s, which are the hulls of their contacts. Presses by other
            indenters than the default one are solved scene by scene, which takes half a minute or
            more each; those of bodies of revolution are tabulated where the simulator has
            `touch_model="tabulated"`.
        least: weakest touch [N]; weaker ones are none.
        most: strongest touch [N]; stronger ones press as strongly as this.
        margin: least distance from the edge of the gel [m]; touches nearer to it are moved in.
    """

    indenter: AnyIndenter | None = field(default_factory=Cylinder)
    least: float = 0.05
    most: float = 12.0
    margin: float = 0.005

    def __post_init__(self) -> None:
        if not 0.0 < self.least < self.most < math.inf:
            raise ConfigurationError(
                f"expected 0 < least < most, forces in N, got {self.least} and {self.most}"
            )
        if not 0.0 <= self.margin < math.inf:
            raise ConfigurationError(f"expected a margin of 0 m or more, got {self.margin}")

    def apply(self, points: Iterable[Touch], outline: Rectangle) -> tuple[Touch, ...]:
        """Touches of the points of contact on a gel of this outline, strongest first.

        Points whose indenters would overlap are one touch: their forces are added, at the mean
        place weighted by force, with the indenter of the strongest.
        """
        extents = np.array([outline.length, outline.width])
        inside = []
        for point in points:
            low = high = np.minimum(self.margin, extents / 2)
            if isinstance(point.indenter, Footprint):
                low, high = (point.indenter.reach(way * np.eye(2)) for way in (-1.0, 1.0))
            x, y = np.clip([point.x, point.y], low, np.maximum(extents - high, low)).tolist()
            inside.append(replace(point, x=x, y=y))
        strong = [touch for touch in merge_overlapping(inside) if touch.force >= self.least]
        limited = [replace(touch, force=min(touch.force, self.most)) for touch in strong]
        return tuple(sorted(limited, key=lambda touch: (-touch.force, touch.x, touch.y)))


def merge_overlapping(touches: Iterable[Touch]) -> list[Touch]:
    """Touches of which no indenters overlap; those that overlap most are merged first."""
    found = list(touches)
    while True:
        overlaps = [
            (_overlap(found[i], found[j]), i, j) for i, j in combinations(range(len(found)), 2)
        ]
        most, i, j = max(overlaps, default=(0.0, 0, 0))
        if most <= 0.0:
            return found
        first, second = found[i], found.pop(j)
        force = first.force + second.force
        share = second.force / force
        strongest = first if first.force >= second.force else second
        found[i] = replace(
            strongest,
            x=first.x + share * (second.x - first.x),
            y=first.y + share * (second.y - first.y),
            force=force,
        )


def touch_of_face(contacts: Array, indenter: AnyIndenter | None) -> Touch:
    """Touch of one rigid face, which rests on some points of its rim.

    The face is the hull of its points; the force acts where that of the contacts does.

    Args:
        contacts: places and forces (x, y, force) of the points, (n, 3) [m, m, N].
        indenter: indenter of faces that are not larger; when None of single points.
    """
    places, forces = contacts[:, :2], contacts[:, 2]
    pressed, total = forces @ places / forces.sum(), float(forces.sum())
    corners = _hull(places) - pressed
    point = indenter or Cylinder()
    widest = 2.0 * (point.rims[1] if indenter else _LEAST_RADIUS)
    if len(corners) < 3 or np.ptp(corners, axis=0).max() <= widest:
        return Touch(float(pressed[0]), float(pressed[1]), total, point)
    # Shapes are solved once; those of later frames differ by less than this.
    rounded = np.trunc(corners / _ROUNDED) * _ROUNDED
    footprint = Footprint(corners=tuple(map(tuple, _hull(rounded).tolist())))
    return Touch(float(pressed[0]), float(pressed[1]), total, footprint)


def _hull(places: Array) -> Array:
    """Corners of the hull of places, at least as wide as a needle, (n, 2) [m], anticlockwise."""
    steps = places - places[0]
    far = steps[np.hypot(*steps.T).argmax()]
    if not np.hypot(*far) > _LEAST_RADIUS:
        return places[:1]
    across = np.array([-far[1], far[0]]) / np.hypot(*far)
    if np.ptp(places @ across) < 2.0 * _LEAST_RADIUS:  # an edge
        places = np.concatenate([places + way * _LEAST_RADIUS * across for way in (-1.0, 1.0)])
    return np.asarray(places[ConvexHull(places).vertices])


def _overlap(one: Touch, other: Touch) -> float:
    """Length by which the indenters of two touches overlap [m]; negative where they do not."""
    return -distance(one.indenter, other.indenter, np.array([other.x - one.x, other.y - one.y]))


class TouchTable:
    """Changes of the logarithm of all measurements by one touch, over place and force.

    Between the solved touches they are cubic splines. Changes of several touches are not their
    sum: neighbours that both press hard are a third of their signal off it.
    """

    def __init__(self, axes: tuple[Array, Array, Array], changes: Array) -> None:
        """Interpolate changes (x, y, force, values) at x [m], y [m] and forces [N], from 0 N on."""
        knots, coefficients = [], changes
        for axis, nodes in enumerate(axes):
            spline = make_interp_spline(nodes, coefficients, axis=axis)
            knots.append(spline.t)
            coefficients = np.moveaxis(spline.c, 0, axis)  # first, whatever the axis
        self._spline = NdBSpline(tuple(knots), coefficients, 3)

    @classmethod
    def load_or_solve(
        cls,
        simulator: Simulator,
        outline: Rectangle,
        indenter: AnyIndenter,
        rules: TouchRules,
        instrument: Instrument | None = None,
        spacing: float = SPACING,
    ) -> "TouchTable":
        """Table within some rules, from the user's folder for caches, or solved now and kept there.

        Solving takes as long as 7,200 scenes do for the reference sensor.
        """
        axes = _axes(outline, rules, spacing)
        flat = _logarithms(simulator, [Scene()], instrument)[0]
        sensor = simulator.design, simulator.mechanics, simulator.touch_model, simulator.grid
        described = {
            "version": _VERSION,
            "flat": flat.tolist(),
            "axes": [axis.tolist() for axis in axes],
            "sensor": repr(sensor),
            "indenter": repr(indenter),
        }

        def solve(_: object) -> Arrays:
            places = [Touch(x, y, f, indenter) for x in axes[0] for y in axes[1] for f in axes[2]]
            scenes = [Scene(touches=(touch,)) for touch in places]
            changes = _logarithms(simulator, scenes, instrument) - flat
            return {"changes": changes.reshape(*map(len, axes), len(flat))}

        changes = load_or_solve(Problem("touches", described, solve), dict)["changes"]
        # Without force nothing changes.
        forces = np.concatenate([[0.0], axes[2]])
        return cls((axes[0], axes[1], forces), np.pad(changes, [(0, 0), (0, 0), (1, 0), (0, 0)]))

    def factors(self, touches: Sequence[Touch]) -> NDArray[np.complex128]:
        """Measurements under each touch over those of the untouched sensor, (touches, values)."""
        points = np.array([(touch.x, touch.y, touch.force) for touch in touches]).reshape(-1, 3)
        real, imaginary = np.split(self._spline(points), 2, axis=1)
        return np.asarray(np.exp(real + 1j * imaginary))


def _axes(outline: Rectangle, rules: TouchRules, spacing: float) -> tuple[Array, Array, Array]:
    """Places along x and y [m] and forces [N] at which touches are solved."""

    def axis_positions(length: float) -> Array:
        margin = min(rules.margin, length / 3)
        count = int(np.ceil((length - 2.0 * margin) / spacing - 1e-9)) + 1
        return np.linspace(margin, length - margin, max(count, MIN_PLACES))

    return (
        axis_positions(outline.length),
        axis_positions(outline.width),
        rules.most * np.array(FORCES),
    )


def _logarithms(
    simulator: Simulator, scenes: Sequence[Scene], instrument: Instrument | None
) -> Array:
    """Logarithms of all measurements, real parts before imaginary ones, (scenes, values)."""
    solved = simulator.measure_all(scenes, instrument=instrument)
    logarithms = np.log(solved.reshape(len(scenes), -1))
    return np.concatenate([logarithms.real, logarithms.imag], axis=1)


class MujocoSkin:
    """Skin on the upper face (+z) of a box geom, in one simulation or in many of one model.

    The face is the sensor's touched side: x runs along the box's x, y along its y, from the corner
    where both are smallest. Forces are those that MuJoCo's contacts press onto the face with;
    what touches the other faces is not detected. The box is as stiff as its `solref` and `solimp`
    make it, whatever the gel.

    Attributes:
        simulator: simulator of the sensor.
        period: time between frames [s].
        rules: rules by which contacts become touches.
    """

    def __init__(
        self,
        simulator: Simulator,
        model: Any,
        geom: str,
        period: float = PERIOD,
        rules: TouchRules | None = None,
        instrument: Instrument | None = None,
        seed: int = 0,
        touch_table: bool = False,
    ) -> None:
        """Put a sensor on a geom.

        Args:
            simulator: simulator of the sensor, a rectangle.
            model: a mujoco.MjModel.
            geom: name of the box geom.
            period: time between frames [s].
            rules: rules by which contacts become touches; the default ones when omitted.
            instrument: adds the errors of a board to each simulation, with a session of its own.
            seed: seed of the instrument's errors and noise.
            touch_table: take frames of one touch from a `TouchTable`, hundreds of times as fast;
                it is solved at the first use, within minutes, and kept.

        Raises:
            ImportError: naming the extra, where mujoco is missing.
            ConfigurationError: for a geom that is not there, is no box, or has another size than
                the sensor; for a table without an indenter.
        """
        self._mujoco: Any = require("mujoco", "mujoco")
        if not period > 0.0:
            raise ConfigurationError(f"expected a period of frames above 0 s, got {period}")
        self.simulator, self.period, self.rules = simulator, period, rules or TouchRules()
        self._model, self._geom = model, self._find_geom(model, geom)
        self._outline = _matching_outline(simulator, model.geom_size[self._geom], geom)
        self._instrument, self._seeds = instrument, np.random.SeedSequence(seed)
        self._untouched = simulator.measure_all([Scene()], instrument=instrument)[0]
        self._table = self._touch_table() if touch_table else None
        self._boards: list[_Board] = []

    def touches(self, data: Any) -> tuple[Touch, ...]:
        """Touches of the skin in the present state of a mujoco.MjData, strongest first."""
        axes = data.geom_xmat[self._geom].reshape(3, 3)
        centre = data.geom_xpos[self._geom]
        bodies = data.contact.geom
        contacts: dict[int, list[tuple[float, float, float]]] = {}
        for row in np.flatnonzero((bodies == self._geom).any(axis=1)):
            place = (data.contact.pos[row] - centre) @ axes
            normal = data.contact.frame[row][:3] @ axes
            if place[2] < 0.0 or abs(normal[2]) < _MIN_NORMAL_COSINE:
                continue
            force = -float(self._push(data, int(row)) @ axes[:, 2])
            if force > 0.0:
                x = float(place[0]) + self._outline.length / 2
                y = float(place[1]) + self._outline.width / 2
                presser = bodies[row][0] if bodies[row][1] == self._geom else bodies[row][1]
                contacts.setdefault(int(presser), []).append((x, y, force))
        points = [
            touch_of_face(np.array(pressed), self._indenter(presser))
            for presser, pressed in contacts.items()
        ]
        return self.rules.apply(points, self._outline)

    def update(self, simulations: Sequence[Any]) -> list[Frame | None]:
        """Frames that are due in some simulations; call it after each step.

        Args:
            simulations: mujoco.MjData of the model, the same ones in the same order each time.

        The first call gives each its first frame, in which nothing should touch the skin. The
        session of a simulation whose time went back, as by mj_resetData, begins again. Frames show
        the moment at which they are due, and all that are due are solved together. Frames that a
        step jumped over are missing by number.

        Raises ConfigurationError for another number of simulations than before.
        """
        if not self._boards:
            self._boards = [_Board() for _ in simulations]
        if len(simulations) != len(self._boards):
            raise ConfigurationError(
                f"expected the {len(self._boards)} simulations of the first call, got "
                f"{len(simulations)}; make a skin for each set of simulations"
            )
        frames: list[Frame | None] = [None] * len(simulations)
        due = [
            (i, board.due_frame(float(data.time), self.period))
            for i, (board, data) in enumerate(zip(self._boards, simulations, strict=True))
        ]
        due_boards = [(i, number) for i, number in due if number is not None]
        solved = self._simulate_measurements([self.touches(simulations[i]) for i, _ in due_boards])
        for (i, number), impedance in zip(due_boards, solved, strict=True):
            frames[i] = self._frame(self._boards[i], number, impedance)
        return frames

    def _simulate_measurements(
        self, touches: Sequence[tuple[Touch, ...]]
    ) -> list[NDArray[np.complex128]]:
        """Noise-free measurements of each; those without touches are known."""
        measurements = [self._untouched] * len(touches)
        single = [
            i
            for i, touch in enumerate(touches)
            if self._table is not None
            and len(touch) == 1
            and touch[0].indenter == self.rules.indenter
        ]
        if self._table is not None and single:
            factors = self._table.factors([touches[i][0] for i in single])
            for i, factor in zip(single, factors, strict=True):
                measurements[i] = self._untouched * factor.reshape(self._untouched.shape)
        unsolved = [i for i, touch in enumerate(touches) if touch and i not in single]
        scenes = [Scene(touches=touches[i]) for i in unsolved]
        if scenes:
            solved = self.simulator.measure_all(scenes, instrument=self._instrument)
            for i, impedance in zip(unsolved, solved, strict=True):
                measurements[i] = impedance
        return measurements

    def _touch_table(self) -> TouchTable:
        indenter = self.rules.indenter
        if indenter is None:
            raise ConfigurationError(
                "expected rules with an indenter, of which a table is made, got None; choose one "
                "for all touches, or leave out touch_table"
            )
        return TouchTable.load_or_solve(
            self.simulator, self._outline, indenter, self.rules, self._instrument
        )

    def _frame(self, board: "_Board", number: int, impedance: NDArray[np.complex128]) -> Frame:
        """Frame of one simulation, with the errors of its board where there is an instrument."""
        time, protocol = number * self.period, self.simulator.protocol
        if self._instrument is None:
            return Frame(impedance, protocol, time, number, board.number)
        if board.session is None:
            rng = np.random.default_rng(self._seeds.spawn(1)[0])
            scale = self.simulator.instrument_full_scale(self._instrument)
            board.session = self._instrument.session(protocol, scale, rng), rng
        session, rng = board.session
        (values,), (status,) = session.measure(impedance[None], np.array([time]), rng)
        return Frame(values, protocol, time, number, board.number, status=status)

    def _push(self, data: Any, row: int) -> NDArray[np.float64]:
        """Force of one contact on the skin [N], (3,), in axes of the world."""
        wrench = np.zeros(6)
        self._mujoco.mj_contactForce(self._model, data, row, wrench)
        # MuJoCo's is the force on the second geom, in rows of axes.
        force = wrench[:3] @ data.contact.frame[row].reshape(3, 3)
        return np.asarray(force if data.contact.geom[row][1] == self._geom else -force)

    def _indenter(self, geom: int) -> AnyIndenter | None:
        """Indenter that stands for a geom; None for one that presses with a face."""
        if self.rules.indenter is not None:
            return self.rules.indenter
        kinds, radius = self._mujoco.mjtGeom, float(self._model.geom_size[geom][0])
        kind = kinds(int(self._model.geom_type[geom]))
        if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE):
            return Sphere(radius)
        return Cylinder(radius) if kind == kinds.mjGEOM_CYLINDER else None

    def _find_geom(self, model: Any, name: str) -> int:
        """Number of the box geom of a name."""
        objects = self._mujoco.mjtObj.mjOBJ_GEOM
        number = self._mujoco.mj_name2id(model, objects, name)
        if number < 0:
            geom_names = [model.geom(i).name for i in range(model.ngeom) if model.geom(i).name]
            raise ConfigurationError(
                f"expected the name of a geom, got '{name}'; the model has {', '.join(geom_names)}"
            )
        if model.geom_type[number] != self._mujoco.mjtGeom.mjGEOM_BOX:
            raise ConfigurationError(
                f"expected a box, on whose upper face the skin lies, but geom '{name}' is none; "
                "put a box of the sensor's length and width there"
            )
        return int(number)


@dataclass
class _Board:
    """Board of one simulation.

    Attributes:
        number: number of its session.
        began: time of the simulation when the session began [s]; NaN before.
        last: number of the newest frame.
        now: time of the simulation at the last call [s].
        session: its errors and its noise, where there is an instrument.
    """

    number: int = -1
    began: float = float("nan")
    last: int = -1
    now: float = float("inf")
    session: tuple[Session, np.random.Generator] | None = None

    def due_frame(self, now: float, period: float) -> int | None:
        """Number of the frame that is due at a time of the simulation [s]; None for none."""
        if now < self.now:
            self.number, self.began, self.last, self.session = self.number + 1, now, -1, None
        self.now = now
        number = int((now - self.began + _ON_TIME) / period)
        if number <= self.last:
            return None
        self.last = number
        return number


def _matching_outline(simulator: Simulator, half_size: NDArray[np.float64], geom: str) -> Rectangle:
    """Outline of the sensor; raises ConfigurationError where the box's face is another."""
    outline = simulator.design.outline
    if not isinstance(outline, Rectangle):
        raise ConfigurationError(
            f"expected a rectangular sensor on a box, got a {type(outline).__name__.lower()}; "
            "make scenes of its touches yourself, with TouchRules"
        )
    size, geom_size = (outline.length, outline.width), 2.0 * half_size[:2]
    if not np.allclose(geom_size, size, rtol=_SIZE_TOLERANCE):
        raise ConfigurationError(
            f"expected geom '{geom}' to be as large as the gel, {size[0]:g} x {size[1]:g} m, "
            f"got {geom_size[0]:g} x {geom_size[1]:g} m; a box's size in MJCF is half of that"
        )
    return outline
