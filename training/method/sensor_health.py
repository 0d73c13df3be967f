"""Health of a sensor over a session: electrodes and channels whose readings leave their range.

A reading is compared with the range that readings of the healthy sensor had, as departures of the
logarithms of magnitudes from their middle, less what most channels share: gel and gain change all
alike. An electrode has failed where half of its channels, or more, stay out of their range and
those of no other electrode explain it. It is named with the time that it began, and left out.
"""

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.datasets import Dataset, State
from eitskin.simulator import Protocol, Status
from eitskin.training.method.stored_fields import StoredFields

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

MARGIN = 0.1  # of the logarithm, beyond the range of healthy readings
WIDER = 0.5  # of that range, which is added to the margin
REACH = 1.5  # times the largest change by a touch, beyond the range of untouched readings
WINDOW, MIN_READINGS = 15, 8  # latest readings, most of which show a fault that stays
FIRST_READINGS, FIRST_SHARE = 40, 0.2  # of a recording, that show its range where nothing else does
GROWTH = 0.05  # share of a departure that a range takes in at a time, where it grows
MIN_SHARE, RECOVERED = 0.5, 0.25  # of an electrode's channels out of their range
# electrodes that explain the same channels; what more share is no electrode's fault
MAX_TIED_ELECTRODES = 2
MAX_OUTLIER_SHARE = 0.5  # of all channels; beyond it the sensor is another, or in another state
UNKNOWN_DEPARTURE = 1e3  # departure that no channel has
MAX_NAMED_CHANNELS = 4  # channels in a sentence


@dataclass(frozen=True, slots=True, eq=False)
class ReadingRange(StoredFields):
    """Range of the readings of a healthy sensor.

    Attributes:
        low, high: departures of logarithms, less what most channels share (C,).
        reach: largest change of the logarithm by a touch beyond that (C,).
        middle: logarithms of magnitudes that they depart from (C,); None where it is a session's
            reference.
    """

    low: Array
    high: Array
    reach: Array
    middle: Array | None = None

    @classmethod
    def fit(
        cls, untouched: ArrayLike, touched: ArrayLike | None = None, reference: bool = False
    ) -> "ReadingRange":
        """Range of readings (n, C), NaN where bad.

        Args:
            untouched: magnitudes, in any unit; with `reference` relative to that of their sensor.
            touched: magnitudes with a touch, relative to those before it (k, C).
            reference: whether sessions begin with a reference of their own.
        """
        logs = _log(untouched)
        known = np.isfinite(logs).any(axis=0)
        logs[:, ~known] = 0.0
        middle = np.zeros(logs.shape[1]) if reference else np.nanmedian(logs, axis=0)
        shares = [0.001, 0.999] if reference else [0.01, 0.99]
        low, high = np.nanquantile(_departure(logs, middle), shares, axis=0)
        reach = np.zeros(len(middle))
        if touched is not None and len(np.asarray(touched)):
            reach = np.nanmax(np.nan_to_num(np.abs(_log(touched))), axis=0)
        low, high = (
            np.where(known, low, -UNKNOWN_DEPARTURE),
            np.where(known, high, UNKNOWN_DEPARTURE),
        )
        return cls(low, high, reach, None if reference else middle)

    def widen(self) -> "ReadingRange":
        """Range twice as wide, where few frames showed it."""
        return replace(self, low=2.0 * self.low, high=2.0 * self.high)

    @classmethod
    def from_recording(cls, data: Dataset) -> "ReadingRange":
        """Range of the readings before the touches of a recording, and of the touches' changes."""
        before = data.has_touch_reference
        readings = _good(_magnitudes(data, before), data.status)
        ratio = np.abs(data.impedance[before] / data.touch_reference[before])
        return cls.fit(
            readings[np.isfinite(readings).any(axis=1)], _good(ratio, data.status[before])
        )


def _log(magnitudes: ArrayLike) -> Array:
    """Logarithms, NaN of what is no positive number."""
    values = np.array(magnitudes, dtype=float)
    logs: Array = np.log(np.where(np.isfinite(values) & (values > 0.0), values, np.nan))
    return logs


def _departure(logs: Array, middle: Array) -> Array:
    """Departures of logarithms (..., C) from their middle (C,), less what most channels share."""
    off = np.atleast_2d(logs - middle)
    departure: Array = (off - np.array([[_shorth_median(row)] for row in off])).reshape(logs.shape)
    return departure


