"""Picture of places with their standard errors, by which saved pipelines are checked."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

BLUR = 9.0  # standard errors beyond which 1 - Phi is one to the last digit


def disc_map(
    places: Array,
    deviations: Array,
    radius: float,
    size: tuple[float, float],
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Probability of each pixel's centre to lie under an indenter (rows, columns), 0 to 1.

    A centre at distance d from a touch lies under its disc with probability Phi((radius - d) / s),
    where s is the standard error of the position along one axis. That is exact for a straight edge,
    and s is small beside the radius wherever the map is of use.

    Args:
        places: positions of the touches (k, 2) [m].
        deviations: standard errors along one axis (k,) [m].
        radius: of the indenters [m].
        size: length and width of the sensor [m].
        shape: rows along y, columns along x.
    """
    rows, columns = shape
    x = (np.arange(columns) + 0.5) * size[0] / columns
    y = (np.arange(rows) + 0.5) * size[1] / rows
    free = np.ones(shape)
    deviations = np.maximum(deviations, 1e-6)
    for (px, py), deviation in zip(places.tolist(), deviations.tolist(), strict=True):
        reach = radius + BLUR * deviation
        across = slice(*np.searchsorted(x, [px - reach, px + reach]))
        along = slice(*np.searchsorted(y, [py - reach, py + reach]))
        distance = np.hypot(x[across] - px, y[along, None] - py)
        free[along, across] *= 1.0 - ndtr((radius - distance) / deviation)
    return (1.0 - free).astype(np.float32)
