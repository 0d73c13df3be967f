"""Computational windows of presses in 3D, and the check of their touches."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator.scene.touch import Touch

Array = NDArray[np.float64]

_SAME = 1e-9  # [m]
_MOST = 4  # touches


@dataclass(frozen=True, slots=True)
class PressWindow:
    """Computational window along one axis; half under symmetry.

    Attributes:
        low, high: ends of the window [m].
        cut: whether the sensor continues beyond each end; the cut is held.
        mirrored: whether only the half above the middle is solved.
    """

    low: float
    high: float
    cut: tuple[bool, bool]
    mirrored: bool

    @classmethod
    def around(
        cls, touches: Sequence[Touch], axis: int, ends: tuple[float, float], reach: float
    ) -> "PressWindow":
        """Window within `reach` [m] of all touches; half of it for mirror-symmetric touches."""
        positions = np.array([(touch.x, touch.y) for touch in touches])
        along, across = positions[:, axis], positions[:, 1 - axis]
        low, high = max(ends[0], along.min() - reach), min(ends[1], along.max() + reach)
        cut = (bool(low > ends[0]), bool(high < ends[1]))
        rest = [(y, t.force, hash(t.indenter)) for y, t in zip(across, touches, strict=True)]
        from_middle = (along - 0.5 * (low + high)).round(9)
        one = sorted(zip(from_middle, rest, strict=True))
        other = sorted(zip(-from_middle, rest, strict=True))
        return cls(float(low), float(high), cut, cut[0] == cut[1] and one == other)

    @property
    def origin(self) -> float:
        """Start of the solved part [m]."""
        return 0.5 * (self.low + self.high) if self.mirrored else self.low

    @property
    def extent(self) -> float:
        """Length of the solved part [m]."""
        return self.high - self.origin

    def local(self, x: Array) -> tuple[Array, Array]:
        """Coordinates from the origin [m], mirrored to the solved part, and signs of mirroring."""
        from_origin = x - self.origin
        side = np.where(self.mirrored & (from_origin < 0.0), -1.0, 1.0)
        return side * from_origin, side


def check_touches(outline: Rectangle, touches: Sequence[Touch]) -> None:
    """Raise ConfigurationError unless one to four touches lie on the sensor, side by side."""
    if not 1 <= len(touches) <= _MOST:
        raise ConfigurationError(f"one to {_MOST} touches can be solved, got {len(touches)}")
    for touch in touches:
        if not outline.contains(np.array([touch.x, touch.y])):
            raise ConfigurationError(
                f"a touch must lie on the sensor of {outline.length:g} x {outline.width:g} m, got "
                f"({touch.x:g}, {touch.y:g}) m; are the units metres?"
            )
        if touch.depth is not None or touch.held is not None:
            raise ConfigurationError(
                "touches are solved for their force at their first moment, got depth="
                f"{touch.depth} m and held={touch.held} s; leave both out"
            )
    for a, b in itertools.combinations(touches, 2):
        apart, least = math.hypot(a.x - b.x, a.y - b.y), a.indenter.rims[1] + b.indenter.rims[1]
        if apart < least - _SAME:
            raise ConfigurationError(
                f"indenters must not overlap: touches {apart:g} m apart need at least {least:g} m"
            )
