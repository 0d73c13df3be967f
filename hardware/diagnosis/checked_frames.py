"""Frames of a sensor check: statistics of each channel, findings, and variation over time."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import LARGEST_READING, LEAST_READING
from eitskin.errors import ConfigurationError, FrameError
from eitskin.frame import Frame, Status
from eitskin.protocol import Protocol

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Complex = NDArray[np.complex128]

OPEN, INSULATED = 10.0, 40.0
"""Ratio of an open channel to its expected value: with a capacitive phase, and with any phase.
Stray capacitances of 100 to 200 pF at 40 kHz give 25 to 50, a poor contact of 5 kohm gives 10."""
CAPACITIVE_DEG = -45.0
SHORT = 0.1
"""Ratio to the expected value below which a channel is shorted."""
MIN_FLAGGED = 0.1
"""Largest share of frames with a status bit that is no finding."""


@dataclass(frozen=True, eq=False)
class CheckedFrames:
    """Frames of one check.

    Attributes:
        protocol: stimulation and measurement pattern of all frames.
        impedance: (frames, measurements) [ohm]; NaN for every value that is not finite.
        status: `Status` bits, (frames, measurements).
        expected: magnitudes of a healthy sensor, (measurements,) [ohm].
    """

    protocol: Protocol
    impedance: Complex
    status: NDArray[np.uint8]
    expected: Array

    @cached_property
    def finite(self) -> Bools:
        """Whether each value is finite, (frames, measurements)."""
        return np.isfinite(self.impedance)

    @cached_property
    def usable(self) -> Bools:
        """Channels with finite values that are not clipped, (measurements,)."""
        clipped = self.channels_with_status(Status.CLIPPED) & ~self.short_circuits
        return np.asarray(self.finite.any(axis=0) & ~clipped)

    @cached_property
    def short_circuits(self) -> Bools:
        """Channels with nearly no resistance, (measurements,); their current clips on any board.

        One small value is no short where a pair is not sensed where it is driven; small values of
        all channels, two at least, that drive the pair are.
        """
        small = self.finite.any(axis=0) & (self.ratio < SHORT * self._scale)
        drives = np.sort(np.array(self.protocol.table)[:, :2], axis=1)
        alike = (drives[:, None] == drives).all(axis=2)
        others = np.where(alike, small, True).all(axis=1) & (alike.sum(axis=1) > 1)
        return np.asarray(small & (self.senses_where_it_drives | others))

    @cached_property
    def value(self) -> Complex:
        """Median of each channel's finite values (measurements,) [ohm]; zero where it has none."""
        kept = self.impedance.copy()
        kept[:, ~self.finite.any(axis=0)] = 0.0
        return np.asarray(np.nanmedian(kept.real, axis=0) + 1j * np.nanmedian(kept.imag, axis=0))

    @cached_property
    def ratio(self) -> Array:
        """Ratios of the magnitudes to the expected ones, (measurements,)."""
        return np.asarray(np.abs(self.value) / self.expected)

    @cached_property
    def open_circuits(self) -> Bools:
        """Channels without a current, (measurements,)."""
        # Small values between neighbours change manifold with the places of electrodes.
        least = SHORT * float(np.sqrt(np.mean(self.expected**2)))
        floor = np.where(self.senses_where_it_drives, self.expected, least)
        times = np.abs(self.value) / np.maximum(self.expected, floor)
        times /= max(self._scale, np.finfo(float).tiny)
        capacitive = np.angle(self.value, deg=True) < CAPACITIVE_DEG
        large = (times > INSULATED) | ((times > OPEN) & capacitive)
        return np.asarray(self._reported_open | (self.usable & large))

    @property
    def _reported_open(self) -> Bools:
        return self.channels_with_status(Status.OPEN) | self.channels_with_status(
            Status.LOW_CURRENT
        )

    @cached_property
    def _scale(self) -> float:
        """Ratio of good channels to their expected values.

        The lowest fifth of the ratios shows a wrong scale from bad contacts: it stays good with
        four of eight electrodes open. With all of them open, every channel is capacitive: 1.
        With four terminals, where a bad contact does not show, it is the median.
        """
        judged = self.finite.any(axis=0) & ~self._reported_open
        if not judged.any():
            return 1.0
        share = 0.2 if self.senses_where_it_drives.any() else 0.5
        low = float(np.quantile(self.ratio[judged], share, method="lower"))
        capacitive = np.angle(self.value[judged], deg=True) < CAPACITIVE_DEG
        return 1.0 if low > OPEN and capacitive.mean() > 0.5 else low

    @cached_property
    def noise(self) -> Array:
        """Standard deviation of the white noise per quadrature, (measurements,) [ohm].

        Squared second differences of white noise follow an exponential distribution of mean
        12 sigma^2, with three quarters below 12 sigma^2 ln 4; steps and ramps do not change that.
        """
        filled = np.where(self.finite, self.impedance, self.value)
        curved = np.abs(np.diff(filled, n=2, axis=0))
        return np.asarray(np.quantile(curved, 0.75, axis=0) / np.sqrt(12.0 * np.log(4.0)))

    @cached_property
    def senses_where_it_drives(self) -> Bools:
        """Channels that sense at the pair that they drive, (measurements,)."""
        return np.array([row[:2] == row[2:] for row in self.protocol.table])

    def channels_with_status(self, bit: Status) -> Bools:
        """Channels with the status bit in more than a few frames, (measurements,)."""
        return np.asarray((self.status & np.uint8(bit) > 0).mean(axis=0) > MIN_FLAGGED)

    def with_electrode(self, electrode: int) -> Bools:
        """Channels that drive or sense at `electrode`, (measurements,)."""
        return np.asarray((np.array(self.protocol.table) == electrode).any(axis=1))


