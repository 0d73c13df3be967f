"""How the loss of a network fell while it was trained."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NAMES = ("training", "validation")


@dataclass(frozen=True, slots=True)
class History:
    """Mean loss per frame, one value per epoch.

    Attributes:
        training: over the epoch's batches, as the weights were when each came, with the noise and
            batch statistics of training.
        validation: after the epoch, on frames that no weight is fitted to, as the network is used;
            empty where there were none.
    """

    training: tuple[float, ...] = ()
    validation: tuple[float, ...] = ()

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """What `from_arrays` needs to make it again, named so that it fits beside weights."""
        return {f"history.{name}": np.array(getattr(self, name), dtype=float) for name in _NAMES}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> "History":
        """The history that `arrays` came from; empty where they hold none."""
        kept = (arrays.get(f"history.{name}", np.zeros(0)) for name in _NAMES)
        return cls(*(tuple(np.asarray(values, dtype=float).tolist()) for values in kept))
