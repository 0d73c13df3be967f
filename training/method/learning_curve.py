"""Learning curve of a network: training and validation loss per epoch."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NAMES = ("training", "validation")


@dataclass(frozen=True, slots=True)
class LearningCurve:
    """Mean loss per frame, one value per epoch.

    Attributes:
        training: mean over the epoch's batches, while the weights change, with the noise and batch
            statistics of training.
        validation: after the epoch, in evaluation mode, on frames that no weight is fitted to;
            empty without such frames.
    """

    training: tuple[float, ...] = ()
    validation: tuple[float, ...] = ()

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Arrays from which `from_arrays` restores the curve; their names differ from weights'."""
        return {f"history.{name}": np.array(getattr(self, name), dtype=float) for name in _NAMES}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> "LearningCurve":
        """Restore the curve that `arrays` came from; empty where there is none."""
        kept = (arrays.get(f"history.{name}", np.zeros(0)) for name in _NAMES)
        return cls(*(tuple(np.asarray(values, dtype=float).tolist()) for values in kept))
