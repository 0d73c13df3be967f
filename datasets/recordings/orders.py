"""Orders of a frame's readings that instruments use, tested by laws that every body obeys."""

from functools import lru_cache
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.protocol import Protocol

Order = Literal["", "given", "rotated", "reversed", "sense-first"]

_LAW, _MODEL = "reciprocity and sums around loops", "the model of the design"
_MIN_DOUBTED_MISFITS: Final = {_LAW: 0.005, _MODEL: 0.1}  # of an order that is doubted
_RATIOS: Final = {_LAW: 0.1, _MODEL: 0.4}  # of the misfits of another order and of it
_MAX_LOOP_READINGS: Final = 1200  # readings, of which sums around loops are solved within a second


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
