"""Table of what the sides of a strip add to the change of two presses by each other."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.mechanics.processes import processes
from eitskin.simulator.presses.correction_table import across_strip, least_distance
from eitskin.simulator.presses.fields.smooth_field import Box, SmoothField, together
from eitskin.simulator.presses.pair_table import (
    PairChange,
    PairSetting,
    Place,
    PressPair,
    distances_apart,
    faded,
    near_weights,
    pair_setting,
)
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

# Lengths over the thickness of the stack. The part is smooth, and needs fewer pairs than on a wide
# stack.
_BESIDE, _DEEP_BESIDE = (1, 3, 5), 1  # of the distances and depths of `pair_table`
_ANGLES = 6  # directions in half a turn, of which more than a quarter turn follow by symmetry
_ASIDE = (0.0, 0.3, 1.0)  # of the way from the nearest side to the middle
_AROUND, _STRIP = 6.0, 9.0  # of the middle of the pair, along x: of the field, of the mesh
_COUNTS_BESIDE, _STRETCH, _FINER = (16, 14, 3), 1.5, 2  # polynomials, and how many are cut off
_SAME = 1e-9  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class PairSides:
    """Field that the sides of a strip add to the change of two presses by each other.

    It answers the tractions that the change leaves on the sides, and is smooth. It is tabulated at
    one depth; ends are left out, of which electrodes are far.

    Attributes:
        thickness: of the whole stack, () [m].
        width: of the gel, () [m].
        height: of the gel, () [m].
        apart: distances between the axes; at the last nothing is added, (r,) [m].
        depth: () [m].
        least: distance of a solved press from a side, () [m].
        sides: coefficients of `SmoothField`, by distance, direction (a quarter turn) and position,
            (r - 1, a, m, nx, ny, nz, 4).
    """

    thickness: Array
    width: Array
    height: Array
    apart: Array
    depth: Array
    least: Array
    sides: Array

    def at(self, first: Place, second: Place) -> SmoothField | None:
        """Field of presses (x, y, depth) [m]; None where they do not feel each other."""
        pair = PressPair.of(first, second)
        if pair.apart >= self.apart[-1]:
            return None
        width, least = float(self.width), float(self.least)
        deep = pair.product / float(self.depth) ** 2
        position = _aside(width, least, pair.apart, pair.angle, pair.y)
        across = across_strip(np.array(_ASIDE), 2.0, position)
        near = near_weights(self.apart, pair.apart)
        weights = deep * np.einsum("r,ka,lm->klram", near, _over_angle(pair.angle), across)
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
        return total.shifted(pair.x)


def solve_pair_sides(
    width: float, stack: Stack, mechanics: Mechanics, indenter: Indenter, workers: int = 1
) -> PairSides:
    """Solve what the sides of a strip, whose gel has a width [m], add to pairs of presses.

    Other arguments and errors as for `solve_pairs`.
    """
    setting = pair_setting(stack, mechanics, indenter)
    strip = _Strip(width, least_distance(stack, mechanics, indenter), setting)
    apart = distances_apart(stack, indenter)
    angles = [k * math.pi / _ANGLES for k in range(_ANGLES // 2 + 1)]
    grid = list(product((float(apart[k]) for k in _BESIDE), angles))
    with processes(workers) as run:
        sides = np.array(list(run(strip.added, *zip(*grid, strict=True))))
    return PairSides(
        thickness=np.array(stack.levels[-1]),
        width=np.array(width),
        height=np.array(stack.sheets[stack.gel].thickness),
        apart=apart[[*_BESIDE, -1]],
        depth=np.array(setting.dents[_DEEP_BESIDE].depth),
        least=np.array(strip.least),
        sides=sides.reshape(len(_BESIDE), len(angles), *sides.shape[1:]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Strip:
    """Strip whose gel has a width [m], on which presses keep a least distance from a side [m]."""

    width: float
    least: float
    pairs: PairSetting

    def added(self, apart: float, angle: float) -> Array:
        """Coefficients of what the sides add to pairs in one direction, (m, nx, ny, nz, 4).

        Zero where such pairs have no room.
        """
        stack, half = self.pairs.stack, 0.5 * self.width
        H, height = stack.levels[-1], stack.sheets[stack.gel].thickness
        found = np.zeros((len(_ASIDE), *_COUNTS_BESIDE, 4))
        low = _lowest(self.least, apart, angle)
        if low > half:
            return found
        dents = self.pairs.dents[_DEEP_BESIDE : _DEEP_BESIDE + 1]
        (wide,) = self.pairs.changes(*self.pairs.wide(apart, angle), apart, angle, dents)
        outline, box = Rectangle(2.0 * _STRIP * H, self.width), _strip_box(self.width, H, height)
        finer = (_FINER * _COUNTS_BESIDE[0], _FINER * _COUNTS_BESIDE[1], _COUNTS_BESIDE[2])
        for k, aside in enumerate(_ASIDE):
            middle = (_STRIP * H, low + aside * (half - low))
            (beside,) = self.pairs.changes(outline, middle, apart, angle, dents)
            added = _Added(beside, wide, np.array([0.0, middle[1], 0.0]))
            field = SmoothField.of(faded(added, (_AROUND * H, math.inf), H), box, finer, _STRETCH)
            found[k] = field.coefficients[tuple(slice(count) for count in _COUNTS_BESIDE)]
        return found


@dataclass(frozen=True, slots=True, eq=False)
class _Added:
    """Difference of the change on a strip to that on a wide stack."""

    beside: PairChange
    wide: PairChange
    middle: Array

    def __call__(self, points: Array) -> Array:
        return self.beside(points - self.middle) - self.wide(points - self.middle)


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


def _strip_box(width: float, thickness: float, height: float) -> Box:
    """Box of the gel of a strip around a pair, from its middle along x."""
    return Box((-_AROUND * thickness, 0.0, 0.0), (_AROUND * thickness, width, height))
