"""Impedances of one sensor's scenes, on meshes of its own or of a nominal sensor."""

import dataclasses
from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.electrode_shift import ElectrodeShift, electrode_shift
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.model_family import (
    ModelFamily,
    model_family,
    nominal_family,
)
from eitskin.simulator.electrical.reanalysis import Reanalysis, is_possible
from eitskin.simulator.electrical.resolution import Discretisation, Resolution
from eitskin.simulator.layer.deformed_layer import DeformedLayer
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity
from eitskin.simulator.scene.scene import Scene

Array = NDArray[np.float64]
Numbers = NDArray[np.inexact]


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
        model = self._suited(family, scene)
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
        model = self._suited(self._shared, scene)
        solved = self.reanalysis(model) if is_possible(model) else None
        if solved is None:
            raise ConfigurationError(
                "derivatives by contact impedances need real ones, and a sensor near its nominal "
                f"one; got {self._design.contact_impedance}"
            )
        layer = dataclasses.replace(self._layer_of(scene), shift=self._shift)
        return solved.contact_sensitivity(layer, tolerance)

    def _suited(self, family: ModelFamily, scene: Scene) -> ForwardModel:
        return family.suited(touch.indenter for touch in scene.touches)

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
        solved = self.reanalysis(model) if tolerance and is_possible(model) else None
        if solved is not None:
            flat = layer.deformation is None
            return solved.base if flat else solved.impedance(layer, tolerance)
        if layer.is_flat:
            return self.own.flat_impedance(model)
        return model.impedance(layer.conductivity, layer.area_ratio, layer.contact_impedance)

    def reanalysis(self, model: ForwardModel) -> Reanalysis | None:
        """Reanalysis based on the flat sensor; None where the nominal one differs too much."""
        if model not in self._reanalyses:
            found: Reanalysis | None = self._shared.reanalysis(model)
            if found is not None and self._shift is not None:
                unstrained = Piezoresistivity()
                flat = DeformedLayer(self._design, None, unstrained, shift=self._shift)
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
