"""Frames of a touch that stands still, distinguished from a moving one by the session's noise."""

import math
from collections import deque
from dataclasses import dataclass, field
from statistics import median

import numpy as np
from numpy.typing import NDArray

from eitskin.training.method.observations import relative_difference
from eitskin.training.pipeline.references import Voltages

MAX_HELD_FRAMES = 8  # frames of an unchanged touch in the mean; more would lag behind its creep
ONSET = 4.0  # standard deviations of the mean square that show a change since earlier frames
PHASES, LEAST_PHASE = 3.0, 1e-3  # times the rms change from frame to frame; [rad]
SPEED, MOVING = 0.008, 0.3  # m a frame, of touches that move, and their share before they are seen
NOISE_FRAMES = 33  # latest frames whose median scatter is the noise
MIN_SCATTERS = 2  # frames that the noise of training counts as
LOUDEST = 3.0  # times the noise of training, that a still sensor may have before frames show
MIN_WEIGHT, MAX_WEIGHT = 1 / 16, 4.0
"""Of a frame, in frames with the noise of training; beyond the largest the model's errors grow."""
WEIGHTS = 4  # steps of weights in a factor of two, so that what follows from one stays known
JUMPS = 5.0  # times the noise of training; what scatters more has jumped
MOTION = 5.0  # standard deviations of the mean square that distinguish motion from noise
TOUCH_MOTION = 3.1  # the same of slopes in the directions that the touches found would move


@dataclass
class Phases:
    """Phases of the channels over a session, which no touch and no bend changes apart.

    Relative changes by geometry are real, those by a capacitance are not.
    """

    _last: Voltages = field(default_factory=lambda: np.zeros(0, np.complex128))
    _scatter: deque[float] = field(default_factory=lambda: deque(maxlen=NOISE_FRAMES))

    def phase_change(self, V: Voltages, flat: Voltages) -> NDArray[np.float64] | None:
        """Change of the phases (measurements,) [rad] but for a common one; None if by noise."""
        departure = np.full(len(V), np.nan)
        good = np.isfinite(V) & np.isfinite(flat) & (flat != 0.0)
        departure[good] = np.imag(V[good] / flat[good])
        departure -= np.median(departure[good]) if good.any() else 0.0
        last, self._last = self._last, V
        if last.size == V.size:
            with np.errstate(invalid="ignore", divide="ignore"):
                step = np.imag(V / last)
            known = step[np.isfinite(step)]
            if len(known):
                self._scatter.append(float(np.var(known)))
        if len(self._scatter) <= MIN_SCATTERS:
            return None
        limit = max(LEAST_PHASE, PHASES * math.sqrt(median(self._scatter)))
        return departure if math.sqrt(np.nanmean(departure**2)) > limit else None


