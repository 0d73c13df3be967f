"""Which electrodes are driven and which are sensed, measurement by measurement."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.geometry import ConfigurationError


@dataclass(frozen=True, slots=True)
class Protocol:
    """A table of measurements, each (drive+, drive-, sense+, sense-).

    Attributes:
        table: electrode numbers, one row per measurement.
        n_electrodes: how many electrodes the sensor has.
    """

    table: tuple[tuple[int, int, int, int], ...]
    n_electrodes: int

    def __post_init__(self) -> None:
        """Check that every row names electrodes that exist and two different ones per pair."""
        if not self.table:
            raise ConfigurationError("a protocol needs at least one measurement, got none")
        for number, row in enumerate(self.table):
            if len(row) != 4 or any(not 0 <= e < self.n_electrodes for e in row):
                raise ConfigurationError(
                    f"measurement {number}: expected (drive+, drive-, sense+, sense-), each from "
                    f"0 to {self.n_electrodes - 1}, got {row}"
                )
            if row[0] == row[1] or row[2] == row[3]:
                raise ConfigurationError(
                    f"measurement {number}: drive and sense pairs need two different electrodes, "
                    f"got {row}"
                )

    @classmethod
    def pairwise(cls, n_electrodes: int) -> "Protocol":
        """Every pair once, driven and sensed at the same pair: (0,1), (0,2) ... in order."""
        pairs = combinations(range(n_electrodes), 2)
        return cls(tuple((i, j, i, j) for i, j in pairs), n_electrodes)

    @classmethod
    def from_rows(cls, rows: Iterable[Iterable[int]], n_electrodes: int) -> "Protocol":
        """A protocol from any iterable of rows of four integers."""
        return cls(tuple(tuple(int(e) for e in row) for row in rows), n_electrodes)  # type: ignore[misc]

    def __len__(self) -> int:
        """Number of measurements in one frame."""
        return len(self.table)

    @property
    def labels(self) -> tuple[str, ...]:
        """Short names, '0-1' where drive and sense pair are the same, else '0-1/2-3'."""
        return tuple(
            f"{a}-{b}" if (a, b) == (c, d) else f"{a}-{b}/{c}-{d}" for a, b, c, d in self.table
        )

    def patterns(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Drive and sense patterns, each (n_electrodes, measurements), entries -1, 0, +1."""
        table = np.array(self.table)
        columns = np.arange(len(table))
        drive = np.zeros((self.n_electrodes, len(table)))
        sense = np.zeros_like(drive)
        drive[table[:, 0], columns], drive[table[:, 1], columns] = 1.0, -1.0
        sense[table[:, 2], columns], sense[table[:, 3], columns] = 1.0, -1.0
        return drive, sense

    def measure(self, impedance: ArrayLike) -> NDArray[np.inexact]:
        """Transfer impedances [ohm], (..., measurements), of matrices (..., n_el, n_el) [ohm]."""
        Z = np.asarray(impedance)
        if Z.shape[-2:] != (self.n_electrodes, self.n_electrodes):
            raise ConfigurationError(
                f"expected an impedance matrix of shape ({self.n_electrodes}, "
                f"{self.n_electrodes}), got {Z.shape}"
            )
        a, b, c, d = np.array(self.table).T
        measured: NDArray[np.inexact] = Z[..., c, a] - Z[..., d, a] - Z[..., c, b] + Z[..., d, b]
        return measured
