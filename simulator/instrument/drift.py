"""Slow drift: a random walk that is a function of time, however often it is asked for."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HOURS = 4 * 3600.0
"""After which a drift is stated [s]."""

STEP = 10.0
"""Between the walk's steps [s]; 0.2 % in 4 h is 0.005 % in this time, a quarter of the noise."""


@dataclass(frozen=True, slots=True)
class RandomWalk:
    """Normal steps every 10 s from 0 at time 0, straight between them: the sd grows as sqrt(t).

    Attributes:
        deviation: sd after 4 h.
        seed: of the steps. The same seed gives the same walk at all times asked for.
    """

    deviation: float
    seed: int

    def __call__(self, times: Array) -> Array:
        """Where the walk is at `times` [s], none of which is negative."""
        count = int(np.ceil(np.max(times, initial=0.0) / STEP))
        places = self.deviation * np.sqrt(STEP / HOURS) * _walk(self.seed, count.bit_length())
        walk: Array = np.interp(times, STEP * np.arange(len(places)), places)
        return walk


# A board that runs for days asks for its drift in every frame.
@lru_cache(maxsize=4)
def _walk(seed: int, doublings: int) -> Array:
    """The walk of unit steps from 0, at least 2^doublings - 1 of them; all begin alike."""
    steps = np.random.default_rng(seed).standard_normal(2**doublings)
    walk = np.concatenate(([0.0], np.cumsum(steps)))
    walk.flags.writeable = False
    return walk
