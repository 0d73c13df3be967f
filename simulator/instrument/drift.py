"""Slow drift: a random walk as a function of time, reproducible from its seed."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DRIFT_TIME = 4 * 3600.0
"""Time after which drifts are specified [s]: 4 hours."""

STEP = 10.0
"""Time between steps of the walk [s]; 0.2 % in 4 h is 0.005 % per step, a quarter of the noise."""


@dataclass(frozen=True, slots=True)
class RandomWalk:
    """Random walk from 0 at time 0, with a standard deviation that grows as sqrt(t).

    Steps are normal, every 10 s, with linear interpolation between.

    Attributes:
        deviation: standard deviation after 4 h.
        seed: of the steps; the same seed gives the same walk.
    """

    deviation: float
    seed: int

    def __call__(self, times: Array) -> Array:
        """Values of the walk at `times` [s], which are not negative; of the shape of `times`."""
        count = int(np.ceil(np.max(times, initial=0.0) / STEP))
        values = self.deviation * np.sqrt(STEP / DRIFT_TIME) * _walk(self.seed, count.bit_length())
        walk: Array = np.interp(times, STEP * np.arange(len(values)), values)
        return walk


# A board that runs for days evaluates its drift in every frame.
@lru_cache(maxsize=4)
def _walk(seed: int, doublings: int) -> Array:
    """Walk of 2^doublings unit steps from 0; a longer walk begins with the shorter ones."""
    steps = np.random.default_rng(seed).standard_normal(2**doublings)
    walk = np.concatenate(([0.0], np.cumsum(steps)))
    walk.flags.writeable = False
    return walk
