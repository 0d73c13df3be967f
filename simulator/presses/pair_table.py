"""Table of pairs: how two presses side by side change each other's dents."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.support import Rigid
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress, Indentation
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.presses.correction_table import processes
from eitskin.simulator.presses.dent_field import DentField
from eitskin.simulator.presses.finite_stack import Correction, FiniteStack
from eitskin.simulator.presses.smooth_field import Box, SmoothField
from eitskin.simulator.presses.stack_mesh import Fineness, stack_mesh
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

# Lengths over the thickness of the stack; distances are between the rims of the indenters.
_DEPTHS = (0.16, 0.23, 0.3)
_APART = (0.25, 0.45, 0.8, 1.25, 1.9, 2.8)
_VANISHED = 1.4  # beyond the last distance
_REACH, _FADE, _FREE = 4.5, 1.5, 6.0  # beyond the axes: of the field, of its end, of the mesh
_CELL = 1.0 / 40.0  # finest of the axisymmetric press, over the radius of the indenter
_COUNTS, _STRETCH = (30, 24, 3), 1.5


@dataclass(frozen=True, slots=True, eq=False)
class PairTable:
    """Change of displacement and mean stress by a second press, over distance and depth.

    Pairs are solved on a wide stack, with equal indenters and depths. To leading order the change
    is bilinear in both depths, so that unequal ones are scaled by their product. Contacts do not
    take back each other's dents here: without the sides of the sensor that moves signals away from
    reference solutions (docs/deformation.md).

    Attributes:
        thickness: of the whole stack, () [m].
        height: of the gel, () [m].
        apart: distances between the axes; at the last nothing changes, (r,) [m].
        depths: (d,) [m].
        fields: coefficients in the frame of the pair, x from press to press, (r - 1, d, nx, ny, nz,
            4).
        sunk: by which each press sinks deeper, (r - 1, d) [m].
    """

    thickness: Array
    height: Array
    apart: Array
    depths: Array
    fields: Array
    sunk: Array

    def at(self, apart: float, first: float, second: float) -> tuple[SmoothField, float] | None:
        """Field in the frame of a pair at a distance and to two depths [m], and sinking [m].

        None where the presses do not feel each other.
        """
        if apart >= self.apart[-1]:
            return None
        apart = max(apart, float(self.apart[0]))
        near = CubicSpline(np.log(self.apart), np.eye(len(self.apart)))(np.log(apart))[:-1]
        product = first * second
        # Over the product of the depths the change is constant up to the least solved depth.
        deep = max(float(np.sqrt(product)), float(self.depths[0]))
        others = [np.delete(self.depths, k) for k in range(len(self.depths))]
        weights = product * np.array(
            [
                np.prod((deep - other) / (own - other)) / own**2
                for own, other in zip(self.depths, others, strict=True)
            ]
        )
        fields = np.tensordot(weights, np.tensordot(near, self.fields, (0, 0)), (0, 0))
        return SmoothField(self._box(apart), fields, _STRETCH), float(near @ self.sunk @ weights)

    def _box(self, apart: float) -> Box:
        return _box(apart, float(self.thickness), float(self.height))


def solve_pairs(
    stack: Stack, mechanics: Mechanics, indenter: Indenter, workers: int = 1
) -> PairTable:
    """Solve pairs of equal presses on a wide stack, in a number of processes.

    Raises SolidError where one is not carried.
    """
    H, height = stack.levels[-1], stack.sheets[stack.gel].thickness
    press = AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1])
    dents = [press.to_depth(part * H) for part in _DEPTHS]
    apart = 2.0 * indenter.rims[1] + H * np.array(_APART)
    with processes(workers) as run:
        solved = list(run(partial(_pairs, stack, mechanics, indenter, dents), apart.tolist()))
    fields = [[field.coefficients for field, _ in pairs] for pairs in solved]
    sunk = [[deeper for _, deeper in pairs] for pairs in solved]
    return PairTable(
        thickness=np.array(H),
        height=np.array(height),
        apart=np.append(apart, apart[-1] + _VANISHED * H),
        depths=np.array([dent.depth for dent in dents]),
        fields=np.array(fields),
        sunk=np.array(sunk),
    )


def _pairs(
    stack: Stack, mechanics: Mechanics, indenter: Indenter, dents: list[Indentation], apart: float
) -> list[tuple[SmoothField, float]]:
    """Fields of pairs of presses of rising depth at a distance, and how much each sinks."""
    H, radius = stack.levels[-1], indenter.rims[1]
    outline = Rectangle(apart + 2.0 * _FREE * H, 2.0 * _FREE * H)
    y, places = _FREE * H, (_FREE * H, apart + _FREE * H)
    contacts = [(x, y, radius) for x in places]
    fineness = Fineness(ends=0.0, sides=0.0, layers=2)
    body = stack_mesh(outline, stack, mechanics, Rigid(), contacts, fineness)
    both, one = FiniteStack(body, 2), FiniteStack(body)
    found: list[tuple[SmoothField, float]] = []
    start, before = None, 0.0
    for dent in dents:
        first, second = (DentField(x, y, indenter, dent) for x in places)
        # Deep dents close together may turn the stack inside out before their correction.
        start = None if start is None else start * (dent.depth / before) ** 2
        pair = both.correction([first, second], start, dents_held=False)
        single = one.correction([first])
        start, before = pair.unknowns, dent.depth
        box = _box(apart, H, stack.sheets[stack.gel].thickness)
        change = _Change(pair, single, outline, apart, H)
        field = SmoothField.of(change, box, _COUNTS, _STRETCH)
        found.append((field, float(pair.sunk[0] - single.sunk[0])))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Change:
    """Correction of a pair less those of its presses alone, from the middle between them."""

    pair: Correction
    single: Correction
    outline: Rectangle
    apart: float
    thickness: float

    def __call__(self, points: Array) -> Array:
        length, width = self.outline.length, self.outline.width
        placed = points + np.array([0.5 * length, 0.5 * width, 0.0])
        mirrored = placed.copy()
        mirrored[..., 0] = length - placed[..., 0]
        image = self.single.in_gel(mirrored) * np.array([-1.0, 1.0, 1.0, 1.0])
        change: Array = self.pair.in_gel(placed) - self.single.in_gel(placed) - image
        H = self.thickness
        ends = (0.5 * self.apart + _REACH * H, _REACH * H)
        for axis, end in enumerate(ends):
            t = np.clip((end - np.abs(points[..., axis])) / (_FADE * H), 0.0, 1.0)
            change *= (t * t * (3.0 - 2.0 * t))[..., None]
        return change


def _box(apart: float, thickness: float, height: float) -> Box:
    """Box of the gel around a pair, from the middle between the presses."""
    along, across = 0.5 * apart + _REACH * thickness, _REACH * thickness
    return Box((-along, -across, 0.0), (along, across, height))


@dataclass(frozen=True, slots=True, eq=False)
class TurnedField:
    """Displacement field in a frame at (x, y), turned about z.

    Attributes:
        field: in its own frame.
        x, y: origin of the frame [m].
        cos, sin: of the angle from the sensor's x axis to the frame's.
    """

    field: SmoothField
    x: float
    y: float
    cos: float
    sin: float

    def values(self, columns: Array) -> Array:
        """Displacement [m] and mean stress [Pa], (4, h, n), at columns of points (n, h, 3) [m]."""
        found = self.field.values(self._within(columns))
        found[:2] = np.einsum("ij,jhn->ihn", self._turn[:2, :2], found[:2])
        return found

    def moved(self, columns: Array) -> Array:
        """Displacements and their derivatives by x, y, z, (12, h, n)."""
        near = self._near(columns)
        found = np.zeros((12, columns.shape[1], len(columns)))
        if not near.any():
            return found
        inner = self.field.moved(self._within(columns[near]))
        Q = self._turn
        found[:3, :, near] = np.einsum("ij,jhn->ihn", Q, inner[:3])
        slopes = inner[3:].reshape(3, 3, *inner.shape[1:])
        turned = np.einsum("ij,jkhn,lk->ilhn", Q, slopes, Q, optimize=True)
        found[3:, :, near] = turned.reshape(9, *inner.shape[1:])
        return found

    @property
    def _turn(self) -> Array:
        return np.array([[self.cos, -self.sin, 0.0], [self.sin, self.cos, 0.0], [0.0, 0.0, 1.0]])

    def _near(self, columns: Array) -> NDArray[np.bool_]:
        """Columns in the box of the field."""
        at, high = self._within(columns[:, :1])[:, 0], self.field.box.high
        near: NDArray[np.bool_] = (np.abs(at[:, 0]) < high[0]) & (np.abs(at[:, 1]) < high[1])
        return near

    def _within(self, columns: Array) -> Array:
        """Columns in the frame of the field."""
        within = columns - np.array([self.x, self.y, 0.0])
        turned: Array = within @ self._turn
        return turned
