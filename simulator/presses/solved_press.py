"""Presses solved together on the whole stack, for scenes without a table."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress, Indentation
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.presses.dent_field import DentField
from eitskin.simulator.presses.finite_stack import Correction, FiniteStack
from eitskin.simulator.presses.stack_mesh import stack_mesh
from eitskin.simulator.scene.touch import AnyIndenter

Array = NDArray[np.float64]

_CELL = 1.0 / 20.0  # finest of the axisymmetric press, over the radius of the indenter
_KEPT = 64  # scenes


@dataclass(frozen=True, slots=True)
class Press:
    """Press of an indenter at (x, y) to a depth in the unbounded stack [m]."""

    x: float
    y: float
    depth: float
    indenter: AnyIndenter


@dataclass(frozen=True, slots=True, eq=False)
class SolvedField:
    """Correction of one to four presses, evaluated in columns as `SmoothField` is.

    Attributes:
        correction: of all presses.
    """

    correction: Correction

    def values(self, columns: Array) -> Array:
        """Displacement [m] and mean stress [Pa], (4, h, n), at columns of points (n, h, 3) [m]."""
        return np.ascontiguousarray(self.correction.in_gel(columns).transpose(2, 1, 0))

    def moved(self, columns: Array) -> Array:
        """Displacements and their derivatives by x, y, z, (12, h, n)."""
        points = columns + np.array([0.0, 0.0, self.correction.bottom])
        field = self.correction.displacement
        slopes = field.derivative(points).reshape(*columns.shape[:2], 9)
        return np.concatenate([field(points), slopes], axis=-1).transpose(2, 1, 0)


@lru_cache(maxsize=_KEPT)
def solved_presses(
    design: SensorDesign, mechanics: Mechanics, presses: tuple[Press, ...]
) -> Correction:
    """Correction of presses on a design, solved in 3D; seconds to a minute.

    Raises ConfigurationError for other outlines than rectangles, SolidError where presses are not
    carried.
    """
    if not isinstance(design.outline, Rectangle):
        raise ConfigurationError(
            "presses are solved on rectangles, got the outline "
            f"{type(design.outline).__name__.lower()}"
        )
    stack = mechanics.stack(design)
    contacts = [(press.x, press.y, press.indenter.rims[1]) for press in presses]
    body = stack_mesh(design.outline, stack, mechanics, design.support, contacts)
    dents = [
        DentField(press.x, press.y, press.indenter, dent(stack, press.indenter, press.depth))
        for press in presses
    ]
    return FiniteStack(body, len(presses)).correction(dents)


@lru_cache(maxsize=_KEPT)
def dent(stack: Stack, indenter: AnyIndenter, depth: float) -> Indentation:
    """Axisymmetric press to a depth [m] on an unbounded stack."""
    return AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1]).to_depth(depth)
