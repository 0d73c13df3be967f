"""Regions of a picture: where the conductivity is lower or higher than around."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from eitskin.training.reconstruction.pixel_grid import PixelGrid

Array = NDArray[np.float64]
LEAST_SHARE = 0.3  # of the picture's largest change, below which the other sign is none
LEAST_AREA = 0.003  # of the sensor, below which a region is none


class PictureRegion(NamedTuple):
    """Connected part of a picture.

    Attributes:
        sign: -1 for lower conductivity, +1 for higher.
        area: [m2].
        centre: x and y [m].
        change: mean relative change of conductivity.
    """

    sign: int
    area: float
    centre: tuple[float, float]
    change: float


def segment(values: Array, grid: PixelGrid) -> NDArray[np.int8]:
    """Classes -1, 0 and +1 of a picture (rows, columns), 0 outside the outline, too.

    For each sign the pixels beyond the threshold that separates them best from the others (Otsu
    1979), without those of small parts. A sign whose changes are small beside the other's is none.
    """
    inside = np.nan_to_num(values)
    classes = np.zeros(values.shape, dtype=np.int8)
    for sign in (-1, 1):
        part = np.maximum(sign * inside, 0.0)
        if part.max() <= LEAST_SHARE * np.abs(inside).max():
            continue
        labels, count = ndimage.label(part > otsu_threshold(part[grid.inside]))
        for label in range(1, count + 1):
            if (labels == label).sum() >= LEAST_AREA * len(grid):
                classes[labels == label] = sign
    return classes


def otsu_threshold(values: Array) -> float:
    """Threshold (Otsu 1979) that makes the variance between both classes of values largest."""
    rising = np.sort(values)
    count = np.arange(1, len(rising))
    below = np.cumsum(rising)[:-1]
    apart = below / count - (rising.sum() - below) / (len(rising) - count)
    best = int((count * (len(rising) - count) * apart**2).argmax())
    return float(0.5 * (rising[best] + rising[best + 1]))


def picture_regions(values: Array, grid: PixelGrid) -> list[PictureRegion]:
    """Regions of a picture (rows, columns), the largest first."""
    classes, found = segment(values, grid), []
    for sign in (-1, 1):
        labels, count = ndimage.label(classes == sign)
        for label in range(1, count + 1):
            mine = (labels == label)[grid.inside]
            x, y = grid.centres[mine].mean(axis=0).tolist()
            change = float(values[grid.inside][mine].mean())
            found.append(PictureRegion(sign, float(mine.sum() * grid.area), (x, y), change))
    return sorted(found, key=lambda region: -region.area)
