"""What a frame is compared with: the flat sensor, and the sensor as it was before a touch."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.training.method.observations import relative_difference

Voltages = NDArray[np.complex128]

LONGEST_MEAN = 32  # frames; longer would lag behind a drift too slow to be seen as a departure


@dataclass
class RunningMean:
    """Mean of the frames since the sensor last moved.

    Attributes:
        noise: rms over the channels of the relative difference of two frames of a still sensor.
        mean: complex (measurements,), None before the first frame; NaN where never measured [ohm].
        count: frames in the mean.
        longest: number of frames from which on the oldest are forgotten.
    """

    noise: float
    mean: Voltages | None = None
    count: int = 0
    longest: int = LONGEST_MEAN

    def restart(self, impedance: ArrayLike) -> None:
        """Forget all but this frame."""
        self.mean, self.count = np.array(impedance, dtype=np.complex128), 1

    def add(self, impedance: ArrayLike) -> bool:
        """Take one frame, NaN where a channel is bad; True if it departed and restarted the mean.

        A still frame differs from the mean by at most `noise` rms; twice that is a departure.
        With 28 channels, chance exceeds it less than once in a billion frames.
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
    """The two references of a session; the state of the pipeline between frames.

    `bend` is static: the flat, untouched sensor, averaged over the stillness with which the
    session opens. `touch` is dynamic: it follows the sensor while nothing touches it, averaging
    while it is still, and stays frozen while something does.

    Attributes:
        noise: see RunningMean.
    """

    noise: float
    _opening: RunningMean = field(init=False)
    _latest: RunningMean = field(init=False)
    _is_opening: bool = field(init=False, default=True)

    def __post_init__(self) -> None:
        """Begin without references."""
        self.drop()

    def drop(self) -> None:
        """Forget both: a new session has begun."""
        self._opening, self._latest = RunningMean(self.noise), RunningMean(self.noise)
        self._is_opening = True

    @property
    def empty(self) -> bool:
        """Whether no frame has come yet."""
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
        """How many frames the static reference is the mean of."""
        return self._opening.count

    @property
    def touch_frames(self) -> int:
        """How many frames the dynamic reference is the mean of."""
        return self._latest.count

    def follow(self, impedance: ArrayLike) -> None:
        """Take the frame of an untouched sensor, NaN where a channel is bad."""
        if self._latest.add(impedance):
            self._is_opening = False
        if self._is_opening:
            self._opening.add(impedance)

    def freeze(self) -> None:
        """A touch has come: the dynamic reference stays, the opening stillness is over."""
        self._is_opening = False
