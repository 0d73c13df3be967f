"""Protocols of recordings: orders of readings that instruments use, and patterns of currents.

Orders are tested by laws that every body obeys.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.protocol import Protocol, Row

Order = Literal["", "given", "rotated", "reversed", "sense-first"]

_LAW, _MODEL = "reciprocity and sums around loops", "the model of the design"
_MIN_DOUBTED_MISFITS: Final = {_LAW: 0.005, _MODEL: 0.1}  # of an order that is doubted
_RATIOS: Final = {_LAW: 0.1, _MODEL: 0.4}  # of the misfits of another order and of it
_MAX_LOOP_READINGS: Final = 1200  # readings, of which sums around loops are solved within a second
MAX_PATTERNS = 1 << 16  # numbers in a table that may be one of patterns
_SENSES = re.compile("m(eas)?_?pat|meas|sens|volt|v_?pat", re.I)


def in_order(protocol: Protocol, order: Order) -> Protocol:
    """Protocol whose readings come in another order.

    Sense pairs begin behind each drive pair (rotated); all run backwards (reversed); or each sense
    pair is read at all drive pairs before the next one (sense-first).
    """

    def place(number: int) -> tuple[int, int]:
        row = protocol.table[number]
        if order == "sense-first":
            return first[row[2:]], number
        behind = (row[2] - row[0]) % protocol.n_electrodes
        return first[row[:2]], behind if order == "rotated" else -number

    if order in ("", "given"):
        return protocol
    first: dict[tuple[int, ...], int] = {}
    for number, row in enumerate(protocol.table):
        first.setdefault(row[2:] if order == "sense-first" else row[:2], number)
    rows = (protocol.table[number] for number in sorted(range(len(protocol)), key=place))
    return Protocol.from_rows(rows, protocol.n_electrodes)


def law_misfit(protocol: Protocol, readings: ArrayLike) -> float:
    """Median difference of readings (measurements,) from what the others say of them; or NaN.

    It is relative. Readings with signs obey reciprocity and sums around loops: they are symmetric
    forms of drive and sense currents. Magnitudes obey reciprocity alone.
    """
    values = np.asarray(readings)
    live = np.isfinite(values) & (values != 0)
    values, table = (
        values[live],
        [row for row, good in zip(protocol.table, live, strict=True) if good],
    )
    signed = np.imag(values).any() or (np.real(values) < 0).any()
    if signed and len(protocol) <= _MAX_LOOP_READINGS:
        left, sizes, _ = np.linalg.svd(protocol.forms[live], full_matrices=False)
        left = left[:, sizes > 1e-9 * sizes[0]]
        expected = left @ (left.T @ values)
        tested = (left**2).sum(axis=1) < 1 - 1e-9
    else:
        values, numbers = np.abs(values), dict[frozenset[frozenset[int]], int]()
        pairs = (frozenset((frozenset(r[:2]), frozenset(r[2:]))) for r in table)
        group = np.array([numbers.setdefault(pair, len(numbers)) for pair in pairs])
        counts = np.bincount(group)
        expected = (np.bincount(group, values) / counts)[group]
        tested = counts[group] > 1
    if not tested.any():
        return float("nan")
    sizes = np.maximum(np.abs(expected[tested]), np.finfo(float).tiny)
    return float(np.median(2 * np.abs(values - expected)[tested] / sizes))


def model_misfit(protocol: Protocol, readings: ArrayLike, design: SensorDesign) -> float:
    """Mean relative difference of readings (measurements,) from those of a design's model.

    Magnitudes are compared, up to one factor; NaN for a design whose model takes long.
    """
    if isinstance(design.outline, Surface):
        return float("nan")
    from eitskin.simulator.electrical.forward_model import ForwardModel

    expected = np.abs(protocol.measure(_model(ForwardModel, design)))
    ratios = np.abs(readings)[expected > 0] / expected[expected > 0]
    return float(np.mean(np.abs(ratios / np.median(ratios) - 1))) if ratios.any() else float("nan")


@lru_cache(maxsize=1)
def _model(model: Any, design: SensorDesign) -> NDArray[Any]:
    return np.asarray(model(design, "coarse").impedance())


def require_order(
    protocol: Protocol, readings: ArrayLike, design: SensorDesign | None = None
) -> None:
    """Raise DataError where the laws say another order of the readings than the protocol's.

    The model of a design says it where no law relates the readings.
    """
    if np.shape(readings) != (len(protocol),):
        return  # their number is refused with other words
    orders: list[Order] = [order for order in get_args(Order) if order]
    law, misfits = _LAW, {o: law_misfit(in_order(protocol, o), readings) for o in orders}
    if np.isnan(misfits["given"]) and design is not None:
        misfits = {o: model_misfit(in_order(protocol, o), readings, design) for o in orders}
        law = _MODEL
    best = min(orders, key=misfits.__getitem__)
    given = misfits["given"]
    if given > _MIN_DOUBTED_MISFITS[law] and misfits[best] < _RATIOS[law] * given:
        raise DataError(
            f"by {law}, readings differ by {given:.2%} in the "
            f"order of the protocol, by {misfits[best]:.2%} in the order '{best}': say "
            f"--order {best}, or --order given where the protocol is right"
        )


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
