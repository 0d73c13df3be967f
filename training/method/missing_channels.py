"""Conditional mean of the bad channels of a frame, given its good ones."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True, eq=False)
class MissingChannels:
    """Imputation of bad channels by their conditional mean under a normal distribution of dV.

    Zeros, no signal, would be wrong: on a bent sensor, channels that stay at zero among others
    that have all changed look like a touch.

    Attributes:
        covariance: of dV, with mean zero, (C, C), dimensionless.
    """

    covariance: NDArray[np.float64]

    @classmethod
    def fit(cls, difference: ArrayLike, noise: float) -> "MissingChannels":
        """Covariance of dV (n, C), rows with bad channels left out; `noise` is its rms noise."""
        dV = np.asarray(difference, dtype=float)
        dV = dV[np.isfinite(dV).all(axis=1)]
        floor = max(noise, 1e-9) ** 2  # keeps the good channels' covariance invertible
        return cls(dV.T @ dV / max(len(dV), 1) + floor * np.eye(dV.shape[1]))

    def fill(self, difference: ArrayLike) -> NDArray[np.float64]:
        """dV (n, C) with gaps (not finite) replaced by E[bad | good] = C_bg C_gg^-1 good."""
        dV = np.array(difference, dtype=float)
        gaps = ~np.isfinite(dV)
        patterns = {row.tobytes(): row for row in gaps[gaps.any(axis=1)]}
        for pattern in patterns.values():
            rows = (gaps == pattern).all(axis=1)
            good = ~pattern
            weights = np.linalg.solve(self.covariance[np.ix_(good, good)], dV[rows][:, good].T)
            dV[np.ix_(rows, pattern)] = (self.covariance[np.ix_(pattern, good)] @ weights).T
        return dV
