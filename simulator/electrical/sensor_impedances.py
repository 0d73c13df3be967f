"""Impedances of one sensor's scenes, on meshes that suit the indenters, its own or shared ones."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, lru_cache
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.electrode_shift import ElectrodeShift, electrode_shift
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.deformation.deformed_layer import DeformedLayer
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.reanalysis import Reanalysis, is_possible
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
        self._reanalyses: dict[ForwardModel, Reanalysis] = {}

    def suited(self, touches: Iterable[Touch]) -> ForwardModel:
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

    def reanalysis(self, model: ForwardModel) -> Reanalysis:
        """Reanalysis with the factors of the flat sensor, for one of the models."""
        if model not in self._reanalyses:
            flat = DeformedLayer(self._design, None, Piezoresistivity())
            self._reanalyses[model] = Reanalysis(model, flat)
        return self._reanalyses[model]


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
    found = _families.get(asked)
    if found is None:
        found = _families[asked] = ModelFamily(design, resolution, breaks)
    return found


@lru_cache(maxsize=4)
def nominal_family(design: SensorDesign, resolution: Resolution | Discretisation) -> ModelFamily:
    """Forward models of a nominal sensor, kept for those that differ from it a little."""
    return model_family(design, resolution)


class SensorImpedances:
    """Impedances of the scenes of one sensor, exactly or by reanalysis.

    Sensors that differ from a nominal one in electrode positions, thickness, conductivity and
    contacts share its meshes and factors in reanalysis: nothing is meshed or factorised for them.
    """

    def __init__(
        self,
        design: SensorDesign,
        resolution: Resolution | Discretisation,
        breaks: tuple[float, ...],
        nominal: SensorDesign | None,
        layer_of: Callable[[Scene], DeformedLayer],
    ) -> None:
        """Choose the meshes; those of the nominal sensor are taken where they suit.

        Args:
            design: the sensor.
            resolution, breaks: as of `ForwardModel`.
            nominal: sensor whose meshes to take, if they suit.
            layer_of: deformed layer of a scene.
        """
        self._design, self._resolution, self._breaks = design, resolution, breaks
        self._layer_of = layer_of
        self._shift = None if nominal is None or breaks else _shift(nominal, design)
        self._shared = (
            self.own
            if nominal is None or self._shift is None
            else nominal_family(nominal, resolution)
        )
        self._untouched: dict[tuple[ForwardModel, float], tuple[Scene, Numbers]] = {}
        self._reanalyses: dict[ForwardModel, Reanalysis | None] = {}

    @cached_property
    def own(self) -> ModelFamily:
        """Forward models on meshes of the sensor itself."""
        return model_family(self._design, self._resolution, self._breaks)

    def at(self, scene: Scene, tolerance: float = 0.0) -> Numbers:
        """Impedance [ohm] on the base mesh, by reanalysis where a tolerance allows.

        The change that touches of small indenters make on a finer mesh is added to the impedance
        without touches on the base mesh, so that errors of the two meshes do not enter it.
        """
        family = self._shared if tolerance else self.own
        if not scene.touches:
            return self._without_touches(family.base, scene, tolerance)
        model = family.suited(scene.touches)
        Z = self._solved(model, scene, tolerance)
        if model is family.base:
            return Z
        coarse, fine = (
            self._without_touches(each, untouched(scene), tolerance)
            for each in (family.base, model)
        )
        moved: Numbers = coarse + (Z - fine)
        return moved

    def contact_sensitivity(self, scene: Scene, tolerance: float) -> Array:
        """Derivatives of the impedance [ohm] by each contact impedance [1/m2], the contact last.

        Shape (electrodes, electrodes, electrodes), on the mesh that suits the scene's indenters.
        Raises ConfigurationError for complex contact impedances.
        """
        model = self._shared.suited(scene.touches)
        solved = self.reanalysis(model)
        if solved is None:
            raise ConfigurationError(
                "derivatives by contact impedances need real ones, and a sensor near its nominal "
                f"one; got {self._design.contact_impedance}"
            )
        layer = dataclasses.replace(self._layer_of(scene), shift=self._shift)
        return solved.contact_sensitivity(layer, tolerance)

    def _without_touches(self, model: ForwardModel, scene: Scene, tolerance: float) -> Numbers:
        """Impedance [ohm] of a scene without touches; that of the last one is cached."""
        last = self._untouched.get((model, tolerance))
        if last is None or last[0] != scene:
            last = scene, self._solved(model, scene, tolerance)
            self._untouched[model, tolerance] = last
        return last[1]

    def _solved(self, model: ForwardModel, scene: Scene, tolerance: float) -> Numbers:
        layer = self._layer_of(scene)
        if tolerance:
            layer = dataclasses.replace(layer, shift=self._shift)
            solved = self.reanalysis(model)
            if solved is not None:
                flat = layer.deformation is None
                return solved.base if flat else solved.impedance(layer, tolerance)
        if layer.is_flat:
            return model.flat_impedance
        z = None if layer.shift is None else layer.contact_impedance
        return model.impedance(layer.conductivity, layer.area_ratio, z)

    def reanalysis(self, model: ForwardModel) -> Reanalysis | None:
        """Reanalysis based on the flat sensor.

        None for complex contact impedances, and where the nominal sensor differs too much.
        """
        if model not in self._reanalyses:
            found = self._shared.reanalysis(model) if is_possible(model) else None
            if found is not None and self._shift is not None:
                flat = DeformedLayer(self._design, None, Piezoresistivity(), shift=self._shift)
                found = found.specimen(flat)
            self._reanalyses[model] = found
        return self._reanalyses[model]


def _shift(nominal: SensorDesign, design: SensorDesign) -> ElectrodeShift | None:
    """Map from a nominal sensor whose meshes suit; None where they do not."""
    contacts = nominal.contact_impedance, design.contact_impedance
    if any(np.iscomplexobj(each) for each in contacts):
        return None
    return electrode_shift(nominal, design)


def untouched(scene: Scene) -> Scene:
    """The scene without its touches."""
    return dataclasses.replace(scene, touches=())