@dataclass
class HeldTouch:
    """The latest frames of a touch: as many as show it where it is now.

    Windows of the latest frames are tested for motion, from two frames on: over a window of n
    frames the slopes of the channels have the variance 12 s^2 / (n^3 - n) where nothing moves. They
    are tested by their mean square, and, which is far keener, by the part of them in the directions
    in which the touches found last would change the channels. The mean of frames is taken over the
    longest window without motion, and, once a touch has moved, only over windows in which that
    motion would show again; else the latest frame stands for itself. So a touch that slides or
    eases is not dragged behind.

    Attributes:
        noise: rms relative difference of two frames of a still sensor, until frames show.
        scale: scale of the noise that the method weighs frames by.
        directions: directions of changes (d, measurements) by a motion of the touches found last.
        variance: variance of a channel's relative change in one frame, the median over the latest.
    """

    noise: float
    scale: float = 1.0
    directions: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    variance: float = field(init=False)
    _frames: deque[Voltages] = field(default_factory=lambda: deque(maxlen=MAX_HELD_FRAMES))
    _changes: deque[NDArray[np.float64]] = field(
        default_factory=lambda: deque(maxlen=MAX_HELD_FRAMES)
    )
    _scatter: deque[float] = field(default_factory=lambda: deque(maxlen=NOISE_FRAMES))
    _speed: float = 0.0  # of the latest motion: its statistic over its limit and over weight

    def add(
        self, V: Voltages, flat: Voltages, held: bool, most: int = MAX_HELD_FRAMES
    ) -> tuple[Voltages, int]:
        """Mean of the frames that show the touch of frame V, and their number.

        Args:
            V: frame (measurements,) [ohm], NaN where a channel is bad.
            flat: reference (measurements,) [ohm] that changes are relative to.
            held: whether the frame before it was touched; else V stands for itself.
            most: frames to be averaged.
        """
        change = relative_difference(V, flat)
        if len(self._changes) >= 2:  # neither offset nor slope is left in this difference
            bent = self._changes[-1] - 0.5 * (self._changes[-2] + change)
            finite_angles = bent[np.isfinite(bent)]
            scatter = float(finite_angles @ finite_angles) / (1.5 * max(len(finite_angles), 1))
            if 0.0 < scatter < (JUMPS * self.noise) ** 2:
                self._scatter.append(scatter)
                expected = [0.5 * self.noise**2] * MIN_SCATTERS
                self.variance = median([*self._scatter, *expected])
        self._changes.append(change)
        if not held:
            self.set_frames([])
        self._frames.append(V)
        count = min(self._still(), most)
        mean: Voltages = np.mean(list(self._frames)[-count:], axis=0)
        return np.where(np.isfinite(mean) | ~np.isfinite(V), mean, V), count

    def set_frames(self, frames: list[Voltages]) -> None:
        """Take these for the latest frames of the touch; none before a touch."""
        self._frames.clear()
        self._frames.extend(frames)
        self._speed = 0.0

    def shows(self, mean: Voltages, count: int, before: Voltages, earlier: int) -> float:
        """How clearly a mean of frames differs from one of earlier frames, over what is usual."""
        change = relative_difference(mean, before)
        known = change[np.isfinite(change)]
        if not len(known):
            return 0.0
        variance = self.variance * (1.0 / count + 1.0 / earlier)
        square = float(known @ known) / (len(known) * variance)
        return (square - 1.0) / (ONSET * self._deviation(len(known)))

    @staticmethod
    def lag(deviation: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        """Variance (k,) [m2] of places by motion that a mean of frames does not show.

        A slope over n frames has 12 / (n^3 - n) times the variance of one frame, and the mean lags
        by (n - 1) / 2 of it. Touches stand still or move at any speed up to some.

        Args:
            deviation: standard errors of the places in the mean (k,) [m].
            count: number n of frames.
        """
        if count < 2:
            return np.zeros_like(deviation)
        slope = deviation * math.sqrt(12.0 / (count**2 - 1.0))
        seen = (1.0 - MOVING) * SPEED / slope
        share = MOVING / (MOVING + seen)
        return np.asarray(share * (0.5 * (count - 1) * np.minimum(slope, SPEED)) ** 2)

    @property
    def latest(self) -> list[Voltages]:
        """Latest frames of the touch, in their order."""
        return list(self._frames)

    @property
    def weight(self) -> float:
        """Frames with the noise that the method expects that a frame of this session is worth."""
        quiet = 0.5 * (self.scale * self.noise) ** 2 / self.variance
        quiet = math.exp2(round(WEIGHTS * math.log2(quiet)) / WEIGHTS)
        return min(max(quiet, MIN_WEIGHT), MAX_WEIGHT)

    @property
    def still(self) -> float:
        """Rms relative difference of two frames of a still sensor in this session, at most."""
        has_scatter = len(self._scatter) > MIN_SCATTERS
        return math.sqrt(2.0 * self.variance) if has_scatter else LOUDEST * self.noise

    def __post_init__(self) -> None:
        """No frame so far."""
        self.variance = 0.5 * self.noise**2

    def _deviation(self, channels: int) -> float:
        """Relative deviation of the mean square over channels, larger where these share noise."""
        alone = float(np.sqrt(2.0 / channels))
        if len(self._scatter) < 10:
            return alone
        return max(1.5 * median(abs(s / self.variance - 1.0) for s in self._scatter), alone)

    def _still(self) -> int:
        """Number of the latest frames over which the touch stands still."""
        rows = np.array(self._changes)[-len(self._frames) :]
        count, good = 1, np.isfinite(rows).all(axis=0)
        if len(rows) < 2 or not good.any():
            return 1
        rows, along, deviation = rows[:, good], self.directions, self._deviation(int(good.sum()))
        if len(along):
            along = np.linalg.qr(np.vstack([along[:, good], rows.mean(axis=0)]).T)[0]
        for n in range(2, len(rows) + 1):
            weight = n * (n * n - 1) / 12.0  # sum of squared times
            slope = (np.arange(n) - 0.5 * (n - 1)) @ rows[-n:]
            slope /= math.sqrt(weight * self.variance)
            shown = float(slope @ slope) / len(slope)
            ratio = shown / (1.0 + MOTION * deviation)
            if len(along):
                share, size = slope @ along, along.shape[1]
                most = size + TOUCH_MOTION * math.sqrt(2.0 * size) + 5.0
                ratio = max(ratio, float(share @ share) / most)
            if ratio > 1.0:
                self._speed = ratio / weight
                break
            if self._speed * weight > 2.0 or not self._speed:
                count = n
        else:
            if len(rows) == MAX_HELD_FRAMES:
                self._speed = 0.0
        return count