def checked_frames(frames: tuple[Frame, ...], expected: Array) -> CheckedFrames:
    """Checked frames of one protocol; raises the errors of `check_sensor`."""
    if not frames:
        raise FrameError("a sensor check needs at least one frame, 16 are good; got none")
    protocol = frames[0].protocol
    for frame in frames:
        protocol.require_same(
            frame.protocol, "the first frame has", "another has", "check one board at a time"
        )
    if expected.shape != (len(protocol),) or not (expected > 0.0).all():
        raise ConfigurationError(
            f"expected {len(protocol)} positive resistances, one for each measurement of the "
            f"frames, got shape {expected.shape}; take a model of this sensor and its protocol"
        )
    if not ((expected >= LEAST_READING) & (expected <= LARGEST_READING)).all():
        raise ConfigurationError(
            f"the expected resistances must be from {LEAST_READING:g} to {LARGEST_READING:g} ohm; "
            "take a model of this sensor"
        )
    impedance = readings(np.array([frame.impedance for frame in frames]))
    return CheckedFrames(
        protocol, impedance, np.array([frame.status for frame in frames]), expected
    )


def readings(values: Complex) -> Complex:
    """Values with NaN where they are immense or not finite, and zero where they are minute."""
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.abs(values)
    readable = np.where(size <= LARGEST_READING, values, np.nan)
    return np.where(size < LEAST_READING, 0.0, readable)


def electrodes_at_fault(wrong: Bools, protocol: Protocol) -> tuple[list[int], list[int]]:
    """Electrodes whose channels are all wrong, and the wrong channels of no such electrode."""
    table, unexplained = np.array(protocol.table), wrong.copy()
    electrodes = []
    for electrode in range(protocol.n_electrodes):
        at = (table == electrode).any(axis=1)
        if at.sum() > 1 and wrong[at].all():
            electrodes.append(electrode)
            unexplained &= ~at
    return electrodes, np.flatnonzero(unexplained).tolist()


class FindingKind(StrEnum):
    """Kinds of findings."""

    NOT_FINITE = "not finite"
    CLIPPED = "clipped"
    BOARD = "reported by the board"
    FROZEN = "frozen"
    STUCK = "stuck"
    NOISY = "noisy"
    MOVED = "moved"
    FAILED = "failed"
    OPEN = "open"
    SHORT = "short"
    FACTOR = "factor"
    PHASE = "phase"
    SWAPPED = "swapped"
    BAD_CONTACT = "bad contact"
    MISFIT = "misfit"
    NOT_FLAT = "not flat"
    DEAD = "dead"
    RECIPROCITY = "reciprocity"
    DRIVE_SWAP = "swapped drives"
    SENSE_SWAP = "swapped senses"
    LOOP = "loop sum"


@dataclass(frozen=True, slots=True)
class Finding:
    """One fault of a sensor.

    Attributes:
        what: kind of the finding.
        electrodes: numbers of the electrodes at fault; empty where unknown.
        channels: numbers of the measurements that show the fault.
        message: fault and remedy, in words.
    """

    what: FindingKind
    electrodes: tuple[int, ...]
    channels: tuple[int, ...]
    message: str


def finding(what: FindingKind, channels: Bools, message: str, *electrodes: int) -> Finding:
    """Finding of the channels in a mask."""
    return Finding(what, electrodes, tuple(np.flatnonzero(channels).tolist()), message)


def findings_by_electrode(
    what: FindingKind, wrong: Bools, checked: CheckedFrames, said: str, remedy: str
) -> Iterator[Finding]:
    """Findings of wrong channels, if any, by electrode where all channels of one are wrong."""
    if wrong.any() and wrong.all():
        yield finding(what, wrong, f"every channel {said}: {remedy}")
        return
    electrodes, channels = electrodes_at_fault(wrong, checked.protocol)
    for e in electrodes:
        at = checked.with_electrode(e)
        yield finding(what, at, f"every pair of electrode {e} {said}: {remedy}", e)
    for k in channels:
        yield Finding(what, (), (k,), f"channel {checked.protocol.labels[k]} {said}: {remedy}")


