"""Touches in a touch map: connected components and their weighted centroids."""

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

THRESHOLD = 0.4  # of the map, whose values are probabilities of being under an indenter
SMALLEST = 4  # pixels; a smaller component is no indenter


def find_touches(
    touch_map: ArrayLike,
    outline: tuple[float, float],
    threshold: float = THRESHOLD,
    smallest: int = SMALLEST,
) -> tuple[tuple[float, float, float], ...]:
    """Touches (x [m], y [m], strength) in a touch map, strongest first.

    A touch is a connected component (8-neighbourhood) above a threshold. Its position is the
    centroid of the pixels weighted by their values, the paper's equation (3); its strength is its
    largest value.

    Args:
        touch_map: probabilities (rows along y, columns along x).
        outline: length and width that the map covers [m].
        threshold: of the probabilities.
        smallest: least number of pixels of a touch.
    """
    values = np.asarray(touch_map, dtype=float)
    rows, columns = values.shape
    labels, count = ndimage.label(values > threshold, structure=np.ones((3, 3)))
    touches = []
    for component in range(1, count + 1):
        iy, ix = np.nonzero(labels == component)
        if len(iy) < smallest:
            continue
        weights = values[iy, ix]
        x = float(np.average(ix + 0.5, weights=weights)) * outline[0] / columns
        y = float(np.average(iy + 0.5, weights=weights)) * outline[1] / rows
        touches.append((x, y, float(weights.max())))
    return tuple(sorted(touches, key=lambda touch: -touch[2]))
