"""Blocks of a recording's frames: readings before a touch, lost values, references."""

import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.schema import State
from eitskin.errors import DataError
from eitskin.frame import Status

Complex = NDArray[np.complex64]
Mask = NDArray[np.bool_]
Labels = Mapping[str, NDArray[Any]]

MIN_MATRIX: Final = 4  # electrodes of a matrix of values between pairs
MAX_ASYMMETRY: Final = 0.1  # of such a matrix, and size of its diagonal, relative to its values
MIN_LIKENESS: Final = 0.9  # squared cosine of two frames of a sensor; differences are unlike

_TOUCH_LABELS: Final = ("touch_x", "touch_y", "touch_force", "touch_depth", "touch_radius")


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive frames of a recording.

    Attributes:
        values: measured, (n, C).
        before: readings before each touch, (n, C); NaN where lost, None where there are none.
        labels: (n, ...) under the names of `Dataset`'s attributes.
        specimens, sessions: names, (n,).
        status: status of the values, (n, C).
    """

    values: Complex
    before: Complex | None
    labels: Labels
    specimens: NDArray[np.str_]
    sessions: NDArray[np.str_]
    status: NDArray[np.uint8]

    @property
    def is_bent(self) -> Mask:
        """Whether each frame is known to be bent, (n,)."""
        angle = self.labels.get("bend_angle_deg", np.zeros(len(self.values)))
        return np.asarray(np.isfinite(angle) & (angle != 0))

    def with_rows(self, change: Callable[[NDArray[Any]], NDArray[Any]]) -> "Block":
        """Block with all its columns changed alike."""
        return Block(
            change(self.values),
            None if self.before is None else change(self.before),
            {name: change(label) for name, label in self.labels.items()},
            change(self.specimens),
            change(self.sessions),
            change(self.status),
        )


def pair_rows(block: Block, order: str) -> Block:
    """Rows during a press, each with the row before it, which is the other one of its pair."""
    if len(block.values) % 2:
        raise DataError(
            "expected rows before and during each press in turn, got an odd number of rows; remove "
            "the reading without a partner"
        )
    during = np.arange(1 if order == "before-during" else 0, len(block.values), 2)
    x = block.labels.get("touch_x")
    if x is not None and np.isfinite(x[during ^ 1]).any() and not np.isfinite(x[during]).any():
        other = "during-before" if order == "before-during" else "before-during"
        raise DataError(
            f"with rows {order}, only rows before a press have positions; import with --rows "
            f"{other}"
        )
    before = block.values[during ^ 1]
    return replace(block.with_rows(lambda column: column[during]), before=before)


def pair_matrices(table: NDArray[Any], n: int) -> NDArray[Any] | None:
    """Matrices (frames, n, n) of values between pairs, from their rows or whole; None for others.

    Their diagonals hold next to nothing, and both sides the same, or one of them nothing.
    """
    fits = n >= MIN_MATRIX and table.shape[1] in (n, n * n) and table.size % n**2 == 0
    if not fits or table.dtype.kind not in "iufc":
        return None
    Z = np.where(np.isfinite(table), table, 0).reshape(-1, n, n)
    turned, off = Z.swapaxes(1, 2), 1 - np.eye(n)
    both = np.where(np.abs(Z) > np.abs(turned), Z, turned)
    most = MAX_ASYMMETRY * np.where(off, np.abs(both), np.median(np.abs(both)))
    symmetric = both.any() and ((Z == 0) | (np.abs(Z - off * both) <= most)).all()
    return np.where(both == 0, np.nan, both) if symmetric else None


def add_baselines(values: Complex, baseline: Complex) -> tuple[Complex, Complex]:
    """Frames of rows of baselines and of differences from the last one, and the last baseline.

    Baselines are rows that differ by less than half from the `baseline` before the first row.
    """
    last = _finite(baseline)
    own = 4 * _power(_finite(values) - last) < _power(last)
    baselines = np.concatenate([baseline[None], values[own]])[np.cumsum(own)]
    return np.where(own[:, None], values, values + baselines), baselines[-1]


def require_no_baselines(values: Complex) -> None:
    """Raise DataError where the first row is a baseline, and most others differences from it."""
    first, others = _finite(values[0]), _finite(values[1:])
    power, powers = _power(first), _power(others)
    alike = np.abs(others @ first.conj()) ** 2 > MIN_LIKENESS * power * powers
    if 2 * np.sum((powers > 0) & (16 * powers < power) & ~alike) > len(powers):
        raise DataError(
            f"the first row is {np.sqrt(power / np.median(powers)):.3g} times as large as most of "
            "the others, and unlike them: import with --differences where these are differences "
            "from it and from later rows like it; remove it where it is no frame"
        )


def _finite(values: Complex) -> NDArray[np.complex128]:
    """Values in double precision, with 0 for those that are not finite."""
    return np.where(np.isfinite(values), values, 0).astype(np.complex128)


def _power(values: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Sum of the squared magnitudes over the last axis."""
    return np.asarray(np.sum(np.abs(values) ** 2, axis=-1))