def channel_names(wrong: Bools, checked: CheckedFrames) -> str:
    """Wrong channels, in words."""
    labels = [checked.protocol.labels[k] for k in np.flatnonzero(wrong)]
    return "every channel" if wrong.all() else f"channel {', '.join(labels)}"


MAX_CHANGE = 0.003
"""Relative change of all values in common between quarters of the check that is a movement."""
MIN_TOUCH_CHANGE = 0.0003
"""The same next to the common change, rms over the channels."""
SIGNIFICANT = 6.0
"""Reduced chi-square of a change, and its ratio to the standard deviation, beyond noise."""
NOISY, NOISE = 4.0, 0.001
"""Noise of a noisy channel: in units of the median channel's noise, and relative to its value."""
NOISY_BOARD = 0.005
"""Noise of the median channel, relative to the rms of all, from which all values are noisy."""
MIN_FOR_NOISE = 8


def find_frozen(checked: CheckedFrames) -> Iterator[Finding]:
    """Findings of values that repeat to the last bit, which no measurement does."""
    same = np.diff(np.where(checked.finite, checked.impedance, 0.0), axis=0) == 0
    if len(same) < 2 or not checked.usable.any():
        return
    same[:, ~checked.usable] = True
    repeats = int(same.all(axis=1).sum())
    if repeats >= 2:
        text = (
            f"{repeats} of {len(same) + 1} frames repeat the one before: the board sends old "
            "values; restart it"
        )
        yield finding(FindingKind.FROZEN, np.ones(len(checked.expected), bool), text)
        return
    stuck = same.all(axis=0) & checked.usable & ~checked.open_circuits & ~checked.short_circuits
    remedy = "its value never changes, not even by noise: check its multiplexer path"
    yield from findings_by_electrode(FindingKind.STUCK, stuck, checked, "is stuck", remedy)


def unsteady(checked: CheckedFrames, channels: Bools) -> Iterator[Finding]:
    """Findings of noise and movement among the channels `channels`."""
    if len(checked.impedance) < MIN_FOR_NOISE or not channels.any():
        return
    value, noise = np.abs(checked.value), checked.noise
    relative = noise / np.maximum(value, SHORT * checked.expected)
    usual = float(np.median(noise[channels]))
    # White noise is that of the largest values, and far above many of those between neighbours.
    size = float(np.sqrt(np.mean(value[channels] ** 2)))
    if usual > NOISY_BOARD * size:
        text = (
            f"all values scatter by {100 * usual / size:.1f} % from frame to frame: check ground, "
            "shield and supply of the board, and that nothing moves"
        )
        yield finding(FindingKind.NOISY, channels, text)
    elif (noisy := channels & (noise > NOISY * usual) & (relative > NOISE)).any():
        yield from findings_by_electrode(
            FindingKind.NOISY, noisy, checked, "is noisy", "a loose wire or plug does this"
        )
        channels = channels & ~noisy
    yield from _find_drift(checked, channels, np.maximum(relative, np.median(relative[channels])))


def _find_drift(checked: CheckedFrames, rest: Bools, noise: Array) -> Iterator[Finding]:
    """Findings of relative changes beyond the noise between quarters of the check."""
    # In the units of `noise`: a value near zero, as between four terminals, is no unit of its own.
    size = np.abs(checked.value)
    unit = np.maximum(size, SHORT * checked.expected) / np.where(size == 0.0, 1.0, size)
    value = np.where(checked.value == 0.0, 1.0, checked.value) * unit
    values = (np.where(checked.finite, checked.impedance, value) / value)[:, rest]
    means = np.array([quarter.mean(axis=0) for quarter in np.array_split(values.real, 4)])
    changes = (means[:, None] - means[None]).reshape(16, -1)
    common = np.median(changes, axis=1)
    noise_std = np.maximum(noise[rest] * np.sqrt(2 * 4 / len(values)), np.finfo(float).eps)
    beside = changes - common[:, None]
    touched = np.sqrt((beside**2).mean(axis=1)) > MIN_TOUCH_CHANGE
    touched &= ((beside / noise_std) ** 2).mean(axis=1) > SIGNIFICANT
    if not touched.any() and np.abs(common).max() <= max(MAX_CHANGE, 3.0 * np.median(noise_std)):
        return
    largest = np.abs(changes).max(axis=0)
    moved = np.zeros_like(rest)
    moved[rest] = largest > np.maximum(MAX_CHANGE, SIGNIFICANT * noise_std)
    electrodes, others = electrodes_at_fault(moved, checked.protocol)
    text = f"values changed by up to {100 * float(largest.max()):.2g} % during the check: "
    if len(electrodes) == 1 and not others:
        (e,) = electrodes
        text += f"the contact of electrode {e} is loose, press its wire into the gel, check plug "
        yield finding(FindingKind.MOVED, moved, f"{text}{e}", e)
        return
    text += "lay the sensor flat, leave it untouched, let it settle, and check again"
    yield finding(FindingKind.MOVED, moved, text)
