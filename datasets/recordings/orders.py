"""Orders of a frame's readings that instruments use, tested by reciprocity."""

from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from eitskin.errors import DataError
from eitskin.protocol import Protocol

Order = Literal["", "given", "rotated", "reversed"]

_LEAST: Final = 0.02  # misfit of an order that is doubted
_RATIO: Final = 0.1  # of the misfits of another order and of it


def in_order(protocol: Protocol, order: Order) -> Protocol:
    """Protocol whose sense pairs begin behind each drive pair (rotated), or run backwards."""

    def place(number: int) -> tuple[int, int]:
        row = protocol.table[number]
        first = drives[row[:2]]
        behind = (row[2] - row[0]) % protocol.n_electrodes
        return first, {"rotated": behind, "reversed": -number}.get(order, number)

    drives: dict[tuple[int, ...], int] = {}
    for number, row in enumerate(protocol.table):
        drives.setdefault(row[:2], number)
    rows = (protocol.table[number] for number in sorted(range(len(protocol)), key=place))
    return Protocol.from_rows(rows, protocol.n_electrodes)


def reciprocity_misfit(protocol: Protocol, readings: ArrayLike) -> float:
    """Median difference of sizes of reciprocal readings (measurements,), of their mean; or NaN."""
    size = np.abs(np.asarray(readings))
    numbers = {(frozenset(r[:2]), frozenset(r[2:])): k for k, r in enumerate(protocol.table)}
    pairs = [(k, numbers[s, d]) for (d, s), k in numbers.items() if d != s and (s, d) in numbers]
    a, b = size[np.array(pairs, dtype=int).reshape(-1, 2)].T
    usable = a + b > 0
    return float(np.median(2 * abs(a - b)[usable] / (a + b)[usable])) if usable.any() else np.nan


def require_order(protocol: Protocol, readings: ArrayLike) -> None:
    """Raise DataError where reciprocity says another order of the readings than the protocol's."""
    if np.shape(readings) != (len(protocol),):
        return  # their number is refused with other words
    orders: list[Order] = [order for order in get_args(Order) if order]
    misfits = {o: reciprocity_misfit(in_order(protocol, o), readings) for o in orders}
    best = min(orders, key=misfits.__getitem__)
    given = misfits["given"]
    if given > _LEAST and misfits[best] < _RATIO * given:
        raise DataError(
            f"reciprocal readings differ by {given:.2%} (median) in the order of the protocol, by "
            f"{misfits[best]:.2%} in the order '{best}': say --order {best}, or "
            "--order given where the protocol is right"
        )