def without_bad_values(block: Block, choice: str, first: int) -> Block:
    """Frames with finite values only: others are refused, marked or dropped."""
    bad = ~np.isfinite(block.values)
    lost = np.asarray(bad.any(axis=1))
    if block.before is not None:
        lost = lost | ~np.isfinite(block.before).all(axis=1)
    if not lost.any():
        return block
    if choice == "refuse":
        frame = int(lost.argmax())
        wrong = bad[frame]
        if block.before is not None and not wrong.any():
            wrong = ~np.isfinite(block.before[frame])
        more = int(lost.sum()) - 1
        others = f", and so in {more} more frame{'s' * (more > 1)}" if more else ""
        raise DataError(
            f"impedance must be finite, but channel {wrong.argmax()} of frame {first + frame} is "
            f"empty or not finite{others}; import with "
            "--bad-values mark, which keeps them as lost values, or --bad-values drop"
        )
    if choice == "drop":
        return block.with_rows(lambda column: column[~lost])
    status = np.where(bad, np.uint8(Status.NOT_FINITE), block.status).astype(np.uint8)
    return replace(block, values=np.where(bad, 0, block.values), status=status)


def add_previous_readings(block: Block, last: Block | None) -> Block:
    """Frames of a block, each after the reading before its touch as a frame of its own.

    The touch reference of such a reading is the one before, of the same specimen and session.
    """
    assert block.before is not None  # noqa: S101 - `RecordedFile` refuses to keep what is not there
    before = block.before
    lost = ~np.isfinite(before)
    earlier = np.full_like(before, np.nan)
    origin = np.stack([block.specimens, block.sessions], axis=1)
    same = (origin[1:] == origin[:-1]).all(axis=1)
    earlier[1:][same] = before[:-1][same]
    if last is not None and (last.specimens[-1], last.sessions[-1]) == tuple(origin[0]):
        earlier[0] = last.before[-1]  # type: ignore[index]
    doubled = block.with_rows(lambda column: np.repeat(column, 2, axis=0))
    labels = dict(doubled.labels)
    for name in _TOUCH_LABELS:
        if name in labels:
            labels[name] = labels[name].astype(np.float64)
            labels[name][::2] = np.nan
    state = labels.get("state", np.full(len(doubled.values), State.TOUCH)).copy()
    state[::2] = np.where(block.is_bent, State.BEND, State.IDLE)
    doubled.values[::2] = np.where(lost, 0, before)
    doubled.status[::2] = np.where(lost, np.uint8(Status.NOT_FINITE), 0)
    assert doubled.before is not None  # noqa: S101 - as above
    doubled.before[::2] = earlier
    return replace(doubled, labels=labels | {"state": state})


class ReferenceMeans:
    """Reference of each specimen: the mean of its best readings of the flat, untouched sensor.

    Best are untouched readings that are not known to be bent, then untouched ones, then the first
    frame.
    """

    def __init__(self) -> None:
        """Begin without specimens."""
        self._best: dict[str, tuple[int, NDArray[np.complex128], NDArray[np.int64]]] = {}

    @property
    def names(self) -> list[str]:
        """Names of the specimens in the order of appearance."""
        return list(self._best)

    def add(self, block: Block) -> None:
        """Add the frames of one block."""
        if block.before is None:
            readings = np.where(block.status != 0, np.nan, block.values)
            state = block.labels.get("state", np.full(len(readings), State.TOUCH))
            untouched: Mask = np.asarray(state == State.IDLE)
        else:
            readings = block.before
            untouched = np.asarray(np.isfinite(readings).any(axis=1))
        for name in dict.fromkeys(block.specimens.tolist()):
            own = block.specimens == name
            for grade, usable in ((2, untouched & ~block.is_bent), (1, untouched), (0, own)):
                rows = np.flatnonzero(own & usable)
                if len(rows):
                    self._add(name, grade, readings[rows if grade else rows[:1]])
                    break

    def _add(self, name: str, grade: int, readings: Complex) -> None:
        finite = np.isfinite(readings)
        total = np.where(finite, readings, 0).astype(np.complex128).sum(axis=0)
        count = finite.sum(axis=0)
        best, best_total, best_count = self._best.get(name, (-1, total, count))
        if grade > best:
            self._best[name] = grade, total, count
        elif grade == best > 0:
            self._best[name] = grade, total + best_total, count + best_count

    def references(self, names: Iterable[str]) -> Complex:
        """References (S, C) of the specimens in the order of `names`; 0 where all are lost."""
        sums = (self._best[name][1:] for name in names)
        means = itertools.starmap(lambda total, count: total / np.maximum(count, 1), sums)
        return np.array(list(means), dtype=np.complex64)
