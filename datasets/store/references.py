"""References of a dataset's specimens, collected from its parts."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.schema import LIMITS
from eitskin.errors import DataError


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
