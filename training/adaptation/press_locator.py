"""Places of touches on one sensor, from maps of its channels."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError
from eitskin.training.adaptation.map_grid import MapGrid, Places, mixture_places
from eitskin.training.adaptation.position_regressor import log_ratio

Array = NDArray[np.float64]

MOST_LEFT_OUT = 4  # a channel in so many
SUSPECTS = 3  # channels that are tried without
OWN = ("gain", "channel_scale", "centre", "error_factor", "misfit_limit")  # arrays of no grid


@dataclass(frozen=True, slots=True, eq=False)
class PressLocator:
    """Gaussian-process maps of all channels, inverted for the place of a touch.

    Attributes:
        grid: the maps.
        others: further models of the maps, in the same units; places are means over all.
        gain: of the channels (C,); log |V / ref| is divided by it.
        channel_scale: root mean square of the log ratios (C,).
        centre: mean of the training places (2,) [m].
        error_factor: factor of the standard errors, from presses that were left out.
        misfit_limit: misfit of a channel beyond which a frame is located without it.
    """

    grid: MapGrid
    gain: Array
    channel_scale: Array
    centre: Array
    error_factor: float
    misfit_limit: float
    others: tuple[MapGrid, ...] = ()

    def locate(self, ratio: ArrayLike) -> tuple[Places, NDArray[np.bool_]]:
        """Place and strength of one touch in each frame, and the channels left out (n, C).

        Bad channels are left out. Where a channel departs by more than `misfit_limit` from what all
        others say, that of the worst ones is left out without which the rest agrees best, and so
        on, at most one in `MOST_LEFT_OUT`.
        """
        size = np.abs(np.asarray(ratio))
        logs = log_ratio(ratio)
        self.require_channels(logs.shape[-1])
        bad = ~(np.isfinite(size) & (size > 0))
        answers = logs / self.gain
        found = self._located(answers, bad)
        most = bad.sum(axis=1) + logs.shape[1] // MOST_LEFT_OUT
        for _ in range(logs.shape[1] // MOST_LEFT_OUT):
            over = np.abs(found.misfit).max(axis=1) > self.misfit_limit
            again = np.flatnonzero(over & (bad.sum(axis=1) < most))
            if not len(again):
                break
            worst = np.argsort(-np.abs(found.misfit[again]), axis=1)[:, :SUSPECTS]
            smallest = np.full(len(again), np.inf)
            before = bad[again]
            for suspect in worst.T:
                less = before.copy()
                less[np.arange(len(again)), suspect] = True
                other = self._located(answers[again], less)
                size = np.abs(other.misfit).max(axis=1)
                better = size < smallest
                smallest[better] = size[better]
                bad[again[better]] = less[better]
                found = _replaced(found, again[better], other, better)
        return replace(found, deviation=found.deviation * self.error_factor), bad

    def _located(self, answers: Array, bad: NDArray[np.bool_]) -> Places:
        """Places by all models from answers (n, C) without the bad ones (n, C)."""
        return mixture_places([grid.locate(answers, bad) for grid in (self.grid, *self.others)])

    def apply(self, ratio: ArrayLike) -> Array:
        """Positions (n, 2) [m] of one touch in each frame, from |V / ref| (n, C).

        Raises DataError for another number of channels.
        """
        return self.locate(ratio)[0].place

    def strength(self, ratio: ArrayLike) -> Array:
        """Strength (n,) of the changes |V / ref| (n, C), relative to the touches trained with."""
        strength: Array = np.sqrt(np.mean((log_ratio(ratio) / self.channel_scale) ** 2, axis=-1))
        return strength

    def require_channels(self, channels: int) -> None:
        """Refuse another number of channels than the trained one; raises DataError."""
        if channels != len(self.channel_scale):
            raise DataError(
                f"these touch positions were learned from {len(self.channel_scale)} channels, "
                f"got {channels}; train on recordings of this sensor"
            )

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Arrays from which `from_arrays` restores the locator, by name."""
        arrays = {name: np.asarray(getattr(self, name)) for name in OWN}
        named = {"grid": self.grid} | {f"other{i}": grid for i, grid in enumerate(self.others)}
        for name, grid in named.items():
            parts = {f"{name}.{each.name}": getattr(grid, each.name) for each in fields(grid)}
            arrays |= {key: np.asarray(value) for key, value in parts.items()}
        return arrays

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "PressLocator":
        """Restore the locator that `arrays` came from; raises KeyError where one is missing."""
        values: dict[str, Any] = {name: array.astype(float) for name, array in arrays.items()}
        values |= {name: float(value) for name, value in values.items() if value.ndim == 0}

        def grid(name: str) -> MapGrid:
            return MapGrid(**{each.name: values[f"{name}.{each.name}"] for each in fields(MapGrid)})

        others = sum(name.startswith("other") and name.endswith(".step") for name in arrays)
        own = {name: values[name] for name in OWN}
        return cls(grid("grid"), **own, others=tuple(grid(f"other{i}") for i in range(others)))


def _replaced(
    found: Places, rows: NDArray[np.int64], other: Places, which: NDArray[np.bool_]
) -> Places:
    """Places with some rows taken from others."""
    changed = {}
    for each in fields(Places):
        values = getattr(found, each.name).copy()
        values[rows] = getattr(other, each.name)[which]
        changed[each.name] = values
    return Places(**changed)
