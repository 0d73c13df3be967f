"""Regions of a picture: where the conductivity is lower or higher than around."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from eitskin.training.reconstruction.pixel_grid import PixelGrid

Array = NDArray[np.float64]
MIN_SHARE = 0.3  # of the picture's largest change, below which the other sign is none
EDGE_SHARE = 0.6  # of a region's largest change, at its edge, since images are wider than changes
MIN_AREA = 0.003  # of the sensor, below which a region is none


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

    Regions reach to `EDGE_SHARE` of their own largest change; small ones are left out. A sign whose
    changes are small next to the other's is none.
    """
    inside = np.nan_to_num(values)
    classes = np.zeros(values.shape, dtype=np.int8)
    for sign in (-1, 1):
        part = np.maximum(sign * inside, 0.0)
        if part.max() <= MIN_SHARE * np.abs(inside).max():
            continue
        labels, count = ndimage.label(part > MIN_SHARE * part.max())
        for label in range(1, count + 1):
            own = np.where(labels == label, part, 0.0)
            region = own > EDGE_SHARE * own.max()
            if region.sum() >= MIN_AREA * len(grid):
                classes[region] = sign
    return classes


def picture_regions(values: Array, grid: PixelGrid) -> list[PictureRegion]:
    """Regions of a picture (rows, columns), the largest first."""
    classes, regions = segment(values, grid), []
    for sign in (-1, 1):
        labels, count = ndimage.label(classes == sign)
        for label in range(1, count + 1):
            mine = (labels == label)[grid.inside]
            x, y = grid.centres[mine].mean(axis=0).tolist()
            change = float(values[grid.inside][mine].mean())
            regions.append(PictureRegion(sign, float(mine.sum() * grid.area), (x, y), change))
    return sorted(regions, key=lambda region: -region.area)
