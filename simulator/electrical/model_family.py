"""Forward models of one design whose cells suit the indenters that press the sensor."""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.outline import PlaneOutline
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.electrical.reanalysis import Reanalysis
from eitskin.simulator.electrical.resolution import (
    Discretisation,
    Resolution,
    discretisation,
    press_length,
    suited_cells,
)
from eitskin.simulator.layer.deformed_layer import DeformedLayer
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity
from eitskin.simulator.scene.indenters import Indenter

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
        self._reanalyses: dict[ForwardModel, Reanalysis] = {}
        self._flat: dict[ForwardModel, Numbers] = {}

    def suited(self, indenters: Iterable[Indenter]) -> ForwardModel:
        """Forward model whose cells suit the smallest of the indenters.

        Indenters of about the same size share a model. A resolution given as order and grading is
        kept for all indenters.

        Raises ConfigurationError for a model that needs too much memory.
        """
        smallest = min(indenters, key=lambda i: press_length(self._design, i), default=None)
        wanted = discretisation(self._resolution, self._design, self._cells, smallest)
        if wanted not in self._models:
            self._models[wanted] = ForwardModel(self._design, wanted, self._breaks, self._cells)
        return self._models[wanted]

    def flat_impedance(self, model: ForwardModel) -> Numbers:
        """Impedance matrix of the flat sensor [ohm] on one of the models, solved once.

        Shape (electrodes, electrodes).
        """
        if model not in self._flat:
            self._flat[model] = model.impedance()
        return self._flat[model]

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
