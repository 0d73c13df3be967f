"""References and numbers of a recording's specimens, found in a first pass over its frames."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex64]


class ReferenceMeans:
    """Reference of each specimen: the mean of its best readings of the flat, untouched sensor.

    Best are untouched readings that are not known to be bent, then untouched ones, then the first
    frame.
    """

    def __init__(self) -> None:
        """Begin without specimens."""
        self._sums: dict[str, tuple[NDArray[np.complex128], NDArray[np.int64]]] = {}
        self._grade: dict[str, int] = {}

    @property
    def names(self) -> list[str]:
        """Names of the specimens in the order of appearance."""
        return list(self._sums)

    def add(
        self,
        specimens: Sequence[str],
        untouched: Complex,
        known_untouched: NDArray[np.bool_],
        bent: NDArray[np.bool_],
    ) -> None:
        """Add the frames of one block.

        Args:
            specimens: name of each frame's specimen.
            untouched: readings of the untouched sensor, or frames (n, C); NaN where lost.
            known_untouched: whether a reading is known to be untouched (n,).
            bent: whether a frame is known to be bent (n,).
        """
        names = np.array(specimens)
        for name in dict.fromkeys(specimens):
            own = names == name
            for grade, usable in ((2, known_untouched & ~bent), (1, known_untouched), (0, own)):
                chosen = np.flatnonzero(own & usable)
                if len(chosen):
                    self._add(name, grade, untouched[chosen if grade else chosen[:1]])
                    break

    def _add(self, name: str, grade: int, rows: Complex) -> None:
        known = self._grade.get(name, -1)
        if grade < known or (grade == known == 0):
            return
        finite = np.isfinite(rows)
        total = np.where(finite, rows, 0).astype(np.complex128).sum(axis=0)
        count = finite.sum(axis=0)
        if grade == known:
            total, count = total + self._sums[name][0], count + self._sums[name][1]
        self._grade[name] = grade
        self._sums[name] = total, count

    def collected(self, names: Iterable[str]) -> Complex:
        """References (S, C) of the specimens in the order of `names`; 0 where all are lost."""
        means = [self._sums[name][0] / np.maximum(self._sums[name][1], 1) for name in names]
        return np.array(means, dtype=np.complex64)


def numbered(names: Iterable[str], limit: int) -> Mapping[str, int]:
    """Number of each name: the name itself where all are numbers below `limit`, else by order."""
    given = list(dict.fromkeys(names))
    if all(name.isascii() and name.isdigit() and int(name) < limit for name in given) and len(
        {int(name) for name in given}
    ) == len(given):
        return {name: int(name) for name in given}
    return {name: number for number, name in enumerate(given)}
