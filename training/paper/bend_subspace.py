"""Principal subspace of bend frames, and the projection that removes it."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

TOLERANCE = 1.05  # of the residual of bend frames, over the noise


def bend_free_projection(bend: ArrayLike, noise: float) -> NDArray[np.float64]:
    """Orthogonal projection (C, C) that reduces the dV (n, C) of bend frames to their noise.

    Bending moves one sensor along a curve in the space of its channels, several sensors along
    several curves; the leading right singular vectors of their frames span these. The rank is the
    smallest that leaves a residual within five percent of `noise`, the rms of idle dV, and at most
    half the number of channels.
    """
    dV = np.asarray(bend, dtype=float)
    count, channels = dV.shape
    _, sizes, directions = np.linalg.svd(dV, full_matrices=False)
    energy = np.sum(sizes**2) - np.concatenate([[0.0], np.cumsum(sizes**2)])
    freedom = count * (channels - np.arange(len(energy)))
    residual = np.sqrt(np.maximum(energy, 0.0) / np.maximum(freedom, 1))
    # At least half of the channels' freedom stays: touches need it.
    rank = min(int(np.count_nonzero(residual > TOLERANCE * noise)), channels // 2)
    basis = directions[:rank]
    projection: NDArray[np.float64] = np.eye(channels) - basis.T @ basis
    return projection
