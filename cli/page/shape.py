"""Deformed gel for the live page: points bent and dented by eitskin's own geometry."""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Hinge
from eitskin.geometry.deformation.kinematics import Composed, Deformation
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.placement import placed
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.side_contacts import Strip
from eitskin.simulator.bends import bend_store
from eitskin.simulator.layer.dents import closed_form_dents
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.presses.closed_form_dent import LARGEST_FORCE
from eitskin.simulator.scene.touch import Touch

Array = NDArray[np.float64]

COLUMNS, ROWS = 51, 21  # of the face, every 3 mm on the reference sensor
FORCE_UNKNOWN = 6.0  # drawn for a touch whose force is not estimated [N]
_STEEPEST = 60.0  # bends are drawn up to this, either way [deg]
_FINEST = 0.2  # difference of two bends that are drawn [deg]; each is computed once
_STEPS = 32000  # of a coordinate from the middle to twice the sensor's length
_SAME_ANGLE, _SAME_PRESS = 0.3, (0.0015, 0.0015, 0.5)  # too little to be seen [deg], [m, m, N]

DrawnPress = tuple[float, float, float]
"""x [m], y [m] and force [N]; NaN for an unknown force."""


@dataclass(frozen=True, slots=True, eq=False)
class GelShape:
    """Points of the flat gel, with the range of bends.

    Attributes:
        design: the sensor.
        points: the face, row by row, `ROWS` times `COLUMNS`; the bottom along both long edges,
            2 times `COLUMNS`; four corners of each electrode (n, 3) [m].
        least, most: bends that can be drawn [deg].
    """

    design: SensorDesign
    points: Array
    least: float
    most: float

    @classmethod
    def of(cls, design: SensorDesign) -> "GelShape | None":
        """GelShape of a rectangular sensor; None for others, which are not drawn."""
        if not isinstance(design.outline, Rectangle):
            return None
        length, width = design.outline.length, design.outline.width
        x = np.linspace(0.0, length, COLUMNS)
        face = _sheet(x, np.linspace(0.0, width, ROWS), design.thickness)
        bottom = _sheet(x, np.array([0.0, width]), 0.0)
        points = np.concatenate([face, bottom, electrode_corners(design).reshape(-1, 3)])
        return cls(design, points, _farthest(design, -1), _farthest(design, 1))

    def bent(self, angle_deg: float, presses: Sequence[DrawnPress]) -> Array:
        """Deformed points (n, 3) [m] under a bend and touches at (x [m], y [m], force [N]).

        Bends are drawn in steps of `_FINEST`. Dents are to scale, in the closed form that is fitted
        for the 15 mm cylinder; forces past its last are drawn as that, unknown ones as
        `FORCE_UNKNOWN`, an unknown angle as flat.
        """
        angle = _FINEST * round(angle_deg / _FINEST) if math.isfinite(angle_deg) else 0.0
        angle = min(max(angle, self.least), self.most)
        touches = tuple(Touch(x, y, _drawn_force(force)) for x, y, force in presses)
        shape: Deformation = _bent(self.design, angle)
        if touches:
            pressed = closed_form_dents(touches)
            shape = Composed(pressed, shape)
        return shape.positions(self.points)


@dataclass(slots=True, eq=False)
class GelDrawing:
    """LatestMessage drawing of the shape, kept while estimates change by no more than noise.

    Attributes:
        shape: the flat shape.
        unit: resolution of a coordinate [m].
    """

    shape: GelShape
    unit: float
    _drawn: Array | None = None
    _points: str = ""

    @classmethod
    def of(cls, design: SensorDesign) -> "GelDrawing | None":
        """GelDrawing of a rectangular sensor; None for others."""
        shape = GelShape.of(design)
        return None if shape is None else cls(shape, 2.0 * design.outline.length / _STEPS)

    def points(self, angle_deg: float, presses: Sequence[DrawnPress]) -> str:
        """Deformed points in multiples of `unit`: int16, little-endian, base64."""
        wanted = np.array([angle_deg, *(value for press in presses for value in press)])
        tolerance = np.array([_SAME_ANGLE, *_SAME_PRESS * len(presses)])
        if self._drawn is None or not _near(wanted, self._drawn, tolerance):
            steps = np.rint(self.shape.bent(angle_deg, presses) / self.unit)
            self._points = base64.b64encode(steps.astype("<i2").tobytes()).decode()
            self._drawn = wanted
        return self._points


def _near(one: Array, other: Array, tolerance: Array) -> bool:
    """Whether all values differ by no more than `tolerance`; NaN equals NaN."""
    if one.shape != other.shape:
        return False
    same = np.isnan(one) & np.isnan(other)
    return bool((same | (np.abs(one - other) <= tolerance)).all())


def electrode_corners(design: SensorDesign) -> Array:
    """Four corners of each electrode in turn (electrodes, 4, 3) [m]; round ones as squares."""
    corners = []
    for contact in placed(design.electrodes, design.outline, design.thickness):
        if isinstance(contact, Strip):
            ends = contact.outline.at([contact.start, contact.end, contact.end, contact.start])
            heights = [contact.low, contact.low, contact.high, contact.high]
            corners.append(np.column_stack([ends, heights]))
        else:
            corners.append(contact.corners[:: len(contact.corners) // 4])
    return np.array(corners)


def _sheet(x: Array, y: Array, z: float) -> Array:
    """Points (len(y) * len(x), 3) [m] at height z, row by row."""
    rows, columns = np.meshgrid(y, x, indexing="ij")
    return np.stack([columns, rows, np.full_like(rows, z)], axis=-1).reshape(-1, 3)


@lru_cache(maxsize=256)
def _bent(design: SensorDesign, angle: float) -> Deformation:
    """Bend by the default clamp where that has been solved, by the kinematic hinge elsewhere."""
    solved = not bend_store.missing(design, Clamp(), Mechanics())
    fixture = Clamp() if solved else Hinge()
    return bend_store.bend(design, fixture, Mechanics(), Bend(angle))


def _farthest(design: SensorDesign, sign: int) -> float:
    """Largest bend in one direction that the fixture can reach [deg]."""
    for angle in np.arange(_STEEPEST, 0.0, -10.0):
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
