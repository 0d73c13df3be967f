"""Channels that a frame lacks, filled in from those that it has."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True, eq=False)
class MissingChannels:
    """The most probable dV of bad channels, given the good ones.

    "No signal" would be the simplest guess, and a wrong one: on a bent sensor, channels that
    stay at zero among others that have all changed look like a touch.

    Attributes:
        covariance: of dV, taken as normally distributed around zero, (C, C).
    """

    covariance: NDArray[np.float64]

    @classmethod
    def fit(cls, difference: ArrayLike, noise: float) -> "MissingChannels":
        """Learn from dV (n, C), those without bad channels; `noise` is what they hold, rms."""
        dV = np.asarray(difference, dtype=float)
        dV = dV[np.isfinite(dV).all(axis=1)]
        floor = max(noise, 1e-9) ** 2  # keeps the good channels' covariance invertible
        return cls(dV.T @ dV / max(len(dV), 1) + floor * np.eye(dV.shape[1]))

    def fill(self, difference: ArrayLike) -> NDArray[np.float64]:
        """dV (n, C), values that are not finite replaced: E[bad | good] = C_bg C_gg^-1 good."""
        dV = np.array(difference, dtype=float)
        gaps = ~np.isfinite(dV)
        for pattern in np.unique(gaps[gaps.any(axis=1)], axis=0):
            rows = (gaps == pattern).all(axis=1)
            good = ~pattern
            weights = np.linalg.solve(self.covariance[np.ix_(good, good)], dV[rows][:, good].T)
            dV[np.ix_(rows, pattern)] = (self.covariance[np.ix_(pattern, good)] @ weights).T
        return dV
