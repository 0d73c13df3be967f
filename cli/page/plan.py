"""A sensor seen from above, for the touch map of the live page."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.cli.page.body import arc_of
from eitskin.geometry.design.outline import Disc
from eitskin.geometry.design.placement import ContactArea, placed
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.side_contacts import Strip
from eitskin.geometry.design.surface import Surface

Array = NDArray[np.float64]

_RIM = 96  # points of an outline without corners
_PIECES = 12  # least number of pieces of an electrode's line
_LINES = 10.0  # of the grid, about, along the longer side
_ROUND = np.array([1.0, 1.5, 2.0, 3.0, 5.0, 7.5, 10.0])


@dataclass(frozen=True, slots=True, eq=False)
class PlanElectrode:
    """Electrode seen from above.

    Attributes:
        path: corners of a pad, or points of the line of a strip on the side (k, 2) [m].
        closed: whether the path is that of a pad.
        outward: unit vector away from the body (2,); zero for a pad on a level face.
    """

    path: Array
    closed: bool
    outward: Array


def outline_of(design: SensorDesign) -> Array:
    """Vertices of the body seen from above (k, 2) [m]; the convex hull for one from a file."""
    outline = design.outline
    if isinstance(outline, Surface):
        from scipy.spatial import ConvexHull

        points = outline.triangles()[0][:, :2]
        hull: Array = points[ConvexHull(points).vertices]
        return hull
    if isinstance(outline, Disc):
        return outline.at(np.arange(_RIM) * (outline.perimeter / _RIM))
    return outline.vertices


def electrodes_of(design: SensorDesign) -> list[PlanElectrode]:
    """Electrodes seen from above, in the order of their numbers."""
    contacts = placed(design.electrodes, design.outline, design.thickness)
    return [_electrode(contact) for contact in contacts]


def grid_of(length: float, width: float) -> float:
    """Distance between two lines of the grid on a sensor, a round number [m]."""
    wanted = max(length, width) / _LINES
    power = 10.0 ** math.floor(math.log10(wanted))
    return float(power * _ROUND[np.abs(np.log(_ROUND * power / wanted)).argmin()])


def _electrode(contact: ContactArea) -> PlanElectrode:
    if isinstance(contact, Strip):
        width = contact.end - contact.start
        middle = 0.5 * (contact.start + contact.end)
        (a, b), (c, d) = contact.outline.at([middle - 0.25 * width, middle + 0.25 * width])
        outward = np.array([d - b, a - c]) / math.hypot(d - b, a - c)
        path = contact.outline.at(arc_of(contact, width / _PIECES))
        return PlanElectrode(path, closed=False, outward=outward)
    up = contact.normal[2]
    outward = contact.normal[:2] * (abs(up) < 0.5)
    return PlanElectrode(contact.corners[:, :2], closed=True, outward=outward)
