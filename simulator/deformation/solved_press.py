"""Presses solved together on the whole stack, for scenes without a table."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.deformation.contact import BentState, ContactFrame, DentField
from eitskin.simulator.deformation.finite_stack import Correction, FiniteStack
from eitskin.simulator.deformation.stack_mesh import Contact, stack_mesh
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Indentation, Mechanics, Stack
from eitskin.simulator.scene.scene import AnyIndenter

Array = NDArray[np.float64]

_CELL = 1.0 / 40.0  # finest of the axisymmetric press, over the radius of the indenter
_KEPT = 64  # scenes
_SAME = 1e-9  # [m]


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
    design: SensorDesign,
    mechanics: Mechanics,
    presses: tuple[Press, ...],
    bent: BentState | None = None,
) -> Correction:
    """Correction of presses on a design, flat or bent, solved in 3D; seconds to some minutes.

    Raises ConfigurationError for a press that overhangs the stack, SolidError where presses are not
    carried.
    """
    if isinstance(design.outline, Surface):
        raise ConfigurationError("presses on a body from a surface file are solved on tetrahedra")
    for press in presses:
        _require_on_stack(press, design, mechanics.margin)
    stack = mechanics.stack(design)
    frames = [
        None if bent is None else contact_frame(press.x, press.y, stack, bent) for press in presses
    ]
    contacts = [
        Contact(press.x, press.y, press.indenter.rims[1], _stretches(frame))
        for press, frame in zip(presses, frames, strict=True)
    ]
    body = stack_mesh(design.outline, stack, mechanics, design.support, contacts)
    dents = [
        DentField(press.x, press.y, press.indenter, dent(stack, press.indenter, press.depth), frame)
        for press, frame in zip(presses, frames, strict=True)
    ]
    return FiniteStack(body, len(presses), bent).correction(dents)


def contact_frame(x: float, y: float, stack: Stack, bent: BentState) -> ContactFrame:
    """Frame of the bent top under (x, y) [m]."""
    return ContactFrame.at(bent, x, y, stack.levels[-1] - stack.levels[stack.gel])


def _stretches(frame: ContactFrame | None) -> tuple[float, float]:
    if frame is None:
        return 1.0, 1.0
    along, across = frame.stretches.tolist()
    return along, across


def _require_on_stack(press: Press, design: SensorDesign, margin: float) -> None:
    """Raise ConfigurationError unless the whole contact can lie on the stack."""
    outline = design.outline
    if isinstance(outline, Surface):
        return
    depth = float(outline.nearest(np.array([press.x, press.y]))[1])
    least = press.indenter.rims[1] - margin
    if depth < least - _SAME:
        raise ConfigurationError(
            f"a touch must keep {1e3 * max(least, 0.0):.1f} mm from the edge of the gel, so that "
            f"its contact stays on the stack, got ({press.x:g}, {press.y:g}) m; press farther in"
        )


@lru_cache(maxsize=_KEPT)
def dent(stack: Stack, indenter: AnyIndenter, depth: float) -> Indentation:
    """Axisymmetric press to a depth [m] on an unbounded stack."""
    return AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1]).to_depth(depth)
