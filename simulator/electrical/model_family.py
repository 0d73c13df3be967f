"""Forward models of one design whose cells suit the indenters that press the sensor."""

from collections.abc import Iterable, Sequence
from functools import lru_cache

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

    def reanalysis(self, model: ForwardModel) -> Reanalysis:
        """Reanalysis with the factors of the flat sensor, for one of the models."""
        if model not in self._reanalyses:
            flat = DeformedLayer(self._design, None, Piezoresistivity())
            self._reanalyses[model] = Reanalysis(model, flat)
        return self._reanalyses[model]


@lru_cache(maxsize=4)
def shared_family(design: SensorDesign, resolution: Resolution | Discretisation) -> ModelFamily:
    """Forward models that several sensors share, with their factors."""
    return ModelFamily(design, resolution)
