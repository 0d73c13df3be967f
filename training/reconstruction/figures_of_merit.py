"""Figures of merit of GREIT: how a picture shows one small target (Adler et al. 2009)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import LEAST, MOST
from eitskin.errors import DataError
from eitskin.training.reconstruction.pixel_grid import PixelGrid

Array = NDArray[np.float64]

AMPLITUDE_SHARE = 0.25  # of the largest value, from which on pixels belong to the found blob


@dataclass(frozen=True, slots=True)
class FiguresOfMerit:
    """Figures of merit of one picture of one target.

    The blob is the set of pixels of at least a quarter of the picture's largest value, and the
    circle is that of the blob's area about its centroid.

    Attributes:
        amplitude: integral of the picture over that of the target; ideally the same for every
            position.
        shift: from the target's centre to the blob's centroid, along x and y [m].
        resolution: square root of the blob's area over the sensor's; small is sharp.
        shape_deformation: share of the blob outside the circle, 0 to 1.
        ringing: values of the wrong sign outside the circle, relative to the sum within.
    """

    amplitude: float
    shift: tuple[float, float]
    resolution: float
    shape_deformation: float
    ringing: float

    @property
    def position_error(self) -> float:
        """Distance from the target's centre to the blob's centroid [m]."""
        return math.hypot(*self.shift)


def figures_of_merit(
    values: ArrayLike, grid: PixelGrid, centre: tuple[float, float], integral: float
) -> FiguresOfMerit:
    """Figures of merit of a picture of one target.

    Args:
        values: of the pixels inside the outline (P,).
        grid: the pixels.
        centre: of the target [m].
        integral: of the target's change over its area, signed [m2].

    Raises:
        DataError: for a picture without values of the target's sign, and for numbers that are not
            finite or too large or small to divide by.
    """
    given = np.array([*np.ravel(values), *centre], dtype=float)
    if not (np.all(np.abs(given) <= MOST) and LEAST <= abs(integral) <= MOST):
        raise DataError(
            f"expected a picture and a centre up to {MOST:g}, and an integral from {LEAST:g}, got "
            f"{np.abs(given).max(initial=0.0):g} and {integral:g}"
        )
    picture = np.asarray(values, dtype=float) * math.copysign(1.0, integral)
    largest = float(picture.max(initial=0.0))
    if not largest > 0.0:
        raise DataError("expected a picture with values of the target's sign, got none")
    blob = picture >= AMPLITUDE_SHARE * largest
    centroid = grid.centres[blob].mean(axis=0)
    radius = math.sqrt(blob.sum() * grid.area / math.pi)
    circle = np.linalg.norm(grid.centres - centroid, axis=1) <= radius
    wrong = np.minimum(picture[~circle], 0.0).sum()
    within = float(picture[circle].sum())
    return FiguresOfMerit(
        amplitude=float(picture.sum()) * grid.area / abs(integral),
        shift=(float(centroid[0] - centre[0]), float(centroid[1] - centre[1])),
        resolution=math.sqrt(blob.sum() / len(grid)),
        shape_deformation=float((blob & ~circle).sum() / blob.sum()),
        ringing=-float(wrong) / within if within > 0.0 else math.inf,
    )
