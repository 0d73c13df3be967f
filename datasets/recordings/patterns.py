"""Protocols from the matrices of patterns that reconstruction toolkits keep beside their data."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError
from eitskin.protocol import Protocol


def protocol_of_patterns(
    drive: ArrayLike, sense: ArrayLike
) -> tuple[Protocol, NDArray[np.float64]]:
    """Protocol and current of each measurement, all sense patterns for each drive pattern in turn.

    Args:
        drive: currents into each electrode, one pattern per column, (electrodes, drives).
        sense: weights of each electrode's voltage, one pattern per column, (electrodes, senses).

    Returns:
        The protocol, and the currents in the unit of `drive`, (drives * senses,).

    Raises:
        DataError: for patterns that do not use exactly one electrode of each sign.
    """
    pairs, currents = _pairs(drive, "drive")
    senses, weights = _pairs(sense, "sense")
    electrodes = np.shape(drive)[0]
    if np.shape(sense)[0] != electrodes:
        raise DataError(
            f"drive and sense patterns must have one row per electrode, got {electrodes} and "
            f"{np.shape(sense)[0]} rows"
        )
    rows = [(*pair, *channel) for pair in pairs for channel in senses]
    return Protocol.from_rows(rows, electrodes), np.outer(currents, weights).ravel()


def _pairs(patterns: ArrayLike, kind: str) -> tuple[list[tuple[int, int]], NDArray[np.float64]]:
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
