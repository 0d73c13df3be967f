"""Protocols of patterns: currents into electrodes, and weights of their voltages."""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError
from eitskin.protocol import Protocol, Row

MAX_PATTERNS = 1 << 16  # numbers in a table that may be one of patterns
_SENSES = re.compile("m(eas)?_?pat|meas|sens|volt|v_?pat", re.I)


def protocol_of_patterns(
    drive: ArrayLike, sense: ArrayLike
) -> tuple[Protocol, NDArray[np.float64]]:
    """Protocol and current of each measurement, all sense patterns for each drive pattern in turn.

    Patterns are currents into the electrodes or weights of their voltages, one pattern per column,
    (electrodes, patterns). Currents (drives * senses,) are in the unit of `drive`. Raises DataError
    for patterns that do not use exactly one electrode of each sign.
    """
    drives, senses = np.asarray(drive, dtype=float), np.asarray(sense, dtype=float)
    if drives.shape[:1] != senses.shape[:1]:
        raise DataError(
            "drive and sense patterns must have one row per electrode, got tables of shapes "
            f"{drives.shape} and {senses.shape}"
        )
    rows, currents, electrodes = measurement_rows((each, senses.T) for each in drives.T)
    return Protocol.from_rows(rows, electrodes), np.array(currents)


def find_patterns(
    shapes: Mapping[str, tuple[int, ...]], array: Callable[[str], ArrayLike]
) -> tuple[str, str, str] | None:
    """Names of drive patterns, of sense patterns, and of their measurements among tables.

    Each column of both has one electrode of each sign, and one axis of the measurements has all
    pairs of columns. Currents differ from weights by size, or else by name. None
    where no two tables are patterns, or several are.
    """
    plain = {}
    for name, shape in shapes.items():
        if len(shape) == 2 and min(shape) > 1 and math.prod(shape) <= MAX_PATTERNS:
            with suppress(DataError, TypeError, ValueError):
                pairs, sizes = electrode_pairs(array(name), name)
                if all(plus != minus for plus, minus in pairs):
                    plain[name] = bool((sizes == 1).all()) + bool(_SENSES.match(name))
    counts = [shapes[name][1] for name in plain]
    frames = [name for name, shape in shapes.items() if math.prod(counts) in shape]
    if len(plain) != 2 or len(set(plain.values())) != 2 or len(frames) != 1:
        return None
    drive, sense = sorted(plain, key=lambda name: plain[name])
    return (drive, sense, frames[0]) if shapes[drive][0] == shapes[sense][0] else None


def electrode_pairs(
    patterns: ArrayLike, kind: str
) -> tuple[list[tuple[int, int]], NDArray[np.float64]]:
    """Positive and negative electrode of each column, and the size of its entries."""
    table = np.asarray(patterns, dtype=np.float64)
    if table.ndim != 2 or ((table > 0).sum(axis=0) != 1).any() or (table < 0).sum(axis=0).max() > 1:
        raise DataError(
            f"expected {kind} patterns of one positive and one negative electrode in each column, "
            f"got a table of shape {table.shape} with others"
        )
    plus, minus = table.argmax(axis=0), table.argmin(axis=0)
    sizes = table[plus, np.arange(table.shape[1])]
    if not np.allclose(-table[minus, np.arange(table.shape[1])], sizes):
        raise DataError(
            f"the two electrodes of each {kind} pattern must have opposite values; got others"
        )
    return list(zip(plus.tolist(), minus.tolist(), strict=True)), sizes


def measurement_rows(
    parts: Iterable[tuple[ArrayLike, ArrayLike]],
) -> tuple[list[Row], list[float], int]:
    """Measurements, their currents, and number of electrodes, of EIDORS's stimulations.

    Each has currents into the electrodes, (electrodes, 1), and weights of their voltages,
    (measurements, electrodes). Raises DataError as `protocol_of_patterns` does.
    """
    rows: list[Row] = []
    sizes: list[float] = []
    count = 0
    for stimulation, measurement in parts:
        count = np.size(stimulation)
        ((a, b),), (current,) = electrode_pairs(np.reshape(stimulation, (-1, 1)), "drive")
        senses, weights = electrode_pairs(np.atleast_2d(measurement).T, "sense")
        rows += [(a, b, c, d) for c, d in senses]
        sizes += (current * weights).tolist()
    return rows, sizes, count
