"""Simulator: frames of one sensor, from scenes."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, reduce
from typing import TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import kernels
from eitskin.errors import ConfigurationError
from eitskin.extras import old_names
from eitskin.frame import Frame
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture
from eitskin.geometry.deformation.kinematics import Composition, Deformation
from eitskin.geometry.design.dispersion import FREQUENCY
from eitskin.geometry.design.outline import Polygon
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import Rigid, SensorDesign, Support, require_fit
from eitskin.geometry.design.surface import Surface
from eitskin.protocol import Protocol
from eitskin.simulator.bends import bend_table
from eitskin.simulator.bends.pressed_plates import ANGLES_DEG, held_by_plates
from eitskin.simulator.bodies.body_deformation import (
    pressed_body_touches,
    require_pressable,
    solve_bend,
    solve_presses,
)
from eitskin.simulator.bodies.tetrahedral_solid import TetrahedralField
from eitskin.simulator.deformation.dents import BentPresses, Dents
from eitskin.simulator.deformation.pressed_sensor import PressedSensor, TouchModel
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid
from eitskin.simulator.deformation.touches import (
    dents,
    pressed_touches,
    require_model,
    resolve_touch_model,
)
from eitskin.simulator.electrical.batch import TOLERANCE, Tolerance
from eitskin.simulator.electrical.deformed_layer import DeformedLayer
from eitskin.simulator.electrical.forward_model import AreaRatio, ForwardModel
from eitskin.simulator.electrical.resolution import Discretisation, Resolution
from eitskin.simulator.electrical.sensor_impedances import (
    SensorImpedances,
    solve_together,
    without_touches,
)
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import PressedTouch, Scene, Touch, require_bendable

Array = NDArray[np.float64]
Field: TypeAlias = Callable[[Array], NDArray[np.inexact]]


@old_names(
    deformed="simulate_deformation",
    full_scale_on="instrument_full_scale",
    supported="design_on_support",
)
class Simulator:
    """One sensor on one fixture, meshed once; `measure` gives the frame of any scene.

    Attributes:
        design: the sensor.
        fixture: fixture that bends the sensor.
        protocol: drive and sense pairs of the measurements.
        mechanics: materials of gel and encapsulation.
        touch_model: "tabulated" or "solved", the way to the corrections of touches; None chooses.

    Example:
        >>> from eitskin import Bend, Scene, SensorDesign, Simulator
        >>> sim = Simulator(SensorDesign.reference(), "coarse")
        >>> sim.measure(Scene(bend=Bend(20.0))).impedance.shape
        (28,)
    """

    def __init__(
        self,
        design: SensorDesign,
        resolution: Resolution | Discretisation = "standard",
        fixture: Fixture | None = None,
        protocol: Protocol | None = None,
        mechanics: Mechanics | None = None,
        touch_model: TouchModel | None = None,
        nominal: SensorDesign | None = None,
        grid: SensorGrid | None = None,
    ) -> None:
        """Prepare the sensor; its mesh has faces where the fixture clamps it.

        Args:
            design: the sensor.
            resolution: "coarse", "fast", "standard" or "fine", or element order and grading.
            fixture: fixture that bends the sensor; the default clamp when omitted, whose bends of
                other sensors than the reference are solved at their first use, in half a minute.
            protocol: drive and sense pairs; every pair of electrodes, which is drive and sense pair
                in one, when omitted.
            mechanics: materials of gel and encapsulation; the reference sensor's when omitted.
            touch_model: corrections of dents in the finite stack are "tabulated", solved once for
                each stack and indenter, which takes minutes, or "solved" for each scene, which
                takes half a minute. When omitted they are tabulated where a table comes with the
                package (the reference sensor's), and solved otherwise. Scenes with a footprint are
                always solved.
            nominal: sensor whose mesh and factors `measure_all` takes, where this one differs from
                it in electrode positions along the sides of a rectangle, in thickness, conductivity
                and contacts: many such sensors share them.
            grid: nominal values about which presses and bends are solved; those of this sensor are
                interpolated, so that many similar sensors share solutions. The sensor's own values
                when omitted.

        Raises:
            ConfigurationError: for an unknown resolution or touch model, or a fixture that does not
                fit the sensor.
        """
        self.design = design
        self.fixture: Fixture = fixture or Clamp()
        self.protocol = protocol or Protocol.pairwise(len(design.electrodes))
        self.mechanics = mechanics or Mechanics()
        if touch_model is not None and touch_model not in get_args(TouchModel):
            raise ConfigurationError(
                f"touch_model must be one of {get_args(TouchModel)}, got {touch_model!r}"
            )
        self.touch_model: TouchModel | None = touch_model
        self.grid = grid or OWN_GRID
        breaks = _breaks(design, self.fixture)
        self.sensor_impedances = SensorImpedances(
            design, resolution, breaks, nominal, self.deformed_layers
        )
        self._last: tuple[tuple[Scene, float | None], NDArray[np.inexact]] | None = None
        self._bent: tuple[tuple[Bend, Support], Deformation] | None = None
        self._supported: dict[Support, SensorDesign] = {design.support: design}

    @property
    def model(self) -> ForwardModel:
        """Forward model of scenes without small indenters, which counts its factorisations."""
        return self.sensor_impedances.own.base

    @cached_property
    def full_scale(self) -> float:
        """Largest resistance of the flat, untouched sensor [ohm]."""
        return self.instrument_full_scale(Instrument.ideal())

    def instrument_full_scale(self, instrument: Instrument) -> float:
        """Largest transfer impedance of the flat, untouched sensor on an instrument [ohm]."""
        flat = instrument.transfer_impedance(self.model.flat_impedance, self.protocol)
        return float(np.abs(flat).max())

    def deformation(self, scene: Scene) -> Deformation | None:
        """Deformation by the scene, touches first, then roll, bend and twist; None where flat.

        A sensor that is bent by the plates it rests on is touched in its bent state.
        """
        return self.deformed_layer(scene).deformation

    def _deformation(self, scene: Scene, dented: Deformation | None) -> Deformation | None:
        """Deformation by the scene, whose touches make the dents."""
        parts: list[Deformation] = [] if dented is None else [dented]
        if scene.roll is not None:
            parts.append(scene.roll.deformation(self.design))
        if scene.bend.angle_deg and not isinstance(dented, BentPresses):
            parts.append(self._flexure(scene.bend, self.design_on_support(scene)))
        if scene.twist is not None:
            parts.append(scene.twist.deformation(self.design))
        return reduce(Composition, parts) if parts else None

    def _flexure(self, bend: Bend, design: SensorDesign) -> Deformation:
        """Deformation by the bend; cached, since scenes of one bend follow each other."""
        key = (bend, design.support)
        if self._bent is None or self._bent[0] != key:
            fixed = design, self.fixture, self.mechanics, bend
            bent = solve_bend(*fixed) if self._is_body else bend_table.bend(*fixed, self.grid)
            self._bent = (key, bent)
        return self._bent[1]

    def presses(self, scene: Scene) -> tuple[PressedTouch, ...]:
        """Depth, contact radius and pressure of each touch, with error estimates."""
        self.check_scene(scene)
        if self._is_body:
            return pressed_body_touches(
                scene.touches, self.design_on_support(scene), self.mechanics
            )
        sensor = self._pressed_sensor(scene)
        bent_after = scene.bends if sensor.bend is None else scene.twist is not None
        return pressed_touches(scene.touches, sensor, bent_after, self._is_compared(scene))

    def _is_compared(self, scene: Scene) -> bool:
        """Whether the press of a sensor that is bent then was compared with that of a bent one."""
        low, high = ANGLES_DEG[0], ANGLES_DEG[-1]
        alone = scene.roll is None and scene.twist is None and isinstance(self.fixture, Clamp)
        on_base = isinstance(self.design_on_support(scene).support, Rigid)
        return alone and on_base and low <= scene.bend.angle_deg <= high

    def solves_presses(self, scene: Scene) -> bool:
        """Whether the touches of a scene are solved in 3D, which takes half a minute to minutes."""
        if not scene.touches or self._is_body:
            return False
        return resolve_touch_model(scene.touches, self._pressed_sensor(scene)) == "solved"

    def _pressed_sensor(self, scene: Scene) -> PressedSensor:
        """The sensor on its support in a scene; plates that bend it hold it while it is pressed."""
        pressed = self.design_on_support(scene)
        if isinstance(pressed.outline, Polygon) and (plain := pressed.outline.as_rectangle):
            # Presses are not affected by electrodes, which might cross a corner of the rectangle's
            # rim.
            pair = uniform(plain, 2, width=0.25 * min(plain.length, plain.width))
            pressed = dataclasses.replace(pressed, outline=plain, electrodes=pair)
        angle = 0.0 if scene.roll is not None else scene.bend.angle_deg
        plates = held_by_plates(pressed, self.fixture, self.mechanics, self.grid, angle)
        return PressedSensor(pressed, self.mechanics, self.touch_model, self.grid, plates)

    def check_scene(self, scene: Scene) -> None:
        """Raise ConfigurationError for a scene that the sensor or its support does not allow.

        Refused are touches off the layer, tables of touches where none can be made, and bends that
        the support or the clamp does not allow.
        Forces and angles that are too large are refused later, in the solution.
        """
        outline = self.design.outline
        if isinstance(outline, Surface):
            self.design_on_support(scene)
            require_pressable(outline, scene.touches)
            return
        places = np.array([(touch.x, touch.y) for touch in scene.touches]).reshape(-1, 2)
        for touch, inside in zip(scene.touches, outline.contains(places), strict=True):
            if not inside:
                raise ConfigurationError(
                    f"a touch must lie on the {type(outline).__name__.lower()} of "
                    f"{outline.length:g} x {outline.width:g} m, got ({touch.x:g}, {touch.y:g}) m; "
                    "are the units metres?"
                )
        supported = self.design_on_support(scene)
        require_model(scene.touches, self._pressed_sensor(scene))
        if scene.bends:
            require_bendable(supported.support, self.fixture)
        if scene.bend.angle_deg and isinstance(self.fixture, Clamp):
            bend_table.check_clamp(supported, self.fixture, self.mechanics)
        require_fit(supported.support, outline)

    def design_on_support(self, scene: Scene) -> SensorDesign:
        """The design, on the scene's support where the scene has one.

        Raises ConfigurationError where the sensor cannot rest on that support.
        """
        support = self.design.support if scene.support is None else scene.support
        if support not in self._supported:
            self._supported[support] = dataclasses.replace(self.design, support=support)
        return self._supported[support]

    def simulate_deformation(self, deformation: Deformation) -> Frame:
        """Noise-free frame of the sensor under any deformation, such as `Displaced`."""
        layer = DeformedLayer(self.design, deformation, self.mechanics.piezoresistivity)
        impedance = self.model.impedance(layer.conductivity, layer.area_ratio)
        return Frame(self._noise_free_values(impedance), self.protocol)

    def measure(
        self,
        scene: Scene,
        instrument: Instrument | None = None,
        rng: np.random.Generator | None = None,
        frequency: float = FREQUENCY,
    ) -> Frame:
        """Frame of `scene`, noise-free unless an `instrument` is given.

        The solution of the last scene is cached: measured again, the scene costs only new noise.

        Args:
            scene: bend, touches and the like at one moment.
            instrument: adds the errors and the noise of a board, in a session of its own.
            rng: random generator for the instrument.
            frequency: frequency of the excitation [Hz], for conductivities that depend on it.

        Raises:
            ConfigurationError: for a touch off the layer, an angle that cannot be reached, or an
                instrument without a random generator.
        """
        matrix = self.impedance_matrix(scene, frequency)
        if instrument is not None:
            if rng is None:
                raise ConfigurationError(
                    "an instrument needs rng=numpy.random.default_rng(seed) for its noise"
                )
            start, noise = rng.spawn(2)
            session = instrument.session(
                self.protocol, self.instrument_full_scale(instrument), start, frequency
            )
            impedances = instrument.terminal_impedances(matrix, self.protocol)
            (impedance,), (status,) = session.measure(impedances[None], np.zeros(1), noise)
            return Frame(impedance, self.protocol, frequency=frequency, status=status)
        return Frame(self._noise_free_values(matrix), self.protocol, frequency=frequency)

    def spectrum(self, scene: Scene, frequencies: Sequence[float]) -> NDArray[np.complex128]:
        """Noise-free measurements [ohm] of a scene at several frequencies [Hz].

        Shape (frequencies, measurements). Raises ConfigurationError as `measure` does, and for a
        frequency beyond a table of conductivities.
        """
        matrices = [self.impedance_matrix(scene, each) for each in frequencies]
        return self._noise_free_values(np.array(matrices))

    def impedance_matrix(self, scene: Scene, frequency: float = FREQUENCY) -> NDArray[np.inexact]:
        """Impedance matrix of the sensor in a scene [ohm], (electrodes, electrodes).

        The solution of the last scene is cached. Arguments and errors as of `measure`.
        """
        key = scene, None if self.design.resolve_frequency(frequency) is self.design else frequency
        if self._last is None or self._last[0] != key:
            solved = self.sensor_impedances.solve_scenes([scene], frequency=key[1])
            self._last = (key, solved[scene])
        return self._last[1].copy()  # the caller may change it

    def measure_all(
        self,
        scenes: Sequence[Scene],
        tolerance: float = TOLERANCE,
        instrument: Instrument | None = None,
    ) -> NDArray[np.complex128]:
        """Noise-free measurements [ohm] of many scenes, (scenes, measurements).

        With an instrument these are its `terminal_impedances`, (scenes, 2, measurements).

        All scenes share the factors of the flat sensor, by reanalysis. A scene's measurements do
        not depend on the other scenes.

        Args:
            scenes: scenes in any order; equal scenes are solved once.
            tolerance: error of a scene's change from the flat sensor, relative; for touches of
                what they change. 0 for each scene solved on its own, as by `measure`.
            instrument: whose circuit the sensor is part of; an ideal meter when omitted.
        """
        return measure_together([(self, scenes, instrument)], tolerance)[0]

    def impedances(
        self, scenes: Sequence[Scene], tolerance: float = TOLERANCE
    ) -> NDArray[np.inexact]:
        """Electrode impedance matrices [ohm] of many scenes, (scenes, electrodes, electrodes).

        Arguments as for `measure_all`.
        """
        return impedances_together([(self, scenes)], tolerance)[0]

    def contact_sensitivities(
        self, scenes: Sequence[Scene], tolerance: float = TOLERANCE
    ) -> NDArray[np.float64]:
        """Derivatives of `impedances` by the contact impedances [1/m2], by the adjoint method.

        Shape (scenes, electrodes, electrodes, contacts). Raises ConfigurationError for complex
        contact impedances and conductivities.
        """
        with kernels():
            sensitivities = self.sensor_impedances.contact_sensitivities(
                dict.fromkeys(scenes), tolerance
            )
        return np.array([sensitivities[scene] for scene in scenes])

    @property
    def _is_body(self) -> bool:
        """Whether the sensor is a body from a surface file, deformed on tetrahedra of its own."""
        return isinstance(self.design.outline, Surface)

    def _dents(
        self, scenes: Sequence[Scene]
    ) -> Iterator[Dents | BentPresses | TetrahedralField | None]:
        """Deformations by touches; None without any, and where the dents of a body have faded."""
        pressed: dict[object, list[tuple[tuple[Touch, ...], PressedSensor]]] = {}
        keys: list[object] = []
        for scene in scenes:
            if scene.touches and not self._is_body:
                sensor = self._pressed_sensor(scene)
                # Sensors that differ in the angle of their plates alone are summed together.
                keys.append((sensor._replace(plates=None), sensor.is_bent))
                pressed.setdefault(keys[-1], []).append((scene.touches, sensor))
        dented = {
            key: iter(dents([touches for touches, _ in some], [sensor for _, sensor in some]))
            for key, some in pressed.items()
        }
        next_key = iter(keys)
        for scene in scenes:
            if not scene.touches:
                yield None
            elif self._is_body:
                body = solve_presses(scene.touches, self.design, self.mechanics)
                yield None if body is None else body.field
            else:
                yield next(dented[next(next_key)])

    def conductivity(self, scene: Scene) -> Field | None:
        """Pulled-back conductivity of `deformed_layer`, (..., 3, 3) [S/m]; None where flat."""
        layer = self.deformed_layer(scene)
        return None if layer.deformation is None else layer.conductivity

    def area_ratio(self, scene: Scene) -> AreaRatio | None:
        """Deformed over flat area [1], as of `deformed_layer`; None where the sensor stays flat."""
        layer = self.deformed_layer(scene)
        return None if layer.deformation is None else layer.area_ratio

    def deformed_layer(self, scene: Scene) -> DeformedLayer:
        """Deformed layer: pulled-back conductivity and electrode area ratio of the scene."""
        (layer,) = self.deformed_layers([scene])
        return layer

    def deformed_layers(self, scenes: Sequence[Scene]) -> list[DeformedLayer]:
        """Deformed layers of scenes, whose touches are summed together; none depends on another.

        Raises ConfigurationError as `check_scene` and for forces and angles that are too large.
        """
        for scene in scenes:
            self.check_scene(scene)
        law, layers = self.mechanics.piezoresistivity, []
        for scene, dented in zip(scenes, self._dents(scenes), strict=True):
            stress = dented.mean_stress if dented is not None and law.pressure else None
            deformation = self._deformation(scene, dented)
            layers.append(DeformedLayer(self.design, deformation, law, stress))
        return layers

    def _noise_free_values(self, impedance: NDArray[np.inexact]) -> NDArray[np.complex128]:
        """Noise-free measurements of impedance matrices [ohm], (..., measurements)."""
        return np.asarray(self.protocol.measure(impedance), dtype=np.complex128)


def impedances_together(
    asked: Sequence[tuple[Simulator, Sequence[Scene]]], tolerance: Tolerance = TOLERANCE
) -> list[NDArray[np.inexact]]:
    """`Simulator.impedances` of several sensors, faster where they share a nominal one."""
    ordered: list[tuple[SensorImpedances, list[Scene]]] = []
    for simulator, scenes in asked:
        by_bend: dict[Scene, list[Scene]] = {}
        for scene in dict.fromkeys(scenes):  # those of one bend follow each other
            by_bend.setdefault(without_touches(scene), []).append(scene)
        ordered.append(
            (simulator.sensor_impedances, [s for some in by_bend.values() for s in some])
        )
    with kernels():
        solved = solve_together(ordered, tolerance)
    return [
        np.array([impedances[scene] for scene in scenes])
        for (_, scenes), impedances in zip(asked, solved, strict=True)
    ]


def measure_together(
    asked: Sequence[tuple[Simulator, Sequence[Scene], Instrument | None]],
    tolerance: float = TOLERANCE,
) -> list[NDArray[np.complex128]]:
    """`Simulator.measure_all` of several sensors, faster where they share a nominal one."""
    solved = impedances_together([(own, scenes) for own, scenes, _ in asked], tolerance)
    return [
        np.asarray(own.protocol.measure(Z), dtype=np.complex128)
        if instrument is None
        else instrument.terminal_impedances(Z, own.protocol)
        for (own, _, instrument), Z in zip(asked, solved, strict=True)
    ]


def _breaks(design: SensorDesign, fixture: Fixture) -> tuple[float, ...]:
    """Positions along x where F jumps, and where the mesh must have faces [m]."""
    if isinstance(fixture, Clamp) or fixture.transition:
        return ()
    middle, half = design.outline.length / 2, fixture.bent_length / 2
    return (middle - half, middle + half)
