"""Unknowns of a frame, bend angle and touches, and the model linearised at them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.prior import ANGLE_UNIT

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """Values of the unknowns.

    Attributes:
        touches: x [m], y [m] and force [N] of each (k, 3).
        angle_deg: of the bend [deg].
    """

    touches: Array
    angle_deg: float

    def without_touch(self, number: int) -> "Unknowns":
        """The same values less one touch."""
        others = np.concatenate([self.touches[:number], self.touches[number + 1 :]])
        return Unknowns(others, self.angle_deg)

    def with_touches(self, touches: Array) -> "Unknowns":
        """The same values and further touches (n, 3)."""
        return Unknowns(np.concatenate([self.touches, touches]), self.angle_deg)


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """Residual and Jacobian of the model at some unknowns, not whitened.

    Attributes:
        unknowns: where the model is linearised.
        rows: the residual, then the derivative of the model by a unit step of each of the n
            unknowns (1 + n, K).
        changes: by each touch (k, K).
        hidden: output of the response network, from which its uncertainty follows (k, hidden).
    """

    unknowns: Unknowns
    rows: Array
    changes: Array
    hidden: Array

    @classmethod
    def of(cls, point: tuple[Array, float, Array, Array, Array]) -> "Linearisation":
        """The linearisation that `fit_kernels` found."""
        touches, angle_deg, rows, changes, hidden = point
        return cls(Unknowns(touches, angle_deg), rows, changes, hidden)

    @property
    def point(self) -> tuple[Array, float, Array, Array, Array]:
        """The linearisation as `fit_kernels` take it."""
        unknowns = self.unknowns
        return unknowns.touches, unknowns.angle_deg, self.rows, self.changes, self.hidden

    @property
    def residual(self) -> Array:
        """Measured minus modelled change (K,)."""
        residual: Array = self.rows[0]
        return residual

    @property
    def bend_slope(self) -> Array:
        """Derivative of the bend curve (K,) [1/deg]."""
        slope: Array = self.rows[1] / ANGLE_UNIT
        return slope
