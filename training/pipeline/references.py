"""References of a session: static (flat sensor) and dynamic (untouched sensor, same bend)."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.training.method.observations import relative_difference

Voltages = NDArray[np.complex128]

LONGEST_MEAN = 32  # frames; a longer mean would lag behind a drift too slow to count as motion


@dataclass
class RunningMean:
    """Mean of the frames since the sensor last moved.

    Attributes:
        noise: rms over the channels of the relative difference of two frames of a still sensor.
        mean: complex (measurements,), None before the first frame; NaN where never measured [ohm].
        count: number of frames in the mean.
        longest: number of frames beyond which the mean becomes exponential.
    """

    noise: float
    mean: Voltages | None = None
    count: int = 0
    longest: int = LONGEST_MEAN

    def restart(self, impedance: ArrayLike) -> None:
        """Begin a new mean with this frame (measurements,) [ohm]."""
        self.mean, self.count = np.array(impedance, dtype=np.complex128), 1

    def add(self, impedance: ArrayLike) -> bool:
        """Add one frame (measurements,) [ohm], NaN where a channel is bad.

        Returns whether the sensor moved, which restarts the mean. A still frame differs from the
        mean by at most `noise` rms; twice that counts as motion. With 28 channels, chance exceeds
        this limit less than once in a billion frames.
        """
        V = np.array(impedance, dtype=np.complex128)
        if self.mean is None:
            self.mean, self.count = V, 1
            return False
        known = np.isfinite(V) & np.isfinite(self.mean)
        change = relative_difference(V[known], self.mean[known])
        departed = bool(change.size and np.sqrt(np.mean(change**2)) > 2 * self.noise)
        self.count = 1 if departed else min(self.count + 1, self.longest)
        step = np.where(known, (V - self.mean) / self.count, 0)
        only_new = np.isfinite(V) & ~np.isfinite(self.mean)
        self.mean = np.where(only_new, V, self.mean + step)
        return departed


@dataclass
class References:
    """Both references of a session, renewed frame by frame.

    `bend` is static: the flat, untouched sensor, averaged while it is still at the session's start.
    `touch` is dynamic: it follows the sensor while nothing touches it, averaged while the sensor is
    still, and is frozen during a touch. Both begin with the stored reference where one is in use,
    and the static one stays that.

    Attributes:
        noise: rms relative difference of two frames of a still sensor.
        stored: stored reference (measurements,) [ohm], NaN where a channel was bad; None without.
        stored_frames: number of frames averaged into the stored reference.
    """

    noise: float
    stored: Voltages | None = None
    stored_frames: int = 0
    _opening: RunningMean = field(init=False)
    _latest: RunningMean = field(init=False)
    _is_opening: bool = field(init=False, default=True)

    def __post_init__(self) -> None:
        """Begin without references."""
        self.drop()

    def drop(self) -> None:
        """Forget both references but the stored one, for a new session."""
        self._opening, self._latest = self._first_mean(), self._first_mean()
        self._is_opening = self.stored is None

    def _first_mean(self) -> RunningMean:
        """Mean of the session's first frames, or of those of the stored reference."""
        if self.stored is None:
            return RunningMean(self.noise)
        return RunningMean(self.noise, self.stored.copy(), min(self.stored_frames, LONGEST_MEAN))

    @property
    def empty(self) -> bool:
        """Whether there is no reference yet."""
        return self._latest.mean is None

    @property
    def bend(self) -> Voltages:
        """Static reference (measurements,) [ohm], NaN where never measured; size 0 at first."""
        return np.zeros(0, np.complex128) if self._opening.mean is None else self._opening.mean

    @property
    def touch(self) -> Voltages:
        """Dynamic reference (measurements,) [ohm], NaN where never measured; size 0 at first."""
        return np.zeros(0, np.complex128) if self._latest.mean is None else self._latest.mean

    @property
    def bend_frames(self) -> int:
        """Number of frames averaged into the static reference."""
        return self._opening.count

    @property
    def touch_frames(self) -> int:
        """Number of frames averaged into the dynamic reference."""
        return self._latest.count

    def follow(self, impedance: ArrayLike) -> None:
        """Renew the references by a frame of the untouched sensor, NaN where a channel is bad."""
        if self._latest.add(impedance):
            self._is_opening = False
        if self._is_opening:
            self._opening.add(impedance)

    def freeze(self) -> None:
        """Keep both references as they are during a touch; the static one is final thereafter."""
        self._is_opening = False
