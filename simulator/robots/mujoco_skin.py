"""Skin on a body of a robot that MuJoCo simulates."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.extras import require
from eitskin.frame import Frame
from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.instrument.session import Session
from eitskin.simulator.robots.touch_table import TouchRules, TouchTable, touch_of_face
from eitskin.simulator.scene.indenters import Cylinder, Sphere
from eitskin.simulator.scene.scene import AnyIndenter, Scene, Touch
from eitskin.simulator.simulator import Simulator

PERIOD = 0.3  # s, of a frame of the AD5940
_SIZE_TOLERANCE = 0.01  # relative, of the box and the gel
_MIN_NORMAL_COSINE = 0.5  # cosine of the angle between a contact's normal and that of the face
_ON_TIME = 1e-9  # s, rounding of the time of a simulation


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
