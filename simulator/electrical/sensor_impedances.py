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
        self._shared = (
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
        family = self.own if tolerance == EXACT else self._shared
        suited = {scene: family.model_for_touches(scene.touches) for scene in scenes}
        wanted: dict[ForwardModel, dict[Scene, None]] = {}
        for scene, model in suited.items():
            wanted.setdefault(model, {})[scene] = None
            if model is not family.base:
                for each in (model, family.base):
                    wanted.setdefault(each, {})[without_touches(scene)] = None
        solved = {
            model: self._solve_on_mesh(model, list(asked), tolerance, frequency)
            for model, asked in wanted.items()
        }
        found = {}
        for scene, model in suited.items():
            found[scene] = solved[model][scene]
            if model is not family.base:
                bare = without_touches(scene)
                found[scene] = solved[family.base][bare] + (found[scene] - solved[model][bare])
        return found

    def contact_sensitivities(
        self, scenes: Iterable[Scene], tolerance: Tolerance
    ) -> dict[Scene, Array]:
        """Derivatives of the impedance [ohm] by each contact impedance [1/m2], the contact last.

        Shapes (electrodes, electrodes, electrodes), on the meshes that suit the scenes' indenters,
        by the adjoint method. Raises ConfigurationError for complex ones and conductivities.
        """
        suited: dict[ForwardModel, list[Scene]] = {}
        for scene in scenes:
            suited.setdefault(self._shared.model_for_touches(scene.touches), []).append(scene)
        sensitivities: dict[Scene, Array] = {}
        z = self._design.contact_impedance
        for model, some in suited.items():
            base, assembly = self._base(model), model.assembly
            if base is None:
                raise ConfigurationError(
                    "derivatives by contact impedances need real ones, and a sensor near its "
                    f"nominal one; got {z}"
                )
            solver = self._shared.solver(model)
            layers = self._layers(some)
            fields = (LayerFields.from_layer(layer, assembly) for layer in layers)
            solutions = solver.solve(fields, z, base, tolerance, potentials=True)
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

    def _solve_on_mesh(
        self,
        model: ForwardModel,
        scenes: Sequence[Scene],
        tolerance: Tolerance,
        frequency: float | None,
    ) -> dict[Scene, Numbers]:
        """Impedances [ohm] of scenes on one of the meshes."""
        base = None if tolerance == EXACT else self._base(model)
        if base is None:
            return {scene: self._alone(model, scene, tolerance, frequency) for scene in scenes}
        impedances: dict[Scene, Numbers] = {}
        deformed: list[Scene] = []

        def fields() -> Iterator[LayerFields]:
            for start in range(0, len(scenes), _AT_ONCE):
                some = scenes[start : start + _AT_ONCE]
                for scene, layer in zip(some, self._layers(some), strict=True):
                    if layer.deformation is None:
                        impedances[scene] = base.impedance
                    else:
                        deformed.append(scene)
                        yield LayerFields.from_layer(layer, model.assembly)

        z = self._design.contact_impedance
        solutions = self._shared.solver(model).solve(fields(), z, base, tolerance)
        for scene, solution in zip(deformed, solutions, strict=True):
            start = None if solution is None else solution.impedance
            impedances[scene] = self._alone(model, scene, tolerance) if start is None else start
        return impedances

    def _alone(
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
        (layer,) = self._layers_of([scene]) if tolerance == EXACT else self._layers([scene])
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

    def _layers(self, scenes: Sequence[Scene]) -> list[DeformedLayer]:
        """Deformed layers on the points of the shared meshes."""
        layers = self._layers_of(scenes)
        return [dataclasses.replace(layer, shift=self._shift) for layer in layers]

    def _base(self, model: ForwardModel) -> Base | None:
        """The flat sensor as solved on a shared mesh.

        None for complex conductivities or contact impedances, and where the nominal sensor differs
        too much.
        """
        if model not in self._bases:
            coarse_model = None
            if not model.design.is_complex:
                solver = self._shared.solver(model)
                coarse_model = solver.base
                if self._shift is not None:
                    flat = DeformedLayer(self._design, None, Piezoresistivity(), shift=self._shift)
                    z = self._design.contact_impedance
                    fields = LayerFields.from_layer(flat, model.assembly)
                    (own,) = solver.solve([fields], z, coarse_model, _BASE, True, width=1)
                    coarse_model = None if own is None else Base(own.impedance, own.potentials)
            self._bases[model] = coarse_model
        return self._bases[model]


def without_touches(scene: Scene) -> Scene:
    """Scene without touches, held or released."""
    return dataclasses.replace(scene, touches=())
