"""Frames of a touch that stands still, by the session's noise, and touches of earlier frames."""

import math
from collections import deque
from dataclasses import dataclass, field
from functools import lru_cache
from statistics import median

import numpy as np
from numpy.typing import NDArray

from eitskin.training.method.observations import relative_difference
from eitskin.training.pipeline.references import Voltages

MAX_HELD_FRAMES = 8  # frames of an unchanged touch in the mean; more would lag behind its creep
ONSET = 2.5  # standard deviations of the mean square that show a change since earlier frames
PHASES, LEAST_PHASE = 3.0, 1e-3  # times the rms change from frame to frame; [rad]
SPEEDS, MOVING = np.array([0.003, 0.012]), 0.2  # m a frame, of touches that move; least share
FORCE_LENGTH = 0.015  # m, of a motion that matters as much as a force that becomes zero
EXTENT = 0.03  # m, standard deviation of a place that no frame shows
NOISE_FRAMES = 33  # latest frames whose median scatter is the noise
MIN_SCATTERS = 2  # frames that the noise of training counts as
LOUDEST = 3.0  # times the noise of training, that a still sensor may have before frames show
MIN_WEIGHT, MAX_WEIGHT = 1 / 16, 4.0
"""Of a frame, in frames with the noise of training; beyond the largest the model's errors grow."""
WEIGHTS = 4  # steps of weights in a factor of two, so that what follows from one stays known
JUMPS = 5.0  # times the noise of training; what scatters more has jumped
RISE = 3.0  # times the variance of untouched frames; more may be the touches of others
MOTION = 5.0  # standard deviations of the mean square that distinguish motion from noise
LINGERING, MOST_REST = 4.0, 2.0
"""Twice the log odds against a touch that was there, from which it has gone, and the most that it
may leave unexplained, in variances."""
EXPLAINED = 0.5
"""Most that may be left besides noise where the sensor has bent since, over what the touch
explains: bends are known roughly."""
SHOWN, LEAST_SHARE = 2.5, 0.2
"""Standard errors of its share, and the least one, from which a touch that is weaker than it was
has not gone."""
LEAST_BEND = 25.0  # square of a change by a bend that may hide touches, in variances


@dataclass
class Phases:
    """Phases of the channels over a session, which no touch and no bend changes apart.

    Relative changes by geometry are real, those by a capacitance are not.
    """

    _last: Voltages = field(default_factory=lambda: np.zeros(0, np.complex128))
    _scatter: deque[float] = field(default_factory=lambda: deque(maxlen=NOISE_FRAMES))

    def phase_change(self, V: Voltages, flat: Voltages) -> NDArray[np.float64]:
        """Change of the phases (measurements,) [rad] but for a common one; (0,) if by noise."""
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
            return np.zeros(0)
        limit = max(LEAST_PHASE, PHASES * math.sqrt(median(self._scatter)))
        return departure if math.sqrt(np.nanmean(departure**2)) > limit else np.zeros(0)


