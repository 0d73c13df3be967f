"""Deformed gel for the live page: points bent and dented by eitskin's own geometry."""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.cli.page.body import DrawnBody
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Hinge
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.bends import bend_store
from eitskin.simulator.layer.dents import closed_form_dents
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.presses.closed_form_dent import LARGEST_FORCE
from eitskin.simulator.scene.touch import Touch

Array = NDArray[np.float64]

FORCE_UNKNOWN = 6.0  # drawn for a touch whose force is not estimated [N]
_STEEPEST = 60.0  # bends are drawn up to this, either way [deg]
_FINEST = 0.2  # difference of two bends that are drawn [deg]; each is computed once
_STEPS = 32000  # of a coordinate from the middle to twice the sensor's length
_SAME_ANGLE, _SAME_PRESS = 0.3, (0.0015, 0.0015, 0.5)  # too little to be seen [deg], [m, m, N]

DrawnPress = tuple[float, float, float]
"""x [m], y [m] and force [N]; NaN for an unknown force."""


@dataclass(frozen=True, slots=True, eq=False)
class GelShape:
    """Triangles of the flat gel and its electrodes, with the range of bends.

    Attributes:
        design: the sensor.
        body: triangles.
        origin: least x and y of the outline, and the height of the bottom, (3,) [m].
        least, most: bends that can be drawn [deg].
    """

    design: SensorDesign
    body: DrawnBody
    origin: Array
    least: float
    most: float

    @classmethod
    @lru_cache(maxsize=8)  # the same sensor is shown again after a page was closed
    def of(cls, design: SensorDesign) -> "GelShape":
        """Shape of a sensor with any outline."""
        outline = design.outline
        origin = outline.bounds[0] if isinstance(outline, Surface) else np.zeros(3)
        reach = [_farthest(design, sign) for sign in (-1, 1)]
        return cls(design, DrawnBody.of(design), origin, *reach)

    def bent(self, angle_deg: float, presses: Sequence[DrawnPress]) -> Array:
        """Deformed points (n, 3) [m] under a bend and touches at (x [m], y [m], force [N]).

        Bends are drawn in steps of `_FINEST`. Dents are to scale, in the closed form that is fitted
        for the 15 mm cylinder; forces past its last are drawn as that, unknown ones as
        `FORCE_UNKNOWN`, an unknown angle as flat. A body from a file has no dents.
        """
        angle = _FINEST * round(angle_deg / _FINEST) if math.isfinite(angle_deg) else 0.0
        angle = min(max(angle, self.least), self.most)
        points = self.body.points
        if presses and not isinstance(self.design.outline, Surface):
            touches = tuple(Touch(x, y, _drawn_force(force)) for x, y, force in presses)
            points = closed_form_dents(touches).positions(points)
        return _bent(self.design, angle).positions(points) if angle else points


@dataclass(slots=True, eq=False)
class GelDrawing:
    """Latest drawing of the shape, kept while estimates change by no more than noise.

    Attributes:
        shape: the flat shape.
        unit: resolution of a coordinate [m].
    """

    shape: GelShape
    unit: float
    _drawn: Array | None = None
    _points: str = ""

    @classmethod
    def of(cls, design: SensorDesign) -> "GelDrawing":
        """Drawing of a sensor with any outline."""
        return cls(
            GelShape.of(design), 2.0 * max(design.outline.length, design.outline.width) / _STEPS
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain data of the triangles, which do not change; numbers are 16-bit integers."""
        body = self.shape.body
        return {
            "unit": self.unit,
            "points": self._steps(body.points),
            "vertices": _encoded(body.vertices, "<u2"),
            "kinds": _encoded(body.kinds, "u1"),
            "faces": _encoded(body.faces, "<u2"),
            "opaque": body.opaque,
            "electrodes": body.electrodes.tolist(),
        }

    def points(self, angle_deg: float, presses: Sequence[DrawnPress]) -> str:
        """Deformed points from the origin in multiples of `unit`: int16, little-endian, base64."""
        wanted = np.array([angle_deg, *(value for press in presses for value in press)])
        tolerance = np.array([_SAME_ANGLE, *_SAME_PRESS * len(presses)])
        if self._drawn is None or not _near(wanted, self._drawn, tolerance):
            self._points = self._steps(self.shape.bent(angle_deg, presses))
            self._drawn = wanted
        return self._points

    def _steps(self, points: Array) -> str:
        return _encoded(np.rint((points - self.shape.origin) / self.unit), "<i2")


def _encoded(numbers: NDArray[Any], kind: str) -> str:
    """Numbers of one kind of integers in base64."""
    return base64.b64encode(numbers.astype(kind).tobytes()).decode()


def _near(one: Array, other: Array, tolerance: Array) -> bool:
    """Whether all values differ by no more than `tolerance`; NaN equals NaN."""
    if one.shape != other.shape:
        return False
    same = np.isnan(one) & np.isnan(other)
    return bool((same | (np.abs(one - other) <= tolerance)).all())


@lru_cache(maxsize=256)
def _bent(design: SensorDesign, angle: float) -> Deformation:
    """Bend by the default clamp where that has been solved, by the kinematic hinge elsewhere."""
    plane = isinstance(design.outline, Rectangle)
    solved = plane and not bend_store.missing(design, Clamp(), Mechanics())
    fixture = Clamp() if solved else Hinge()
    return bend_store.bend(design, fixture, Mechanics(), Bend(angle))


def _farthest(design: SensorDesign, sign: int) -> float:
    """Largest bend in one direction that the fixture can reach [deg]."""
    for angle in np.arange(_STEEPEST, 0.0, -20.0):
        try:
            _bent(design, float(sign * angle))
        except ConfigurationError:
            continue
        return float(sign * angle)
    return 0.0


def _drawn_force(force: float) -> float:
    """Force rounded to 0.1 N, so that each dent is computed once."""
    known = force if math.isfinite(force) else FORCE_UNKNOWN
    return round(min(max(known, 0.1), LARGEST_FORCE), 1)
