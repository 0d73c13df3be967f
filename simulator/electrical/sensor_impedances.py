"""Impedances of one sensor's scenes, on meshes that suit the indenters, its own or shared ones."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property, lru_cache
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.electrode_shift import electrode_shift
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.electrical.batch import (
    EXACT,
    Base,
    BatchSolver,
    LayerFields,
    Tolerance,
)
from eitskin.simulator.electrical.cem_system import zero_sums
from eitskin.simulator.electrical.deformed_layer import DeformedLayer
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.resolution import (
    Discretisation,
    Resolution,
    discretisation,
    press_length,
    suited_cells,
)
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity
from eitskin.simulator.scene.indenters import Indenter
from eitskin.simulator.scene.scene import Scene, Touch

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]

_AT_ONCE = 16  # scenes whose layers are made together
_BASE: Tolerance = 1e-5  # of the change from the nominal sensor to one that others begin with


class ModelFamily:
    """Forward models of one design and resolution, meshed when first asked for, and kept.

    Attributes:
        base: forward model that suits the default indenter and wider ones.
    """

    def __init__(
        self,
        design: SensorDesign,
        resolution: Resolution | Discretisation,
        breaks: Sequence[float] = (),
    ) -> None:
        """Mesh the base model; arguments as of `ForwardModel`."""
        self._design, self._resolution, self._breaks = design, resolution, breaks
        self._cells = suited_cells(resolution, design, breaks)
        coarsest = discretisation(resolution, design, self._cells)
        self.base = ForwardModel(design, coarsest, breaks, self._cells)
        self._models = {coarsest: self.base}
        self._suited: dict[frozenset[Indenter], ForwardModel] = {}
        self._solvers: dict[ForwardModel, BatchSolver] = {}

    def model_for_touches(self, touches: Iterable[Touch]) -> ForwardModel:
        """Forward model whose cells suit the smallest indenter of some touches.

        Indenters of about the same size share a model. A resolution given as order and grading is
        kept for all indenters.

        Raises ConfigurationError for a model that needs too much memory.
        """
        asked = frozenset(touch.indenter for touch in touches)
        if asked not in self._suited:
            smallest = min(asked, key=lambda i: press_length(self._design, i), default=None)
            wanted = discretisation(self._resolution, self._design, self._cells, smallest)
            if wanted not in self._models:
                self._models[wanted] = ForwardModel(self._design, wanted, self._breaks, self._cells)
            self._suited[asked] = self._models[wanted]
        return self._suited[asked]

    def solver(self, model: ForwardModel) -> BatchSolver:
        """Solver with the factors of the flat sensor, for one of the models."""
        if model not in self._solvers:
            flat = DeformedLayer(self._design, None, Piezoresistivity())
            self._solvers[model] = BatchSolver(model, flat)
        return self._solvers[model]


_families: WeakValueDictionary[Any, ModelFamily] = WeakValueDictionary()


def model_family(
    design: SensorDesign, resolution: Resolution | Discretisation, breaks: tuple[float, ...] = ()
) -> ModelFamily:
    """Forward models of a design, which all simulators of it share while one of them lives.

    Bodies from files have their own: a file may change. Arguments as of `ForwardModel`.
    """
    if not isinstance(design.outline, PlaneOutline):
        return ModelFamily(design, resolution, breaks)
    asked = design, resolution, breaks
    family = _families.get(asked)
    if family is None:
        family = _families[asked] = ModelFamily(design, resolution, breaks)
    return family


@lru_cache(maxsize=4)
def nominal_family(design: SensorDesign, resolution: Resolution | Discretisation) -> ModelFamily:
    """Forward models of a nominal sensor, kept for those that differ from it a little."""
    return model_family(design, resolution)


class SensorImpedances:
    """Impedances of the scenes of one sensor, exactly or by the factors of the flat one.

    Sensors that differ from a nominal one in electrode positions, thickness, conductivity and
    contacts share its meshes and factors: nothing is meshed or factorised for them.

    Attributes:
        shared: forward models on the meshes of the nominal sensor, if they suit.
    """

    def __init__(
        self,
        design: SensorDesign,
        resolution: Resolution | Discretisation,
        breaks: tuple[float, ...],
        nominal: SensorDesign | None,
        layers_of: Callable[[Sequence[Scene]], Sequence[DeformedLayer]],
    ) -> None:
        """Choose the meshes; those of the nominal sensor are taken where they suit.

        Args:
            design: the sensor.
            resolution, breaks: mesh as of `ForwardModel`.
            nominal: sensor whose meshes to take, if they suit.
            layers_of: deformed layers of scenes.
        """
        self._design, self._resolution, self._breaks = design, resolution, breaks
        self._layers_of = layers_of
        shares = nominal and not (breaks or nominal.is_complex or design.is_complex)
        self._shift = electrode_shift(nominal, design) if nominal and shares else None
        self.shared = (
            self.own
            if nominal is None or self._shift is None
            else nominal_family(nominal, resolution)
        )
        self._last: dict[tuple[ForwardModel, Tolerance, float | None], tuple[Scene, Numbers]] = {}
        self._bases: dict[ForwardModel, Base | None] = {}

    @cached_property
    def own(self) -> ModelFamily:
        """Forward models on meshes of the sensor itself."""
        return model_family(self._design, self._resolution, self._breaks)

    def solve_scenes(
        self,
        scenes: Iterable[Scene],
        tolerance: Tolerance = EXACT,
        frequency: float | None = None,
    ) -> dict[Scene, Numbers]:
        """Impedance [ohm] of each scene on the base mesh, at a frequency [Hz] if solved exactly.

        The change that touches of small indenters make on a finer mesh is added to the impedance
        without touches on the base mesh, so that errors of the two meshes do not enter it.
        """
        return solve_together([(self, scenes)], tolerance, frequency)[0]

    def contact_sensitivities(
        self, scenes: Iterable[Scene], tolerance: Tolerance
    ) -> dict[Scene, Array]:
        """Derivatives of the impedance [ohm] by each contact impedance [1/m2], the contact last.

        Shapes (electrodes, electrodes, electrodes), on the meshes that suit the scenes' indenters,
        by the adjoint method. Raises ConfigurationError for complex ones and conductivities.
        """
        suited: dict[ForwardModel, list[Scene]] = {}
        for scene in scenes:
            suited.setdefault(self.shared.model_for_touches(scene.touches), []).append(scene)
        sensitivities: dict[Scene, Array] = {}
        z = self._design.contact_impedance
        for model, some in suited.items():
            base, assembly = self.base(model), model.assembly
            if base is None:
                raise ConfigurationError(
                    "derivatives by contact impedances need real ones, and a sensor near its "
                    f"nominal one; got {z}"
                )
            solver = self.shared.solver(model)
            layers = self.layers(some)
            fields = ((LayerFields.from_layer(layer, assembly), base) for layer in layers)
            solutions = solver.solve(fields, tolerance, potentials=True)
            for scene, layer, solution in zip(some, layers, solutions, strict=True):
                if solution is None:
                    gram = model.contact_gram(layer.conductivity, layer.area_ratio, z)
                else:
                    U = np.linalg.solve(solution.admittance, zero_sums(np.eye(len(z))))
                    w = solution.potentials[solver.rank]
                    ratio = layer.area_ratio(assembly.facet_points, assembly.facet_normals)
                    drops = model.contact_drops(w @ U, U, solver.lift)
                    gram = assembly.contact_gram(drops, z, ratio)
                sensitivities[scene] = np.real(gram)
        return sensitivities

    def solve_alone(
        self,
        model: ForwardModel,
        scene: Scene,
        tolerance: Tolerance,
        frequency: float | None = None,
    ) -> Numbers:
        """Impedance [ohm] of a scene solved on its own; the last untouched one is cached."""
        last = self._last.get((model, tolerance, frequency))
        if last is not None and last[0] == scene:
            return last[1]
        with model.solver.threads():
            (layer,) = self._layers_of([scene]) if tolerance == EXACT else self.layers([scene])
            if layer.is_flat:
                same = frequency is None
                return model.flat_impedance if same else model.impedance(frequency=frequency)
            if frequency is not None:
                layer = dataclasses.replace(layer, design=layer.design.resolve_frequency(frequency))
            z = None if layer.shift is None else layer.contact_impedance
            Z = model.impedance(layer.conductivity, layer.area_ratio, z)
        if not scene.touches:
            self._last[model, tolerance, frequency] = scene, Z
        return Z

    def layers(self, scenes: Sequence[Scene]) -> list[DeformedLayer]:
        """Deformed layers on the points of the shared meshes."""
        layers = self._layers_of(scenes)
        return [dataclasses.replace(layer, shift=self._shift) for layer in layers]

    def base(self, model: ForwardModel) -> Base | None:
        """The flat sensor as solved on a shared mesh.

        None for complex conductivities or contact impedances, and where the nominal sensor differs
        too much.
        """
        if model not in self._bases:
            coarse_model = None
            if not model.design.is_complex:
                solver = self.shared.solver(model)
                coarse_model = solver.base
                if self._shift is not None:
                    flat = DeformedLayer(self._design, None, Piezoresistivity(), shift=self._shift)
                    fields = LayerFields.from_layer(flat, model.assembly)
                    (own,) = solver.solve([(fields, coarse_model)], _BASE, True, width=1)
                    coarse_model = None if own is None else Base(own.impedance, own.potentials)
            self._bases[model] = coarse_model
        return self._bases[model]


def solve_together(
    asked: Iterable[tuple[SensorImpedances, Iterable[Scene]]],
    tolerance: Tolerance,
    frequency: float | None = None,
) -> list[dict[Scene, Numbers]]:
    """Impedances [ohm] of scenes of several sensors, as by `SensorImpedances.solve_scenes`.

    Those of sensors that share meshes are corrected side by side. None depends on another.
    """
    sensors = [
        (sensor, sensor.own if tolerance == EXACT else sensor.shared, tuple(scenes))
        for sensor, scenes in asked
    ]
    wanted: dict[ForwardModel, dict[tuple[SensorImpedances, Scene], None]] = {}
    for sensor, family, scenes in sensors:
        for scene in scenes:
            model = family.model_for_touches(scene.touches)
            wanted.setdefault(model, {})[sensor, scene] = None
            if model is not family.base:
                for each in (model, family.base):
                    wanted.setdefault(each, {})[sensor, without_touches(scene)] = None
    solved = {
        model: _solve_on_mesh(model, list(some), tolerance, frequency)
        for model, some in wanted.items()
    }
    impedances: list[dict[Scene, Numbers]] = []
    for sensor, family, scenes in sensors:
        impedances.append({})
        for scene in scenes:
            model, bare = family.model_for_touches(scene.touches), (sensor, without_touches(scene))
            impedances[-1][scene] = solved[model][sensor, scene]
            if model is not family.base:
                change = impedances[-1][scene] - solved[model][bare]
                impedances[-1][scene] = solved[family.base][bare] + change
    return impedances


def _solve_on_mesh(
    model: ForwardModel,
    asked: Sequence[tuple[SensorImpedances, Scene]],
    tolerance: Tolerance,
    frequency: float | None,
) -> dict[tuple[SensorImpedances, Scene], Numbers]:
    """Impedances [ohm] of scenes on one of the meshes, those of each sensor together."""
    impedances: dict[tuple[SensorImpedances, Scene], Numbers] = {}
    deformed: list[tuple[SensorImpedances, Scene]] = []
    by_sensor: dict[SensorImpedances, list[Scene]] = {}
    for sensor, scene in asked:
        by_sensor.setdefault(sensor, []).append(scene)
    bases = {each: None if tolerance == EXACT else each.base(model) for each in by_sensor}

    def fields() -> Iterator[tuple[LayerFields, Base]]:
        for sensor, scenes in by_sensor.items():
            if (base := bases[sensor]) is None:
                continue
            for start in range(0, len(scenes), _AT_ONCE):
                some = scenes[start : start + _AT_ONCE]
                for scene, layer in zip(some, sensor.layers(some), strict=True):
                    if layer.deformation is None:
                        impedances[sensor, scene] = base.impedance
                    else:
                        deformed.append((sensor, scene))
                        yield LayerFields.from_layer(layer, model.assembly), base

    solver = next((s.shared.solver(model) for s, base in bases.items() if base is not None), None)
    if solver is not None:
        solutions = solver.solve(fields(), tolerance)
        for each, solution in zip(deformed, solutions, strict=True):
            if solution is not None:
                impedances[each] = solution.impedance
    for sensor, scene in asked:
        if (sensor, scene) not in impedances:
            impedances[sensor, scene] = sensor.solve_alone(model, scene, tolerance, frequency)
    return impedances


def without_touches(scene: Scene) -> Scene:
    """Scene without touches, held or released."""
    return dataclasses.replace(scene, touches=())