@dataclass
class HeldTouch:
    """The latest frames of a touch: as many as show it where it is now.

    Windows of the latest frames are tested for motion by the mean square of the channels' slopes,
    which over n frames have the variance 12 s^2 / (n^3 - n) where nothing moves. Where it is known
    how the touches found last would change the channels, motion is weighed by its evidence: in
    every window the touches stand still or have moved evenly since one of its frames. The mean is
    taken over the window in which its noise and the lag behind such motion are least together.

    Attributes:
        noise: rms relative difference of two frames of a still sensor, until frames show.
        scale: scale of the noise that the method weighs frames by.
        directions: changes (3 k, measurements) by a motion of each of k touches found last along x
            [1/m], by one along y, and by their forces as they are.
        lag: variance (k,) [m2] of their places by a motion that the mean of frames hides.
        variance: variance of a channel's relative change in one frame, the median over the latest.
    """

    noise: float
    scale: float = 1.0
    directions: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    _frames: deque[Voltages] = field(default_factory=lambda: deque(maxlen=MAX_HELD_FRAMES))
    _changes: deque[NDArray[np.float64]] = field(
        default_factory=lambda: deque(maxlen=MAX_HELD_FRAMES)
    )
    _scatter: deque[float] = field(default_factory=lambda: deque(maxlen=NOISE_FRAMES))
    _latest: float = -1.0  # scatter of the latest three frames; -1 where it is taken
    _touched: deque[bool] = field(default_factory=lambda: deque(maxlen=3))
    _explained: deque[bool] = field(default_factory=lambda: deque(maxlen=2))  # by their touches
    _speed: float = 0.0  # of the latest motion: its statistic over its limit and over weight
    _moving: float = MOVING  # probability of motion in the latest frames

    def __post_init__(self) -> None:
        """No frame so far."""
        self.variance = 0.5 * self.noise**2
        self._untouched: float = self.variance  # when a frame was untouched last
        self.lag = np.zeros(0)

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
            self._latest = float(finite_angles @ finite_angles) / (1.5 * max(len(finite_angles), 1))
            noise_like = self._latest < (JUMPS * self.noise) ** 2 and not any(self._explained)
            if not self.is_noise_known and noise_like:
                self._take_scatter()
        self._changes.append(change)
        if not held:
            self.set_frames([])
        self._frames.append(V)
        count = self._least_error(min(self._still(), most))
        mean: Voltages = np.mean(list(self._frames)[-count:], axis=0)
        return np.where(np.isfinite(mean) | ~np.isfinite(V), mean, V), count

    def settle(self, touched: bool, explained: bool) -> None:
        """Take the latest frame for touched or not; the noise is that of three alike.

        Touches that come and go, or jump, scatter as well. Before the noise is known, only touches
        that explain their frame are distinguished from it.
        """
        self._touched.append(touched)
        self._explained.append(touched and explained)
        most = RISE * self._untouched if touched else (JUMPS * self.noise) ** 2
        if self.is_noise_known and len(set(self._touched)) == 1 and self._latest < most:
            self._take_scatter()
        if not touched:
            self._untouched = self.variance

    def _take_scatter(self) -> None:
        """Take the scatter of the latest frames for noise; equal ones show nothing."""
        if self._latest >= 0.0:
            self._scatter.append(self._latest or 0.5 * self.noise**2)
            self._latest, expected = -1.0, [0.5 * self.noise**2] * MIN_SCATTERS
            self.variance = median([*self._scatter, *expected])

    def set_frames(self, frames: list[Voltages]) -> None:
        """Take these for the latest frames of the touch; none before a touch."""
        self._frames.clear()
        self._frames.extend(frames)
        self._speed, self._moving = 0.0, MOVING

    def shows(
        self,
        means: Voltages,
        counts: NDArray[np.intp],
        before: Voltages,
        earlier: NDArray[np.intp],
    ) -> NDArray[np.float64]:
        """How clearly means of frames differ from those of earlier ones, over what is usual (n,).

        Means (n, measurements) [ohm] of as many frames as `counts` and `earlier` (n,) say.
        """
        change = relative_difference(means, before)
        known = np.isfinite(change)
        channels = np.maximum(np.count_nonzero(known, axis=1), 1)
        square = np.sum(np.where(known, change, 0.0) ** 2, axis=1) / channels
        excess = square / (self.variance * (1.0 / counts + 1.0 / earlier)) - 1.0
        return np.where(known.any(axis=1), excess / (ONSET * self._deviation(channels)), 0.0)

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
    def is_noise_known(self) -> bool:
        """Whether enough frames have shown the noise of this session."""
        return len(self._scatter) > MIN_SCATTERS

    @property
    def still(self) -> float:
        """Rms relative difference of two frames of a still sensor in this session, at most."""
        return math.sqrt(2.0 * self.variance) if self.is_noise_known else LOUDEST * self.noise

    def _deviation(self, channels: NDArray[np.intp]) -> NDArray[np.float64]:
        """Relative deviation of the mean square over channels, larger where these share noise."""
        alone: NDArray[np.float64] = np.sqrt(2.0 / channels)
        if len(self._scatter) < 10:
            return alone
        return np.maximum(1.5 * median(abs(s / self.variance - 1.0) for s in self._scatter), alone)

    def _still(self) -> int:
        """Number of the latest frames whose channels show no motion."""
        rows = np.array(self._changes)[-len(self._frames) :]
        count, good = 1, np.isfinite(rows).all(axis=0)
        if len(rows) < 2 or not good.any():
            return 1
        rows, deviation = rows[:, good], float(self._deviation(good.sum()))
        for n in range(2, len(rows) + 1):
            weight = n * (n * n - 1) / 12.0  # sum of squared times
            slope = (np.arange(n) - 0.5 * (n - 1)) @ rows[-n:]
            shown = float(slope @ slope) / (len(slope) * weight * self.variance)
            ratio = shown / (1.0 + MOTION * deviation)
            if ratio > 1.0:
                self._speed = ratio / weight
                break
            if self._speed * weight > 2.0 or not self._speed:
                count = n
        else:
            if len(rows) == MAX_HELD_FRAMES:
                self._speed = 0.0
        return count

    def _least_error(self, most: int) -> int:
        """Number of frames, up to some, whose mean has the least error; sets `lag`.

        One touch moves, or its force changes, normal with each of `SPEEDS` before it is seen.
        """
        touches, rows = len(self.directions) // 3, np.array(self._changes)[-most:]
        self.lag = np.zeros(touches)
        good = np.isfinite(rows).all(axis=0)
        if not touches or len(rows) < 2 or not good.any():
            return len(rows)
        units = np.repeat([1.0, 1.0, 1.0 / FORCE_LENGTH], touches)
        along = self.directions[:, good] * units[:, None]
        information, seen = along @ along.T / self.variance, rows[:, good] @ along.T / self.variance
        frames, profiles = _motions(len(rows))
        projected = (profiles @ seen).reshape(-1, 3, touches).transpose(2, 0, 1)
        weight, each = np.einsum("pn,pn->p", profiles, profiles), range(touches)
        own = information.reshape(3, touches, 3, touches)[:, each, :, each]
        own[:, 2, :2] = own[:, :2, 2] = 0.0
        sizes, axes = np.linalg.eigh(own)
        # Each touch moves (two of its three axes), or its force changes (the third).
        parts = np.stack([1.0 - axes[:, 2] ** 2, axes[:, 2] ** 2], axis=1)
        given = weight[:, None] * sizes[:, None] + (SPEEDS**-2.0)[:, None, None, None]
        mean = (projected @ axes) / given
        chance = mean**2 * given - np.log(given * (SPEEDS**2)[:, None, None, None])
        evidence, lags = (
            np.einsum("stpa,tga->stgp", values, parts)
            for values in (0.5 * chance, mean**2 + 1.0 / given)
        )
        shares = np.exp(np.minimum(evidence, 100.0)) * self._moving / (1.0 - self._moving)
        shares /= 2 * len(SPEEDS) * touches * (frames - 1)
        lags *= shares * profiles[:, -1] ** 2
        # Windows of one frame, two, and so on.
        starts = np.flatnonzero(np.diff(frames, prepend=0))
        totals = 1.0 + np.add.reduceat(shares.sum(axis=(0, 1, 2)), starts)
        lag = np.add.reduceat(lags.sum(axis=0), starts, axis=2) / totals
        lag = np.concatenate([np.zeros((touches, 2, 1)), lag], axis=2)
        error = np.trace(np.linalg.inv(information + np.eye(3 * touches) / EXTENT**2))
        best = int(np.argmin(error / np.arange(1, len(rows) + 1) + lag.sum(axis=(0, 1))))
        self.lag = lag[:, 0, best]
        self._moving = min(max(1.0 - 1.0 / float(totals[-1]), MOVING), 1.0 - MOVING)
        return best + 1


