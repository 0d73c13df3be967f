"""Summary of a dataset: what its frames hold, collected shard by shard."""

import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import MAX_TOUCHES, UNKNOWN_STATE, SpecimenReferences, State

Values = NDArray[Any]


# Columns whose range is reported, each with the factor that makes a unit of daily use.
MAX_NAMES = 8  # specimens that are named
_RANGES = {
    "time_s": ("time", 1.0),
    "bend_angle_deg": ("bend_angle_deg", 1.0),
    "touch_x_mm": ("touch_x", 1e3),
    "touch_y_mm": ("touch_y", 1e3),
    "force_n": ("touch_force", 1.0),
    "depth_mm": ("touch_depth", 1e3),
    "radius_mm": ("touch_radius", 1e3),
    "clamp_span_mm": ("clamp_span", 1e3),
    "clamp_offset_mm": ("clamp_offset", 1e3),
    "clamp_stiffness": ("clamp_stiffness", 1.0),
    "impedance_ohm": ("impedance", 1.0),
    "voltage_v": ("impedance", 1.0),
}


class DatasetSummary:
    """Contents of a dataset, from its parts one at a time."""

    def __init__(self) -> None:
        """Begin without frames."""
        self._first: Dataset | None = None
        self._frames = self._flagged = 0
        self._states = np.zeros(UNKNOWN_STATE + 1, dtype=np.int64)
        self._touches = np.zeros(MAX_TOUCHES + 1, dtype=np.int64)
        self._ranges = dict.fromkeys(_RANGES, (math.inf, -math.inf))
        self._episodes: list[Values] = []
        self._references = SpecimenReferences()

    def add(self, data: Dataset) -> None:
        """Add the frames of one part; raises DataError where its references contradict others."""
        self._first = self._first or data.select([])
        self._frames += len(data)
        self._flagged += int(np.count_nonzero(data.status))
        self._states += np.bincount(data.state, minlength=len(self._states))
        self._touches += np.bincount(data.touch_count, minlength=len(self._touches))
        self._episodes.append(np.unique(data.episode))
        self._references.add(data.specimen_number, data.reference)
        other = "impedance_ohm" if data.quantity == "voltage" else "voltage_v"
        for name, (column, factor) in _RANGES.items():
            values = getattr(data, column)
            values = np.abs(values) if column == "impedance" else factor * values
            finite = values[np.isfinite(values)]
            if finite.size and name != other:
                least, most = self._ranges[name]
                self._ranges[name] = min(least, float(finite.min())), max(most, float(finite.max()))

    def add_parts(self, parts: Iterable[Dataset]) -> Iterator[Dataset]:
        """Yield the parts of a dataset and add each."""
        for part in parts:
            self.add(part)
            yield part

    @property
    def states(self) -> dict[str, int]:
        """Number of frames in each state, and of frames whose state is unknown."""
        counts = {state.name.lower(): int(self._states[state]) for state in State}
        return counts | {"unknown": int(self._states[UNKNOWN_STATE])}

    def contents(self) -> dict[str, Any]:
        """Contents as plain data; None for what is unknown. At least one part has been added."""
        first = self._first
        if first is None:
            raise ValueError("a summary needs at least one part, got none")
        return {
            "frames": self._frames,
            "channels": first.impedance.shape[1],
            "electrodes": first.protocol.n_electrodes if first.protocol else None,
            "protocol": str(first.protocol) if first.protocol else None,
            "frequency_hz": first.frequency,
            "source": first.source,
            "quantity": first.quantity or None,
            "seed": first.seed if first.recipe else None,
            "specimens": len(self._references),
            "episodes": len(np.unique(np.concatenate(self._episodes))),
            "states": {name: count for name, count in self.states.items() if count},
            "touches_per_frame": {
                str(number): int(count) for number, count in enumerate(self._touches) if count
            },
            **{
                name: {"from": float(f"{low:.4g}"), "to": float(f"{high:.4g}")}
                if low <= high
                else None
                for name, (low, high) in self._ranges.items()
            },
            "flagged_values": self._flagged,
        }

    @property
    def ranges(self) -> str:
        """Least and greatest values that are known and differ, in words."""
        ends = ((name, *ends) for name, ends in self._ranges.items())
        return ", ".join(f"{n} {low:.4g} to {high:.4g}" for n, low, high in ends if low < high)


def specimens_in_words(data: Dataset) -> str:
    """Number of the specimens of a dataset's frames, and the names of the first few named ones."""
    names = data.specimen_names
    counted = f"{len(names)} specimen{'s' * (len(names) != 1)}"
    if not data.names.specimens:
        return counted
    remainder = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return f"{counted} ({', '.join(names[:MAX_NAMES])}{remainder})"
