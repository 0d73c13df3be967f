"""Statistics of many values, collected part by part."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


class RunningStatistics:
    """Least, greatest, mean and standard deviation of the rows of tables, added one at a time.

    Means and squares of parts are joined by the formulas of Chan, Golub and LeVeque (1979), which
    lose no digits where a mean is large beside the deviation.
    """

    def __init__(self) -> None:
        """Begin without values."""
        self._count = 0
        self._mean: NDArray[np.float64] = np.zeros(1)
        self._squares: NDArray[np.float64] = np.zeros(1)
        self._least: NDArray[np.float64] = np.full(1, np.inf)
        self._most: NDArray[np.float64] = np.full(1, -np.inf)

    def add(self, values: ArrayLike) -> None:
        """Add the rows of a table (n, C), at least one."""
        table = np.asarray(values, dtype=np.float64)
        count, mean = len(table), table.mean(axis=0)
        total, step = self._count + count, mean - self._mean
        self._squares = (
            self._squares
            + ((table - mean) ** 2).sum(axis=0)
            + step**2 * self._count * count / total
        )
        self._mean = self._mean + step * count / total
        self._least = np.minimum(self._least, table.min(axis=0))
        self._most = np.maximum(self._most, table.max(axis=0))
        self._count = total

    def document(self) -> dict[str, Any]:
        """Statistics as plain data: lists of a number for each column; the deviation of all."""
        deviation = np.sqrt(self._squares / max(self._count, 1))
        return {
            "min": self._least.tolist(),
            "max": self._most.tolist(),
            "mean": self._mean.tolist(),
            "std": deviation.tolist(),
            "count": [self._count],
        }
