"""Values of a dataset: those that its format allows, and references that its parts share."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.schema import FIELDS, LIMITS, UNKNOWN_STATE, State
from eitskin.errors import DataError


def _is_positive(values: NDArray[Any]) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(values) & (values > 0))


_POSSIBLE_CLAMPS: Final[dict[str, tuple[Callable[[NDArray[Any]], NDArray[np.bool_]], str]]] = {
    "clamp_span": (_is_positive, "a positive length in m"),
    "clamp_offset": (np.isfinite, "a length in m"),
    "clamp_faces": (lambda values: np.isin(values, (1, 2)), "1 or 2"),
    "clamp_stiffness": (_is_positive, "a positive ratio of moduli"),
}


def check_values(columns: Mapping[str, NDArray[Any]]) -> None:
    """Raise DataError for values that the format refuses, in those columns that are given."""
    for field in FIELDS:
        values = columns.get(field.name)
        if field.finite and values is not None and not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values))[0][0])
            raise DataError(
                f"{field.name} must be finite, but {field.axes[0]} {row} is not; leave such "
                "frames out"
            )
    if "specimen_number" in columns:
        _check_specimen_numbers(columns["specimen_number"].astype(np.int64))
    if "specimen" in columns and "reference" in columns:
        specimens, most = len(columns["reference"]), columns["specimen"].max(initial=0)
        if most >= specimens:
            raise DataError(f"specimen {most} has no reference; there are {specimens}")
    for name, (possible, wanted) in _POSSIBLE_CLAMPS.items():
        values = columns.get(name, np.zeros(0))
        wrong = values[~(np.isnan(values) | possible(values))]
        if len(wrong):
            raise DataError(f"{name} must be {wanted}, or NaN where unknown, got {wrong[0]:g}")
    if "state" in columns:
        _check_states(columns["state"])
    if "touch_x" in columns and "touch_y" in columns:
        found = (np.isfinite(columns[name]) for name in ("touch_x", "touch_y"))
        if not np.array_equal(*found):
            raise DataError("a touch needs both touch_x and touch_y; one of them is NaN")


def _check_specimen_numbers(numbers: NDArray[np.int64]) -> None:
    if (np.diff(numbers) <= 0).any() or numbers[-1] >= LIMITS["specimen"]:
        raise DataError(
            f"specimen_number must rise and stay below {LIMITS['specimen']}, got "
            f"{np.array2string(numbers, threshold=8)}"
        )


def _check_states(states: NDArray[np.uint8]) -> None:
    found = np.flatnonzero(np.bincount(states, minlength=UNKNOWN_STATE + 1))
    wrong = set(found.tolist()) - {*State, UNKNOWN_STATE}
    if wrong:
        known = ", ".join(f"{state.value} {state.name.lower()}" for state in State)
        raise DataError(f"states must be {known} or {UNKNOWN_STATE} unknown, got {sorted(wrong)}")


class SpecimenReferences:
    """References of specimens by number, each kept once; parts must agree on those they share."""

    def __init__(self) -> None:
        """Begin without specimens."""
        self._row = np.full(LIMITS["specimen"], -1, dtype=np.int64)  # of each number
        self._count = 0
        self._rows: NDArray[Any] = np.zeros((0, 0))

    def __len__(self) -> int:
        """Number of specimens."""
        return self._count

    def add(self, numbers: NDArray[np.uint32], reference: NDArray[Any]) -> None:
        """Add the specimens of one part.

        Args:
            numbers: of the specimens within the dataset, rising, (S,).
            reference: a row for each specimen, (S, C).

        Raises DataError where a specimen has another reference than in the parts before.
        """
        rows = self._row[numbers]
        known = rows >= 0
        if known.any():
            other = (self._rows[rows[known]] != reference[known]).any(axis=1)
            if other.any():
                raise DataError(
                    "the parts of a dataset must share the reference of a specimen, but that of "
                    f"specimen {numbers[known][other][0]} differs; these were not made together"
                )
        self._append(numbers[~known], reference[~known])

    def collected(self) -> tuple[NDArray[np.uint32], NDArray[Any]]:
        """Numbers of all specimens, rising, (S,), and their references (S, C)."""
        numbers = np.flatnonzero(self._row >= 0).astype(np.uint32)
        return numbers, self._rows[self._row[numbers]]

    def _append(self, numbers: NDArray[np.uint32], reference: NDArray[Any]) -> None:
        start, end = self._count, self._count + len(numbers)
        if end > len(self._rows):
            grown = np.empty((2 * end, *reference.shape[1:]), reference.dtype)
            if start:
                grown[:start] = self._rows[:start]
            self._rows = grown
        self._rows[start:end] = reference
        self._row[numbers] = np.arange(start, end)
        self._count = end