@lru_cache
def _motions(most: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Motions that begin at a frame of a window, and go on by one a frame.

    Returns the frames n of the window (p,), 2 to `most`, and the motion less its mean (p, `most`),
    zero before the window.
    """
    frames, since = np.array([(n, m) for n in range(2, most + 1) for m in range(1, n)]).T[..., None]
    time = np.arange(1 - most, 1)
    motion = np.maximum(time + since, 0.0)
    motion -= motion.sum(axis=1, keepdims=True) / frames
    return frames[:, 0], np.where(time > -frames, motion, 0.0)


@dataclass
class EarlierTouches:
    """Touches of the latest touched frame.

    Attributes:
        hidden: whether they are there in the latest frame, though a bend hides them.
        undecided: latest frames of a bent sensor that do not settle whether they are there.
    """

    hidden: bool = False
    undecided: int = 0
    _forces: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    _bends: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    _anchor: Voltages = field(default_factory=lambda: np.zeros(0, np.complex128))
    _odds: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def renew(self, voltages: Voltages, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take the k touches of a frame (measurements,) [ohm], by `Method.motions`.

        Returns the directions (3 k, measurements) without those of bends.
        """
        motions, self._bends = np.split(directions, [3 * (len(directions) // 3)])
        self._forces, self._anchor = motions[2 * len(motions) // 3 :], voltages
        self._odds, self.hidden, self.undecided = np.zeros(len(self._forces)), False, 0
        return motions

    def linger(self, voltages: Voltages, reference: Voltages, variance: float) -> bool:
        """Whether one may touch yet in an untouched frame, as far as noise of a variance shows.

        The frame and its dynamic reference are (measurements,) [ohm].
        """
        if self.hidden or self.undecided:
            return True
        if not len(self._forces):
            return False
        change = relative_difference(voltages, reference)
        good = np.isfinite(change)
        share, size, rest = self._weigh(change[good], self._forces[:, good])
        noise = np.count_nonzero(good) * variance
        most = np.full(len(share), MOST_REST * noise)
        if len(self._bends) and np.all(rest >= most):
            # Directions that bends change as well are no evidence of a touch.
            _, left, forces = self._without_bends(change, good)
            share, size, rest = self._weigh(left, forces)
            most = np.maximum(most, noise + EXPLAINED * share**2 * size)
        self._odds = np.minimum(self._odds + (2.0 * share - 1.0) * size / variance, 0.0)
        least_share = np.maximum(SHOWN * np.sqrt(variance / size), LEAST_SHARE)
        lingers = (self._odds > -LINGERING) | (share > least_share)
        lingers &= rest < most
        self._forces, self._odds = self._forces[lingers], self._odds[lingers]
        return bool(lingers.any())

    def _without_bends(
        self, change: NDArray[np.float64], good: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Bends (b,) in a change (C,), and what they leave of it and of the touches (k, C)."""
        both, bends = np.vstack([change[good], self._forces[:, good]]), self._bends[:, good]
        shares = np.linalg.lstsq(bends.T, both.T)[0].T
        both -= shares @ bends
        return shares[0], both[0], both[1:]

    @staticmethod
    def _weigh(
        change: NDArray[np.float64], along: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Share of each of k touches (k, C) in a change (C,), their squares, and the rest's."""
        size = np.einsum("kc,kc->k", along, along)
        share = along @ change / size
        return share, size, np.sum((change - share[:, None] * along) ** 2, axis=1)

    def bent_reference(
        self, voltages: Voltages, touched: bool, variance: float | None
    ) -> Voltages | None:
        """The sensor without them (measurements,) [ohm], as bent as in a frame that hides them.

        The change since the latest frame that had them decides, whatever the bend curve is: a bend
        makes it, and none of the touches. None where it does not, which may leave it undecided.

        Args:
            voltages: voltages of the frame.
            touched: whether the frame before was touched.
            variance: variance of a channel's relative change in one frame; None if unknown.
        """
        held, waited = touched or self.hidden or self.undecided > 0, self.undecided
        self.hidden, self.undecided = False, 0
        if not (held and len(self._bends)) or variance is None:
            return None
        change, variance = relative_difference(voltages, self._anchor), 2.0 * variance
        good = np.isfinite(change)
        turns, rest, along = self._without_bends(change, good)
        bent = turns @ self._bends[:, good]
        # Twice the log odds, in variances.
        stays = np.einsum("kc,kc->k", along, along) + 2.0 * along @ rest
        if bent @ bent < LEAST_BEND * variance:
            return None
        if rest @ rest > MOST_REST * len(rest) * variance or np.any(stays < LINGERING * variance):
            if waited < MAX_HELD_FRAMES and np.any(stays > -LINGERING * variance):
                self.undecided = waited + 1
            return None
        released = self._anchor * (1.0 - self._forces.sum(axis=0))
        self.hidden, self._anchor = True, voltages
        reference: Voltages = released * (1.0 + turns @ self._bends)
        return reference
