"""Columns of a dataset, collected from its parts one at a time."""

import math
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.schema import FRAME_FIELDS, MAX_TOUCHES
from eitskin.errors import DataError

if TYPE_CHECKING:
    from eitskin.datasets.store.dataset import Dataset


class SpecimenReferences:
    """References of specimens by number, each kept once; parts must agree on those they share."""

    def __init__(self) -> None:
        """Begin without specimens."""
        self._rows: dict[int, NDArray[Any]] = {}

    def __len__(self) -> int:
        """Number of specimens."""
        return len(self._rows)

    def add(self, numbers: NDArray[np.uint32], reference: NDArray[Any]) -> None:
        """Add the specimens of one part: rising numbers (S,), and a row of `reference` for each.

        Raises DataError where a specimen has another reference than in the parts before.
        """
        for number, row in zip(numbers.tolist(), reference, strict=True):
            if not np.array_equal(self._rows.setdefault(number, row), row):
                raise DataError(
                    "the parts of a dataset must share the reference of a specimen, but that of "
                    f"specimen {number} differs; these were not made together"
                )

    def to_arrays(self) -> tuple[NDArray[np.uint32], NDArray[Any]]:
        """Numbers of all specimens, rising, (S,), and their references (S, C)."""
        numbers = sorted(self._rows)
        return np.array(numbers, dtype=np.uint32), np.array([self._rows[n] for n in numbers])


class ColumnCollector:
    """Columns of a dataset, filled from its parts one at a time, and references of specimens."""

    def __init__(self, like: "Dataset", frames: int, names: Collection[str]) -> None:
        """Begin with uninitialised columns `names` of as many frames, in the shapes of `like`."""
        self.references = SpecimenReferences()
        self._columns = {
            field.name: np.empty((frames, *getattr(like, field.name).shape[1:]), field.dtype)
            for field in FRAME_FIELDS
            if field.name in names
        }

    def put(self, rows: slice | NDArray[np.int64], part: Mapping[str, NDArray[Any]]) -> None:
        """Fill some rows with the columns of a part; raises DataError for other references."""
        if "reference" in part:
            self.references.add(part["specimen_number"], part["reference"])
        for name, column in self._columns.items():
            values = part[name]
            column[rows] = part["specimen_number"][values] if name == "specimen" else values

    def whole(self) -> dict[str, Any]:
        """All columns by name, (n, ...), with those of the specimens of all parts, (S, ...)."""
        if "specimen" not in self._columns:
            return self._columns
        numbers, reference = self.references.to_arrays()
        rows = np.searchsorted(numbers, self._columns["specimen"]).astype(np.uint32)
        return self._columns | {
            "specimen": rows,
            "specimen_number": numbers,
            "reference": reference,
        }


def frame_bytes(channels: int, names: Collection[str]) -> int:
    """Size in memory of the columns `names` of one frame."""
    sizes = {"channel": channels, "touch": MAX_TOUCHES, "frame": 1}
    return sum(
        field.dtype.itemsize * math.prod(sizes[axis] for axis in field.axes)
        for field in FRAME_FIELDS
        if field.name in names
    )
