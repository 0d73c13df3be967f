"""Tables of pairs: how two presses side by side change each other's dents."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import Rigid
from eitskin.simulator.mechanics.axisymmetric_press import Indentation
from eitskin.simulator.mechanics.cubic_splines import spline_weights
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.mechanics.processes import processes
from eitskin.simulator.presses.correction_table import (
    dents_to,
)
from eitskin.simulator.presses.dent_field import DentField
from eitskin.simulator.presses.fields.spline_field import SplineField
from eitskin.simulator.presses.fields.turned_field import TurnedField
from eitskin.simulator.presses.finite_stack import Correction, FiniteStack
from eitskin.simulator.presses.stack_mesh import Contact, Fineness, stack_mesh
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

# Lengths over the thickness of the stack; distances are between the rims of the indenters.
_DEPTHS = (0.16, 0.23, 0.3)
_APART = (0.25, 0.45, 0.8, 1.25, 1.9, 2.8)
_VANISHED = 1.4  # beyond the last distance
_REACH, _FADE, _FREE = 4.5, 1.5, 6.5  # beyond the axes: of the field, of its end, of the mesh
# Splines of the change on a wide stack, which varies most near the contacts: to this distance
# beyond the axes cells are even, farther out they grow. Numbers of cells in a half, along x and y.
_EVEN, _GROWTH, _DEGREE = 1.0, 1.5, 2
_CELLS = ((10, 6), (6, 6))
_FINENESS = Fineness(ends=0.0, sides=0.0, layers=1)


Place = tuple[float, float, float]
"""Position and depth (x, y, depth) of a press [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class PairTable:
    """Change of displacement and mean stress by a second press, on a wide stack.

    Pairs are solved with equal indenters and depths. To leading order the change is bilinear in
    both depths, so that unequal ones are scaled by their product.

    Attributes:
        thickness: of the whole stack, () [m].
        height: of the gel, () [m].
        apart: distances between the axes; at the last nothing changes, (r,) [m].
        depths: (d,) [m].
        fields: coefficients of `SplineField` in the frame of the pair, x from press to press,
            (r - 1, d, nx, ny, nz, 4).
        sunk: by which each press sinks deeper, (r - 1, d) [m].
    """

    thickness: Array
    height: Array
    apart: Array
    depths: Array
    fields: Array
    sunk: Array

    def at(self, first: Place, second: Place) -> tuple[TurnedField, float] | None:
        """Field of presses (x, y, depth) [m], and by how much deeper each sinks [m].

        None where the presses do not feel each other.
        """
        pair = PressPair.of(first, second)
        if pair.apart >= self.apart[-1]:
            return None
        weights = _over_depth(self.depths, pair.product)
        near = near_weights(self.apart, pair.apart)
        shape = self.fields.shape[2:]
        amounts = np.outer(near, weights).ravel().astype(self.fields.dtype)
        fields = (amounts @ self.fields.reshape(-1, math.prod(shape))).reshape(shape)
        nodes = _nodes(max(pair.apart, float(self.apart[0])), float(self.thickness))
        field = SplineField(nodes, float(self.height), fields)
        wide = TurnedField(field, pair.x, pair.y, math.cos(pair.angle), math.sin(pair.angle))
        return wide, float(near @ self.sunk @ weights)


class PressPair(NamedTuple):
    """Middle of two presses, their distance [m], direction, and the product of their depths."""

    x: float
    y: float
    apart: float
    angle: float
    product: float

    @classmethod
    def of(cls, first: Place, second: Place) -> "PressPair":
        """Pair of two presses."""
        (x, y, deep), (x_other, y_other, beside) = first, second
        angle = math.atan2(y_other - y, x_other - x)
        apart = math.dist((x, y), (x_other, y_other))
        return cls(0.5 * (x + x_other), 0.5 * (y + y_other), apart, angle, deep * beside)


def near_weights(nodes: Array, apart: float) -> Array:
    """Weights of solved distances but the last, at which nothing changes."""
    apart = max(apart, float(nodes[0]))
    return spline_weights(np.log(nodes), math.log(apart))[:-1]


def solve_pairs(
    stack: Stack, mechanics: Mechanics, indenter: Indenter, workers: int = 1
) -> PairTable:
    """Solve pairs of equal presses on a wide stack, in several processes.

    Args:
        stack: the layers.
        mechanics: margin beside the gel, and its material.
        indenter: rigid body that presses.
        workers: processes.

    Raises SolidError where one is not carried.
    """
    setting = pair_setting(stack, mechanics, indenter)
    apart = distances_apart(stack, indenter)
    with processes(workers) as run:
        wide = list(run(setting.on_wide, apart[:-1].tolist()))
    return PairTable(
        thickness=np.array(stack.levels[-1]),
        height=np.array(stack.sheets[stack.gel].thickness),
        apart=apart,
        depths=np.array([dent.depth for dent in setting.dents]),
        fields=np.array([[field.coefficients for field in fields] for fields, _ in wide]),
        sunk=np.array([sunk for _, sunk in wide]),
    )


def distances_apart(stack: Stack, indenter: Indenter) -> Array:
    """Distances between the axes of solved pairs, and one at which nothing changes [m]."""
    H = stack.levels[-1]
    solved = 2.0 * indenter.rims[1] + H * np.array(_APART)
    return np.append(solved, solved[-1] + _VANISHED * H)


def pair_setting(stack: Stack, mechanics: Mechanics, indenter: Indenter) -> "PairSetting":
    """Stack and presses that all pairs share."""
    dents = dents_to(stack, indenter, [part * stack.levels[-1] for part in _DEPTHS])
    return PairSetting(stack, mechanics, indenter, tuple(dents))


@dataclass(frozen=True, slots=True, eq=False)
class PairSetting:
    """Stack and presses that all pairs share."""

    stack: Stack
    mechanics: Mechanics
    indenter: Indenter
    dents: tuple[Indentation, ...]

    def on_wide(self, apart: float) -> tuple[list[SplineField], list[float]]:
        """Fields of pairs of rising depth on a wide stack, and by how much deeper each sinks."""
        H, height = self.stack.levels[-1], self.stack.sheets[self.stack.gel].thickness
        outline, middle = self.wide(apart, 0.0)
        fields, sunk = [], []
        for change in self.changes(outline, middle, apart, 0.0, self.dents):
            ending = faded(change, (0.5 * apart + _REACH * H, _REACH * H), H)
            fields.append(SplineField.of(ending, _nodes(apart, H), height, _DEGREE))
            sunk.append(change.sunk)
        return fields, sunk

    def wide(self, apart: float, angle: float) -> tuple[Rectangle, tuple[float, float]]:
        """Wide stack around a pair, and where the middle of the pair is on it [m]."""
        free = _FREE * self.stack.levels[-1]
        half = [0.5 * apart * abs(way) + free for way in (math.cos(angle), math.sin(angle))]
        return Rectangle(2.0 * half[0], 2.0 * half[1]), (half[0], half[1])

    def changes(
        self,
        outline: Rectangle,
        middle: tuple[float, float],
        apart: float,
        angle: float,
        dents: Sequence[Indentation],
    ) -> "Iterator[PairChange]":
        """Changes of two presses by each other at rising depths, on an outline."""
        x, y = 0.5 * apart * math.cos(angle), 0.5 * apart * math.sin(angle)
        places = [(middle[0] + way * x, middle[1] + way * y) for way in (-1.0, 1.0)]
        contacts = [Contact(*place, self.indenter.rims[1]) for place in places]
        body = stack_mesh(outline, self.stack, self.mechanics, Rigid(), contacts, _FINENESS)
        both, one = FiniteStack(body, 2), FiniteStack(body)
        starts: list[Array | None] = [None] * 3
        before = 1.0
        for dent in dents:
            fields = [DentField(*place, self.indenter, dent) for place in places]
            # Deep dents close together may turn the stack inside out before their correction.
            given = [None if x is None else x * (dent.depth / before) ** 2 for x in starts]
            pair = both.correction(fields, given[0])
            alone = [
                one.correction([field], start)
                for field, start in zip(fields, given[1:], strict=True)
            ]
            starts, before = [each.unknowns for each in (pair, *alone)], dent.depth
            yield PairChange(pair, alone, np.array([*middle, 0.0]))


@dataclass(frozen=True, slots=True, eq=False)
class PairChange:
    """Correction of a pair less those of its presses alone, from the middle between them [m]."""

    pair: Correction
    alone: list[Correction]
    middle: Array

    @property
    def sunk(self) -> float:
        """By which each press sinks deeper, in the mean [m]."""
        return float(np.mean(self.pair.sunk - [each.sunk[0] for each in self.alone]))

    def __call__(self, points: Array) -> Array:
        placed = points + self.middle
        found: Array = self.pair.in_gel(placed)
        for each in self.alone:
            found -= each.in_gel(placed)
        return found


def faded(
    field: Callable[[Array], Array], ends: tuple[float, float], thickness: float
) -> Callable[[Array], Array]:
    """Field that is faded out towards ends along x and y, from the origin [m]."""

    def faded(points: Array) -> Array:
        values = field(points)
        for axis, end in enumerate(ends):
            t = np.clip((end - np.abs(points[..., axis])) / (_FADE * thickness), 0.0, 1.0)
            values *= (t * t * (3.0 - 2.0 * t))[..., None]
        return values

    return faded


def _over_depth(depths: Array, product: float) -> Array:
    """Weights of the changes at solved depths for a product of two [m2].

    Over the product of the depths the change is constant up to the least solved depth, and a
    polynomial beyond.
    """
    deep = max(math.sqrt(product), float(depths[0]))
    others = [np.delete(depths, k) for k in range(len(depths))]
    weights: Array = product * np.array(
        [
            np.prod((deep - other) / (own - other)) / own**2
            for own, other in zip(depths, others, strict=True)
        ]
    )
    return weights


def _nodes(apart: float, thickness: float) -> tuple[Array, Array]:
    """Nodes of the splines along x and y, from the middle between the presses [m]."""
    halves = []
    for axis, (even, growing) in zip((0.5 * apart, 0.0), _CELLS, strict=True):
        first, end = axis + _EVEN * thickness, axis + _REACH * thickness
        grown = np.expm1(_GROWTH * np.linspace(0.0, 1.0, growing + 1)[1:]) / np.expm1(_GROWTH)
        half = np.append(np.linspace(0.0, first, even + 1), first + (end - first) * grown)
        halves.append(np.append(-half[:0:-1], half))
    return halves[0], halves[1]