def _shorth_median(off: Array) -> float:
    """Median of the half of the channels that are closest together; zero without any."""
    values = np.sort(off[np.isfinite(off)])
    if not len(values):
        return 0.0
    half = (len(values) + 1) // 2
    first = int(np.argmin(values[half - 1 :] - values[: len(values) - half + 1]))
    return float(values[first + (half - 1) // 2] + values[first + half // 2]) / 2.0


def _good(values: Array, status: NDArray[np.uint8]) -> Array:
    return np.where(status == 0, values, np.nan).astype(float)


def _magnitudes(data: Dataset, before: Bools) -> Array:
    """Untouched readings (n, C) of a dataset's frames: before their touches, or idle; NaN else."""
    idle = (data.state == State.IDLE)[:, None]
    frames = np.where(idle, _good(np.abs(data.impedance), data.status), np.nan)
    return np.where(before[:, None], np.abs(data.touch_reference), frames)


@dataclass(frozen=True, slots=True)
class ElectrodeFault:
    """An electrode that has failed.

    Attributes:
        electrode: its number.
        number: number of the frame that it began with.
        time: time of that frame [s].
        lost: number of its channels that left their range.
        channels: numbers of all of its channels.
    """

    electrode: int
    number: int
    time: float
    lost: int
    channels: tuple[int, ...]

    def __str__(self) -> str:
        """The fault in words."""
        return (
            f"electrode {self.electrode} has failed or aged since frame {self.number} "
            f"({self.time:.6g} s): {self.lost} of its {len(self.channels)} channels left the range "
            "of a healthy sensor; they are left out; check its contact, wire and plug"
        )


def electrodes_out(wrong: Bools, members: Bools) -> list[int]:
    """Electrodes that explain wrong channels (C,): half of the channels of each, or more.

    The one with the largest share explains all of its channels, and so on with what is left.

    Args:
        wrong: channels.
        members: channels of each electrode (E, C).
    """
    unexplained, electrodes = members.copy(), list[int]()
    while True:
        total = unexplained.sum(axis=1)
        share = np.where(total > 1, (unexplained & wrong).sum(axis=1) / np.maximum(total, 1), 0.0)
        worst = np.flatnonzero(share >= max(MIN_SHARE, float(share.max(initial=0.0))))
        if not len(worst) or len(worst) > MAX_TIED_ELECTRODES:
            return electrodes
        electrodes += worst.tolist()
        unexplained &= ~members[worst].any(axis=0)


def electrode_members(protocol: Protocol | None, channels: int) -> Bools:
    """Channels of each electrode (E, C); no electrodes where the protocol is not theirs."""
    if protocol is None or len(protocol) != channels:
        return np.zeros((0, channels), bool)
    numbers = np.arange(protocol.n_electrodes)
    members: Bools = (np.array(protocol.table)[:, :, None] == numbers).any(axis=1).T
    return members


@dataclass
class SensorHealth:
    """Health of one sensor, followed from reading to reading.

    Attributes:
        usual: range of healthy readings; `middle` is that of the session.
        protocol: protocol of the channels; None where unknown, and only channels can be named.
        grows: whether the range follows slow drift, as where it is still learned.
        faults: electrodes that have failed and not recovered.
    """

    usual: ReadingRange
    protocol: Protocol | None = None
    grows: bool = False
    faults: dict[int, ElectrodeFault] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """No reading so far."""
        channels = len(self.usual.low)
        self._members = electrode_members(self.protocol, channels)
        margin = MARGIN + WIDER * (self.usual.high - self.usual.low)
        self._limits = np.array([self.usual.low - margin, self.usual.high + margin])
        self._window: deque[tuple[int, float, Bools]] = deque(maxlen=WINDOW)
        self.out = np.zeros(channels, bool)

    def begin(self, magnitudes: ArrayLike) -> None:
        """Take a session's first reading (C,) for the middle, where another day's is far off."""
        logs, middle = _log(magnitudes), self.usual.middle
        if (
            middle is None
            or self._outside(_departure(logs, middle), 0.0).mean() > MAX_OUTLIER_SHARE
        ):
            self.usual = replace(self.usual, middle=logs)

    def _outside(self, off: Array, beyond: "Array | float") -> Bools:
        with np.errstate(invalid="ignore"):
            return np.asarray((off < self._limits[0] - beyond) | (off > self._limits[1] + beyond))

    def follow(
        self, magnitudes: ArrayLike, number: int, time: float, untouched: bool = False
    ) -> Bools:
        """Channels (C,) to be left out of the frame of a reading, and from it on.

        Args:
            magnitudes: magnitudes of the reading (C,), NaN where bad.
            number, time: number and time of its frame.
            untouched: whether nothing touches the sensor; other readings may reach further, and
                only what stays out of its range is left out.
        """
        middle = self.usual.middle
        off = _departure(_log(magnitudes), np.zeros(len(self.out)) if middle is None else middle)
        now = self._outside(off, 0.0 if untouched else REACH * self.usual.reach)
        self._window.append((number, time, now))
        if not (self.grows or self.faults or any(row.any() for _, _, row in self._window)):
            self.out = now
            return now
        rows = np.array([row for _, _, row in self._window])
        most = 2 * rows.sum(axis=0) > len(rows)
        self.out = np.asarray(most & (len(rows) >= MIN_READINGS))
        if self.out.mean() > MAX_OUTLIER_SHARE:
            return np.zeros(len(now), bool)
        for e in electrodes_out(self.out, self._members):
            if e not in self.faults:
                shown = rows[:, self._members[e]].mean(axis=1) >= MIN_SHARE
                since = self._window[int(shown.argmax())]
                lost = int((self.out & self._members[e]).sum())
                channels = tuple(np.flatnonzero(self._members[e]).tolist())
                self.faults[e] = ElectrodeFault(e, since[0], since[1], lost, channels)
        for e in list(self.faults):
            if len(rows) == WINDOW and self.out[self._members[e]].mean() < RECOVERED:
                del self.faults[e]
        bad: Bools = self.out | self._members[list(self.faults)].any(axis=0)
        if self.grows:
            step = np.where(self._outside(off, 0.0) | bad | np.isnan(off), 0.0, off)
            inner = self._limits + np.array([[1.0], [-1.0]]) * MARGIN
            self._limits += (
                GROWTH
                * np.array([np.minimum(step - inner[0], 0.0), np.maximum(step - inner[1], 0.0)])
                * (step != 0.0)
            )
        return bad | now if untouched and now.mean() <= MAX_OUTLIER_SHARE else bad

    def problems(self, labels: tuple[str, ...]) -> tuple[str, ...]:
        """Faults in words; `labels` are those of the channels."""
        messages = [str(fault) for fault in self.faults.values()]
        if self.out.mean() > MAX_OUTLIER_SHARE:
            messages.append(
                f"{self.out.sum()} of {len(self.out)} channels left the range of a healthy sensor: "
                "it is another, or in another state; begin a new session, or train again"
            )
        elif (alone := self.out & ~self._members[list(self.faults)].any(axis=0)).any():
            names = [labels[i] for i in np.flatnonzero(alone)]
            more = ", ..." if len(names) > MAX_NAMED_CHANNELS else ""
            messages.append(
                f"channel {', '.join(names[:MAX_NAMED_CHANNELS])}{more} left the range of a "
                "healthy sensor and is left out"
            )
        return tuple(messages)


def follow_recording(
    data: Dataset, usual: ReadingRange | None = None, grows: bool = True
) -> tuple[Dataset, tuple[ElectrodeFault, ...]]:
    """Recording with the channels of failed electrodes marked, and the faults as they began.

    Sessions are followed in the order of time, by the readings before touches and of the idle
    sensor; by all frames where sessions have references of their own.

    Args:
        data: frames.
        usual: range of healthy readings; that of the first readings of each specimen when omitted.
        grows: whether a range that is not given follows slow drift.
    """
    order = np.lexsort((np.arange(len(data)), data.time, data.episode, data.specimen))
    readings = _magnitudes(data, data.has_touch_reference)
    own = usual is not None and usual.middle is None
    if own:
        readings = _good(np.abs(data.impedance), data.status)
    there: Bools = np.asarray(np.isfinite(readings).any(axis=1))
    bad, faults = np.zeros(readings.shape, bool), list[ElectrodeFault]()
    for specimen in np.unique(data.specimen):
        rows = order[data.specimen[order] == specimen]
        seen = rows[there[rows]]
        if len(seen) < MIN_READINGS:
            continue
        reading_range = usual
        if reading_range is None:
            reading_range = ReadingRange.fit(
                readings[seen[: max(FIRST_READINGS, int(FIRST_SHARE * len(seen)))]]
            )
        health = SensorHealth(reading_range, data.protocol, grows and usual is None)
        health.begin(np.abs(data.reference[specimen]) if own else readings[seen[0]])
        reported_faults = set[ElectrodeFault]()
        mask = np.zeros(readings.shape[1], bool)
        for row in rows.tolist():
            if there[row]:
                mask = health.follow(readings[row], row, float(data.time[row]), not own)
                reported_faults |= set(health.faults.values())
            bad[row] = mask
        faults += sorted(reported_faults, key=lambda fault: fault.number)
    if not bad.any():
        return data, tuple(faults)
    status = np.where(bad, data.status | np.uint8(Status.OPEN), data.status)
    return replace(data, status=status.astype(np.uint8)), tuple(faults)
