"""Search for dents of prescribed depths."""

import math

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.sensor import Free, Plates, SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.scene.indenters import Footprint
from eitskin.simulator.scene.scene import Touch

Array = NDArray[np.float64]

# Error of the depths, first dent where the base gives way over the thickness of the stack, largest
# step, and least sinking over a dent's depth.
TOLERANCE, _SHALLOW = 1e-3, 0.1
_LARGEST_STEP, _LEAST_SUNK = math.log(4.0), -0.9


class DepthSearch:
    """Search for dents whose depths, with what the finite stack sinks, are the prescribed ones.

    Broyden's method (Broyden 1965) for the logarithms of the depths, since dents and sinking grow
    nearly in proportion; for one touch it is the secant method. Over a gap the stack sinks much
    more than a dent is deep, so that a fixed-point iteration would not converge.

    Attributes:
        depths: depths of the dents in the unbounded stack to try next [m]; NaN for prescribed
            forces and for footprints, which have no dents.
        is_needed: whether any depth is prescribed.
    """

    def __init__(self, touches: tuple[Touch, ...], design: SensorDesign) -> None:
        bodies = [None if isinstance(t.indenter, Footprint) else t.depth for t in touches]
        target_depths = [math.nan if depth is None else depth for depth in bodies]
        self._wanted = np.array(target_depths)
        self.depths = np.array(
            [
                min(depth, _SHALLOW * design.encapsulated_thickness)
                if _gives_way(touch, design)
                else depth
                for touch, depth in zip(touches, target_depths, strict=True)
            ]
        )
        self._given = np.isfinite(self.depths)
        self.is_needed = bool(self._given.any())
        self._jacobian = np.eye(int(self._given.sum()))
        self._last: tuple[Array, Array] | None = None

    def advance(self, dents: Array, sunk: Array) -> bool:
        """Whether the wanted depths are met; otherwise `depths` are those to try next.

        Args:
            dents: present depths of the dents, which may have faded since their release [m].
            sunk: length by which each indenter now sinks deeper than its dent [m].
        """
        part = np.divide(sunk, dents, out=np.zeros(len(dents)), where=dents > 0.0)[self._given]
        tried = np.log(self.depths[self._given])
        reached = tried + np.log1p(np.maximum(part, _LEAST_SUNK))
        error = reached - np.log(self._wanted[self._given])
        if np.all(np.abs(error) < TOLERANCE):
            return True
        if self._last is not None:
            step, change = tried - self._last[0], error - self._last[1]
            self._jacobian += np.outer(change - self._jacobian @ step, step) / (step @ step)
        self._last = tried, error
        step = -np.linalg.lstsq(self._jacobian, error)[0]
        step *= min(1.0, _LARGEST_STEP / np.abs(step).max())
        self.depths[self._given] = np.exp(tried + step)
        return False


def _gives_way(touch: Touch, design: SensorDesign) -> bool:
    """Whether the base under a touch is free, so that the stack may sink more than it is dented."""
    if isinstance(design.support, Free):
        return True
    if not isinstance(design.support, Plates) or isinstance(design.outline, Surface):
        return False
    start, end = design.support.gap(design.outline)
    beside = design.encapsulated_thickness
    return start - beside < touch.x < end + beside
