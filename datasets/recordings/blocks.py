"""Blocks of a recording's frames: rows before and during a press, and values that are lost."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.state import State
from eitskin.errors import DataError
from eitskin.frame import Status

Complex = NDArray[np.complex64]

_TOUCH_LABELS: Final = ("touch_x", "touch_y", "touch_force", "touch_depth", "touch_radius")


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive frames: values and readings before a touch (n, C), labels, origins, status."""

    values: Complex
    before: Complex | None
    known: Mapping[str, NDArray[Any]]
    specimens: Sequence[str]
    sessions: Sequence[str]
    status: NDArray[np.uint8]


def rows_during(rows: int, order: str, known: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
    """Rows during a press; the row before it is the other one of its pair."""
    if rows % 2:
        raise DataError(
            "expected rows before and during each press in turn, got an odd number of rows; remove "
            "the reading without a partner"
        )
    during = np.arange(1 if order == "before-during" else 0, rows, 2)
    x = known.get("touch_x")
    if x is not None and np.isfinite(x[during ^ 1]).any() and not np.isfinite(x[during]).any():
        other = "during-before" if order == "before-during" else "before-during"
        raise DataError(
            f"with rows {order}, only rows before a press have positions; import with --rows "
            f"{other}"
        )
    return during


def without_bad_values(block: Block, choice: str, first: int) -> Block:
    """Frames with finite values only: others are refused, marked or dropped."""
    bad = ~np.isfinite(block.values)
    lost = np.asarray(bad.any(axis=1))
    if block.before is not None:
        lost = lost | ~np.isfinite(block.before).all(axis=1)
    if not lost.any():
        return block
    if choice == "refuse":
        frame = int(np.flatnonzero(lost)[0])
        wrong = bad[frame]
        if block.before is not None and not wrong.any():
            wrong = ~np.isfinite(block.before[frame])
        channel = int(np.flatnonzero(wrong)[0])
        more = int(lost.sum()) - 1
        others = f", and so in {more} more frame{'s' * (more > 1)}" if more else ""
        raise DataError(
            f"impedance must be finite, but channel {channel} of frame {first + frame} is empty or "
            f"not finite{others}; import with "
            "--bad-values mark, which keeps them as lost values, or --bad-values drop"
        )
    if choice == "drop":
        return _chosen(block, ~lost)
    return replace(
        block,
        values=np.where(bad, 0, block.values),
        status=np.where(bad, np.uint8(Status.NOT_FINITE), block.status).astype(np.uint8),
    )


def _chosen(block: Block, mask: NDArray[np.bool_]) -> Block:
    rows = np.flatnonzero(mask).tolist()
    return Block(
        block.values[rows],
        None if block.before is None else block.before[rows],
        {name: label[rows] for name, label in block.known.items()},
        [block.specimens[row] for row in rows],
        [block.sessions[row] for row in rows],
        block.status[rows],
    )


def with_before(block: Block, last: Block | None) -> Block:
    """Frames of a block, each after the reading before its touch as a frame of its own.

    The touch reference of such a reading is the one before, of the same specimen and session.
    """
    assert block.before is not None  # noqa: S101 - `Recording` refuses to keep what is not there
    before, n = block.before, len(block.values)
    lost = ~np.isfinite(before)
    earlier = np.full_like(before, np.nan)
    origin = list(zip(block.specimens, block.sessions, strict=True))
    same = np.array([a == b for a, b in itertools.pairwise(origin)], dtype=bool)
    earlier[1:][same] = before[:-1][same]
    if last is not None and (last.specimens[-1], last.sessions[-1]) == origin[0]:
        earlier[0] = last.before[-1]  # type: ignore[index]
    angle = block.known.get("bend_angle_deg", np.zeros(n))
    bent = np.isfinite(angle) & (angle != 0)
    known = {name: np.repeat(label, 2, axis=0) for name, label in block.known.items()}
    for name in _TOUCH_LABELS:
        if name in known:
            known[name] = known[name].astype(np.float64)
            known[name][::2] = np.nan
    state = np.repeat(block.known.get("state", np.full(n, State.TOUCH)), 2)
    state[::2] = np.where(bent, State.BEND, State.IDLE)
    known["state"] = state
    return Block(
        _alternating(np.where(lost, 0, before), block.values),
        _alternating(earlier, before),
        known,
        [name for name in block.specimens for _ in range(2)],
        [name for name in block.sessions for _ in range(2)],
        _alternating(lost * np.uint8(Status.NOT_FINITE), block.status),
    )


def _alternating(first: NDArray[Any], second: NDArray[Any]) -> NDArray[Any]:
    """Rows of two tables in turn."""
    return np.stack([first, second], axis=1).reshape(-1, *first.shape[1:])
