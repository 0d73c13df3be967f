"""Frames of a sensor check: statistics of each channel, and the electrodes at fault."""

import dataclasses
from dataclasses import dataclass
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
FLAGGED = 0.1
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
        clipped = self.flagged(Status.CLIPPED) & ~self.shorted
        return np.asarray(self.finite.any(axis=0) & ~clipped)

    @cached_property
    def shorted(self) -> Bools:
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
    def opened(self) -> Bools:
        """Channels without a current, (measurements,)."""
        # Small values between neighbours change manifold with the places of electrodes.
        least = SHORT * float(np.sqrt(np.mean(self.expected**2)))
        floor = np.where(self.senses_where_it_drives, self.expected, least)
        times = np.abs(self.value) / np.maximum(self.expected, floor)
        times /= max(self._scale, np.finfo(float).tiny)
        large = (times > INSULATED) | ((times > OPEN) & self._capacitive)
        return np.asarray(self._reported_open | (self.usable & large))

    @cached_property
    def _capacitive(self) -> Bools:
        return np.asarray(np.angle(self.value, deg=True) < CAPACITIVE_DEG)

    @cached_property
    def _reported_open(self) -> Bools:
        return self.flagged(Status.OPEN) | self.flagged(Status.LOW_CURRENT)

    @cached_property
    def _scale(self) -> float:
        """Ratio of good channels to their expected values.

        The lowest fifth of the ratios tells a wrong scale from bad contacts: it stays good with
        four of eight electrodes open. With all of them open, every channel is capacitive: 1.
        With four terminals, where a bad contact does not show, it is the median.
        """
        judged = self.finite.any(axis=0) & ~self._reported_open
        if not judged.any():
            return 1.0
        share = 0.2 if self.senses_where_it_drives.any() else 0.5
        low = float(np.quantile(self.ratio[judged], share, method="lower"))
        return 1.0 if low > OPEN and self._capacitive[judged].mean() > 0.5 else low

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

    def magnitudes(self, used: Bools) -> tuple[Array, Array, Bools, Protocol]:
        """Arguments of `fit_contacts` for the channels `used`."""
        return np.abs(self.value), self.expected, used, self.protocol

    def divided_by(self, scale: float) -> "CheckedFrames":
        """The same frames with impedances divided by `scale`."""
        return dataclasses.replace(self, impedance=self.impedance / scale)

    def flagged(self, bit: Status) -> Bools:
        """Channels with the status bit in more than a few frames, (measurements,)."""
        return np.asarray((self.status & np.uint8(bit) > 0).mean(axis=0) > FLAGGED)

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
    made = np.where(size <= LARGEST_READING, values, np.nan)
    return np.where(size < LEAST_READING, 0.0, made)


def electrodes_at_fault(wrong: Bools, protocol: Protocol) -> tuple[list[int], list[int]]:
    """Electrodes whose channels are all wrong, and the wrong channels of no such electrode."""
    table, left = np.array(protocol.table), wrong.copy()
    electrodes = []
    for electrode in range(protocol.n_electrodes):
        at = (table == electrode).any(axis=1)
        if at.sum() > 1 and wrong[at].all():
            electrodes.append(electrode)
            left &= ~at
    return electrodes, np.flatnonzero(left).tolist()
