"""What bending does to the channels, and how to take it off."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

TOLERANCE = 1.05  # of what is left of bend frames, over the noise


def bend_free(bend: ArrayLike, noise: float) -> NDArray[np.float64]:
    """Projection (C, C) that leaves of bend frames' dV (n, C) nothing but their noise.

    One sensor bends along a curve in the space of its channels, several sensors along several:
    the leading right singular vectors of their frames. As many are taken off as it needs for the
    rest to be within five percent of `noise`, the rms of idle dV.
    """
    dV = np.asarray(bend, dtype=float)
    count, channels = dV.shape
    _, sizes, directions = np.linalg.svd(dV, full_matrices=False)
    energy = np.sum(sizes**2) - np.concatenate([[0.0], np.cumsum(sizes**2)])
    freedom = count * (channels - np.arange(len(energy)))
    rest = np.sqrt(np.maximum(energy, 0.0) / np.maximum(freedom, 1))
    # At least half of the channels' freedom stays: touches need it.
    rank = min(int(np.count_nonzero(rest > TOLERANCE * noise)), channels // 2)
    basis = directions[:rank]
    projection: NDArray[np.float64] = np.eye(channels) - basis.T @ basis
    return projection
