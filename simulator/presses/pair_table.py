"""Table of pairs: how two presses side by side change each other's dents."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.support import Rigid
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress, Indentation
from eitskin.simulator.mechanics.cubic_splines import spline_weights
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.presses.correction_table import (
    across_strip,
    least_distance,
)
from eitskin.simulator.presses.dent_field import DentField
from eitskin.simulator.presses.finite_stack import Correction, FiniteStack
from eitskin.simulator.presses.processes import processes
from eitskin.simulator.presses.smooth_field import Box, SmoothField, together
from eitskin.simulator.presses.spline_field import SplineField
from eitskin.simulator.presses.stack_mesh import Contact, Fineness, stack_mesh
from eitskin.simulator.presses.turned_field import TurnedField
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

# Lengths over the thickness of the stack; distances are between the rims of the indenters.
_DEPTHS = (0.16, 0.23, 0.3)
_APART = (0.25, 0.45, 0.8, 1.25, 1.9, 2.8)
_VANISHED = 1.4  # beyond the last distance
_REACH, _FADE, _FREE = 4.5, 1.5, 6.5  # beyond the axes: of the field, of its end, of the mesh
_CELL = 1.0 / 40.0  # finest of the axisymmetric press, over the radius of the indenter
# Splines of the change on a wide stack, which varies most near the contacts: to this distance
# beyond the axes cells are even, farther out they grow. Numbers of cells in a half, along x and y.
_EVEN, _GROWTH, _DEGREE = 1.0, 1.5, 2
_CELLS = ((10, 6), (6, 6))
_FINENESS = Fineness(ends=0.0, sides=0.0, layers=1)

# The part that the sides of the sensor add is smooth, and needs fewer pairs.
_BESIDE, _DEEP_BESIDE = (1, 3, 5), 1  # of the distances and depths above
_ANGLES = 6  # directions in half a turn, of which more than a quarter turn follow by symmetry
_ASIDE = (0.0, 0.3, 1.0)  # of the way from the nearest side to the middle
_AROUND, _STRIP = 6.0, 9.0  # of the middle of the pair, along x: of the field, of the mesh
_COUNTS_BESIDE, _STRETCH, _FINER = (16, 14, 3), 1.5, 2  # polynomials, and how many are cut off
_SAME = 1e-9  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class PairTable:
    """Change of displacement and mean stress by a second press: on a wide stack, and by the sides.

    Pairs are solved with equal indenters and depths. To leading order the change is bilinear in
    both depths, so that unequal ones are scaled by their product. On a strip the tractions that the
    change leaves on the sides are answered by a smooth field, which is tabulated over the distance,
    direction and position of the pair; ends are left out, of which electrodes are far.

    Attributes:
        thickness: of the whole stack, () [m].
        width: of the gel, () [m].
        height: of the gel, () [m].
        apart: distances between the axes; at the last nothing changes, (r,) [m].
        depths: (d,) [m].
        fields: coefficients of `SplineField` in the frame of the pair, x from press to press,
            (r - 1, d, nx, ny, nz, 4).
        sunk: by which each press sinks deeper, (r - 1, d) [m].
        least: distance of a solved press from a side, () [m].
        sides: coefficients of `SmoothField`, of what the sides add at one depth, by distance,
            direction (a quarter turn) and position, (r', a, m, nx, ny, nz, 4).
    """

    thickness: Array
    width: Array
    height: Array
    apart: Array
    depths: Array
    fields: Array
    sunk: Array
    least: Array
    sides: Array

    def at(
        self, first: tuple[float, float, float], second: tuple[float, float, float]
    ) -> tuple[tuple[TurnedField, SmoothField], float] | None:
        """Fields of presses (x, y, depth) [m], and by how much deeper each sinks [m].

        None where the presses do not feel each other.
        """
        (x, y, deep), (x_other, y_other, beside) = first, second
        apart = math.dist((x, y), (x_other, y_other))
        if apart >= self.apart[-1]:
            return None
        cos, sin = (x_other - x) / apart, (y_other - y) / apart
        x, y = 0.5 * (x + x_other), 0.5 * (y + y_other)
        weights = _over_depth(self.depths, deep * beside)
        near = self._near(self.apart, apart)
        shape = self.fields.shape[2:]
        amounts = np.outer(near, weights).ravel().astype(self.fields.dtype)
        fields = (amounts @ self.fields.reshape(-1, math.prod(shape))).reshape(shape)
        nodes = _nodes(max(apart, float(self.apart[0])), float(self.thickness))
        wide = TurnedField(SplineField(nodes, float(self.height), fields), x, y, cos, sin)
        sides = self._beside(apart, math.atan2(sin, cos), y, deep * beside).shifted(x)
        return (wide, sides), float(near @ self.sunk @ weights)

    def _near(self, nodes: Array, apart: float) -> Array:
        """Weights of solved distances but the last, at which nothing changes."""
        apart = max(apart, float(nodes[0]))
        return spline_weights(np.log(nodes), math.log(apart))[:-1]

    def _beside(self, apart: float, angle: float, y: float, product: float) -> SmoothField:
        """Field that the sides add to a pair whose middle is at (0, y) [m]."""
        width, least = float(self.width), float(self.least)
        near = self._near(np.append(self.apart[list(_BESIDE)], self.apart[-1]), apart)
        deep = product / float(self.depths[_DEEP_BESIDE]) ** 2
        across = across_strip(np.array(_ASIDE), 2.0, _aside(width, least, apart, angle, y))
        weights = deep * np.einsum("r,ka,lm->klram", near, _over_angle(angle), across)
        shape = self.sides.shape[-4:]
        amounts = weights.reshape(4, -1).astype(self.sides.dtype)
        parts = amounts @ self.sides.reshape(-1, math.prod(shape))
        box = _strip_box(width, float(self.thickness), float(self.height))
        half = 0.5 * width
        # The mirror image along x of a pair is that at the opposite angle. Turned by half a turn, a
        # pair is the same at the same distance from the other side.
        images: tuple[Callable[[SmoothField], SmoothField], ...] = (
            lambda field: field,
            lambda field: field.mirrored(0, 0.0).mirrored(1, half),
            lambda field: field.mirrored(0, 0.0),
            lambda field: field.mirrored(1, half),
        )
        (total,) = together(
            image(SmoothField(box, part.reshape(shape), _STRETCH))
            for image, part in zip(images, parts, strict=True)
        )
        return total


def solve_pairs(
    width: float, stack: Stack, mechanics: Mechanics, indenter: Indenter, workers: int = 1
) -> PairTable:
    """Solve pairs of equal presses on a wide stack, and what a strip adds, in several processes.

    Args:
        width: of the gel of the strip [m].
        stack: the layers.
        mechanics: margin beside the gel, and its material.
        indenter: rigid body that presses.
        workers: processes.

    Raises SolidError where one is not carried.
    """
    H, height = stack.levels[-1], stack.sheets[stack.gel].thickness
    press = AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1])
    dents = [press.to_depth(part * H) for part in _DEPTHS]
    depths = np.array([dent.depth for dent in dents])
    apart = 2.0 * indenter.rims[1] + H * np.array(_APART)
    least = least_distance(stack, mechanics, indenter)
    setting = _Setting(width, least, stack, mechanics, indenter, tuple(dents))
    angles = [k * math.pi / _ANGLES for k in range(_ANGLES // 2 + 1)]
    grid = list(product((float(apart[k]) for k in _BESIDE), angles))
    with processes(workers) as run:
        wide = list(run(setting.on_wide, apart.tolist()))
        sides = np.array(list(run(setting.on_strip, *zip(*grid, strict=True))))
    return PairTable(
        thickness=np.array(H),
        width=np.array(width),
        height=np.array(height),
        apart=np.append(apart, apart[-1] + _VANISHED * H),
        depths=depths,
        fields=np.array([[field.coefficients for field in fields] for fields, _ in wide]),
        sunk=np.array([sunk for _, sunk in wide]),
        least=np.array(least),
        sides=sides.reshape(len(_BESIDE), len(angles), *sides.shape[1:]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Setting:
    """Stack and presses that all pairs share."""

    width: float
    least: float
    stack: Stack
    mechanics: Mechanics
    indenter: Indenter
    dents: tuple[Indentation, ...]

    def on_wide(self, apart: float) -> tuple[list[SplineField], list[float]]:
        """Fields of pairs of rising depth on a wide stack, and by how much deeper each sinks."""
        H, height = self.stack.levels[-1], self.stack.sheets[self.stack.gel].thickness
        outline, middle = self._wide(apart, 0.0)
        fields, sunk = [], []
        for change in self._changes(outline, middle, apart, 0.0, self.dents):
            faded = _faded(change, (0.5 * apart + _REACH * H, _REACH * H), H)
            fields.append(SplineField.of(faded, _nodes(apart, H), height, _DEGREE))
            sunk.append(change.sunk)
        return fields, sunk

    def on_strip(self, apart: float, angle: float) -> Array:
        """Coefficients of what the sides add to pairs in one direction, (m, nx, ny, nz, 4).

        Zero where such pairs have no room.
        """
        H, height = self.stack.levels[-1], self.stack.sheets[self.stack.gel].thickness
        found = np.zeros((len(_ASIDE), *_COUNTS_BESIDE, 4))
        low, half = _lowest(self.least, apart, angle), 0.5 * self.width
        if low > half:
            return found
        dents = self.dents[_DEEP_BESIDE : _DEEP_BESIDE + 1]
        (wide,) = self._changes(*self._wide(apart, angle), apart, angle, dents)
        outline, box = Rectangle(2.0 * _STRIP * H, self.width), _strip_box(self.width, H, height)
        finer = (_FINER * _COUNTS_BESIDE[0], _FINER * _COUNTS_BESIDE[1], _COUNTS_BESIDE[2])
        for k, aside in enumerate(_ASIDE):
            middle = (_STRIP * H, low + aside * (half - low))
            (beside,) = self._changes(outline, middle, apart, angle, dents)
            added = _Added(beside, wide, np.array([0.0, middle[1], 0.0]))
            field = SmoothField.of(_faded(added, (_AROUND * H, math.inf), H), box, finer, _STRETCH)
            found[k] = field.coefficients[tuple(slice(count) for count in _COUNTS_BESIDE)]
        return found

    def _wide(self, apart: float, angle: float) -> tuple[Rectangle, tuple[float, float]]:
        """Wide stack around a pair, and where the middle of the pair is on it [m]."""
        free = _FREE * self.stack.levels[-1]
        half = [0.5 * apart * abs(way) + free for way in (math.cos(angle), math.sin(angle))]
        return Rectangle(2.0 * half[0], 2.0 * half[1]), (half[0], half[1])

    def _changes(
        self,
        outline: Rectangle,
        middle: tuple[float, float],
        apart: float,
        angle: float,
        dents: Sequence[Indentation],
    ) -> "Iterator[_Change]":
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
            yield _Change(pair, alone, np.array([*middle, 0.0]))


@dataclass(frozen=True, slots=True, eq=False)
class _Change:
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


@dataclass(frozen=True, slots=True, eq=False)
class _Added:
    """Difference of the change on a strip to that on a wide stack."""

    beside: _Change
    wide: _Change
    middle: Array

    def __call__(self, points: Array) -> Array:
        return self.beside(points - self.middle) - self.wide(points - self.middle)


def _faded(
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


def _over_angle(angle: float) -> Array:
    """Weights of the solved directions and of their mirror images along x, (2, a).

    They are those of the trigonometric polynomial over half a turn.
    """
    nodes = np.arange(_ANGLES) * math.pi / _ANGLES
    waves = np.arange(1, _ANGLES // 2)[:, None]
    from_node = 2.0 * (angle - nodes)
    weights = 1.0 + 2.0 * np.cos(waves * from_node).sum(axis=0)
    weights = (weights + np.cos(_ANGLES // 2 * from_node)) / _ANGLES
    found = np.zeros((2, _ANGLES // 2 + 1))
    found[0] = weights[: _ANGLES // 2 + 1]
    found[1, 1:-1] = weights[_ANGLES // 2 + 1 :][::-1]
    return found


def _lowest(least: float, apart: float, angle: float) -> float:
    """Least distance from a side of the middle of a pair [m]."""
    return least + 0.5 * apart * abs(math.sin(angle))


def _aside(width: float, least: float, apart: float, angle: float, y: float) -> float:
    """Position of a pair's middle: 0 where it is nearest to a side, 1 in the middle, 2 opposite."""
    low = _lowest(least, apart, angle)
    return min(max((y - low) / max(0.5 * width - low, _SAME), 0.0), 2.0)


def _nodes(apart: float, thickness: float) -> tuple[Array, Array]:
    """Nodes of the splines along x and y, from the middle between the presses [m]."""
    halves = []
    for axis, (even, growing) in zip((0.5 * apart, 0.0), _CELLS, strict=True):
        first, end = axis + _EVEN * thickness, axis + _REACH * thickness
        grown = np.expm1(_GROWTH * np.linspace(0.0, 1.0, growing + 1)[1:]) / np.expm1(_GROWTH)
        half = np.append(np.linspace(0.0, first, even + 1), first + (end - first) * grown)
        halves.append(np.append(-half[:0:-1], half))
    return halves[0], halves[1]


def _strip_box(width: float, thickness: float, height: float) -> Box:
    """Box of the gel of a strip around a pair, from its middle along x."""
    return Box((-_AROUND * thickness, 0.0, 0.0), (_AROUND * thickness, width, height))
