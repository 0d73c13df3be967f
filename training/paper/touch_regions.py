"""Touches in a touch map: connected regions and their weighted centroids."""

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

THRESHOLD = 0.4  # of the map, whose values are probabilities of being under an indenter
SMALLEST = 4  # pixels; a region of fewer is no indenter


def find_touches(
    touch_map: ArrayLike,
    outline: tuple[float, float],
    threshold: float = THRESHOLD,
    smallest: int = SMALLEST,
) -> tuple[tuple[float, float, float], ...]:
    """Touches (x [m], y [m], strength) in a map (rows along y, columns along x), strongest first.

    A touch is a connected region above `threshold` of at least `smallest` pixels. Its place is
    the centroid of the pixels weighted by their values, the paper's equation (3); its strength is
    the largest value in it. `outline` is the length and width that the map covers [m].
    """
    values = np.asarray(touch_map, dtype=float)
    rows, columns = values.shape
    labels, count = ndimage.label(values > threshold, structure=np.ones((3, 3)))
    touches = []
    for region in range(1, count + 1):
        iy, ix = np.nonzero(labels == region)
        if len(iy) < smallest:
            continue
        weights = values[iy, ix]
        x = float(np.average(ix + 0.5, weights=weights)) * outline[0] / columns
        y = float(np.average(iy + 0.5, weights=weights)) * outline[1] / rows
        touches.append((x, y, float(weights.max())))
    return tuple(sorted(touches, key=lambda touch: -touch[2]))
