"""Table of corrections of a press: over its position and depth on one stack."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import Support
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress, Indentation
from eitskin.simulator.mechanics.cubic_splines import CubicSplines, spline_weights
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.mechanics.processes import processes
from eitskin.simulator.presses.dent_field import DentField
from eitskin.simulator.presses.fields.smooth_field import Box, SmoothField
from eitskin.simulator.presses.finite_stack import Correction, FiniteStack
from eitskin.simulator.presses.stack_mesh import Contact, Fineness, StackMesh, stack_mesh
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]

# Lengths over the thickness of the stack.
DEPTHS = (0.1, 0.2, 0.32)
_ALONG = (0.0, 0.2, 0.45, 0.8, 1.25, 1.8, 2.5, 3.4, 4.5, 6.2)  # from a side, beyond the least
_REACH, _FADE = 9.0, 2.0  # of a correction along x, and the length over which it is faded out
_ENDS = 11.0  # length of the field at an end
_SHORTEST = 8.0  # sensor with two ends that do not feel each other
_CELL = 1.0 / 40.0  # finest of the axisymmetric press, over the radius of the indenter
_LEAST = 0.08  # of the thickness: from the rim of the contact to the side of the stack
_STRIP, _END = (40, 32, 4), (20, 16, 4)
_STRETCH = 2.5
# Corrections vary most at the sides beside a press. Near an end the strip's mesh would cost five
# times as much, and the difference to a strip of the same mesh needs less.
_ON_STRIP, _AT_END = Fineness(ends=0.0, sides=0.1, layers=2), Fineness(sides=0.0, layers=1)
_VANISHED = 2.0  # beyond the last distance from an end, over the thickness
SAME = 1e-9  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionTable:
    """Corrections of presses of one indenter on a rectangular sensor, by position and depth.

    On a long strip fields move along with their presses. Near an end comes the difference to the
    strip, in coordinates fixed to the end. Fields hold the displacement [m] and the mean stress
    [Pa] of the gel as polynomials (`SmoothField`).

    Attributes:
        thickness: of the whole stack, () [m].
        length, width, height: of the gel, () [m].
        aside: distances of solved presses from a long side, (m,) [m].
        depths: of solved presses, rising from 0, (d,) [m].
        strip: coefficients, (m, d - 1, nx, ny, nz, 4).
        sunk: by which presses sink deeper than in an unbounded stack, (m, d - 1) [m].
        along: distances of solved presses from an end, and one without difference, (l,) [m].
        ends: coefficients, (l - 1, m, d - 1, nx, ny, nz, 4).
        sunk_more: the difference to the strip near an end, (l - 1, m, d - 1) [m].
    """

    thickness: Array
    width: Array
    height: Array
    aside: Array
    depths: Array
    strip: Array
    sunk: Array
    length: Array
    along: Array
    ends: Array
    sunk_more: Array

    def at(self, x: float, y: float, depth: float) -> tuple[list[SmoothField], float]:
        """Fields of the correction of a press at (x, y) to a depth [m], and how much it sinks [m].

        The field of the strip comes first.
        """
        length, H = float(self.length), float(self.thickness)
        deep = weights_over_depth(self.depths, depth)
        across = across_strip(self.aside, float(self.width), y)
        weights = across[:, :, None] * deep
        field = self._field(self._box(-_REACH * H, _REACH * H), weights, self.strip, _STRETCH)
        fields, sunk = [field.shifted(x)], float(across.sum(axis=0) @ self.sunk @ deep)
        for distance, far in ((x, False), (length - x, True)):
            if distance < self.along[-1]:
                splines, ends, sunk_more = _along(self)
                near = splines.continued(np.array([distance]))[0]
                felt = np.flatnonzero(near)
                weights = near[felt, None, None] * (across[:, None, :, None] * deep)
                end = self._field(self._box(0.0, _ENDS * H), weights, ends[felt], 0.0)
                fields.append(end.mirrored(0, 0.5 * length) if far else end)
                sunk += float((weights.sum(axis=0) * sunk_more[felt]).sum())
        return fields, sunk

    def covers(self, x: float, y: float) -> bool:
        """Whether (x, y) is among the solved positions, at which the contact is on the stack."""
        x, y = min(x, float(self.length) - x), min(y, float(self.width) - y)
        return bool(x >= self.along[0] - SAME and y >= self.aside[0] - SAME)

    def _box(self, low: float, high: float) -> Box:
        return Box((low, 0.0, 0.0), (high, float(self.width), float(self.height)))

    def _field(self, box: Box, weights: Array, solved: Array, stretch: float) -> SmoothField:
        """Field by the weights of solved ones (..., nx, ny, nz, 4) and of their mirror images."""
        shape = solved.shape[-4:]
        # In the precision in which fields are kept, since reading them takes all the time.
        both = weights.reshape(2, -1).astype(solved.dtype) @ solved.reshape(-1, math.prod(shape))
        here, there = both.reshape(2, *shape)
        image = SmoothField(box, there, stretch).mirrored(1, 0.5 * float(self.width))
        return SmoothField(box, here + image.coefficients, stretch)


@lru_cache(maxsize=16)
def _along(table: CorrectionTable) -> tuple[CubicSplines, Array, Array]:
    """Splines over the distance from an end, and coefficients of `ends` and of `sunk_more`.

    Four splines do not vanish at a distance, so that less than half of a table is read.
    """
    splines = CubicSplines(table.along)
    fit = splines.fit[:, :-1]  # the last distance has no difference
    ends, sunk = (
        np.tensordot(fit.astype(each.dtype), each, (1, 0)) for each in (table.ends, table.sunk_more)
    )
    return splines, ends, sunk


Report = Callable[[int, int], None]
Field = Callable[[Array], Array]
Solved = tuple[Array, Array]
"""Coefficients of one position's fields, (d, nx, ny, nz, 4), and how much it sinks, (d,) [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Setting:
    """Stack and presses that all positions share."""

    width: float
    stack: Stack
    mechanics: Mechanics
    support: Support
    indenter: Indenter
    dents: tuple[Indentation, ...]

    @property
    def thickness(self) -> float:
        """Thickness of the whole stack [m]."""
        return self.stack.levels[-1]

    def box(self, low: float, high: float) -> Box:
        """Box of the gel between two x in thicknesses of the stack."""
        height = self.stack.sheets[self.stack.gel].thickness
        H = self.thickness
        return Box((low * H, 0.0, 0.0), (high * H, self.width, height))

    def solved(self, length: float, x: float, y: float, fineness: Fineness) -> list[Correction]:
        """Corrections of presses of rising depth at one position, each started from the last."""
        outline, radius = Rectangle(length, self.width), self.indenter.rims[1]
        body = stack_mesh(
            outline, self.stack, self.mechanics, self.support, [Contact(x, y, radius)], fineness
        )
        return rising_corrections(body, x, y, self.indenter, self.dents)

    def on_strip(self, fineness: Fineness, y: float) -> Solved:
        """Press at y on a long strip."""
        H = self.thickness
        middle = (_REACH + 1.0) * H
        found = self.solved(2.0 * middle, middle, y, fineness)
        shift, box = np.array([middle, 0.0, 0.0]), self.box(-_REACH, _REACH)
        fields = [
            SmoothField.of(_faded(each, shift, _REACH * H, H), box, _STRIP, _STRETCH)
            for each in found
        ]
        return np.array([f.coefficients for f in fields]), np.array([c.sunk[0] for c in found])

    def tabulated(self, aside: Array, strips: list[Solved]) -> dict[str, Array]:
        """Arrays of a table of presses on a strip."""
        return {
            "thickness": np.array(self.thickness),
            "width": np.array(self.width),
            "height": np.array(self.stack.sheets[self.stack.gel].thickness),
            "aside": aside,
            "depths": np.array([0.0, *(dent.depth for dent in self.dents)]),
            "strip": np.array([fields for fields, _ in strips]),
            "sunk": np.array([sunk for _, sunk in strips]),
        }

    def at_end(self, x: float, y: float, strip: Solved) -> Solved:
        """Difference of a press at a distance x from an end to that on an equally meshed strip."""
        H, box = self.thickness, self.box(-_REACH, _REACH)
        found = self.solved((_ENDS + 3.0) * H, x, y, _AT_END)
        far = [SmoothField(box, each, _STRETCH).shifted(x) for each in strip[0]]
        fields = [
            SmoothField.of(_difference(each, one, _ENDS * H, H), self.box(0.0, _ENDS), _END)
            for each, one in zip(found, far, strict=True)
        ]
        sunk = np.array([each.sunk[0] for each in found]) - strip[1]
        return np.array([f.coefficients for f in fields]), sunk


def solve_corrections(
    outline: Rectangle,
    stack: Stack,
    mechanics: Mechanics,
    support: Support,
    indenter: Indenter,
    report: Report | None = None,
    workers: int = 1,
) -> CorrectionTable:
    """Solve presses on a strip and near its end, at rising depths.

    Args:
        outline: of the gel.
        stack: the layers.
        mechanics: margin beside the gel, and its material.
        support: of the base, alike everywhere.
        indenter: rigid body that presses.
        report: called with the number of positions done and their total.
        workers: processes.

    Raises SolidError where a press is not carried.
    """
    H = stack.levels[-1]
    setting, aside = _setting(outline, stack, mechanics, support, indenter)
    along = aside[0] + H * np.array(_ALONG)
    total, done = len(aside) * (2 + len(along)), 0

    def solved(
        run: Callable[..., Iterable[Solved]], solve: Callable[..., Solved], *of: object
    ) -> list[Solved]:
        nonlocal done
        found = []
        for each in run(solve, *of):
            found.append(each)
            done += 1
            if report:
                report(done, total)
        return found

    with processes(workers) as run:
        strips = solved(run, partial(setting.on_strip, _ON_STRIP), aside.tolist())
        coarse = solved(run, partial(setting.on_strip, _AT_END), aside.tolist())
        positions = [(x, k) for x in along.tolist() for k in range(len(aside))]
        ends = solved(
            run,
            setting.at_end,
            [x for x, _ in positions],
            [float(aside[k]) for _, k in positions],
            [coarse[k] for _, k in positions],
        )
    grid = (len(along), len(aside))
    return CorrectionTable(
        **setting.tabulated(aside, strips),
        length=np.array(outline.length),
        along=np.append(along, along[-1] + _VANISHED * H),
        ends=np.array([f for f, _ in ends]).reshape(*grid, *ends[0][0].shape),
        sunk_more=np.array([sunk for _, sunk in ends]).reshape(*grid, -1),
    )


def _setting(
    outline: Rectangle, stack: Stack, mechanics: Mechanics, support: Support, indenter: Indenter
) -> tuple[_Setting, Array]:
    """Setting that all positions share, and the distances of presses from a side [m]."""
    H = stack.levels[-1]
    dents = dents_to(stack, indenter, [part * H for part in DEPTHS])
    setting = _Setting(outline.width, stack, mechanics, support, indenter, tuple(dents))
    least = least_distance(stack, mechanics, indenter)
    return setting, distances_from_side(least, H, 0.5 * outline.width)


def rising_corrections(
    body: StackMesh, x: float, y: float, indenter: Indenter, dents: Sequence[Indentation]
) -> list[Correction]:
    """Corrections of presses of rising depth at (x, y) [m], each started from the last."""
    stack, found = FiniteStack(body), list[Correction]()
    for number, dent in enumerate(dents):
        start = None
        if found:
            start = found[-1].unknowns * dent.depth / dents[number - 1].depth
        found.append(stack.correction([DentField(x, y, indenter, dent)], start))
    return found


def weights_over_depth(nodes: Array, depth: float) -> Array:
    """Weights of the solved depths but 0 in the polynomial through them and no press at 0."""
    return np.array(
        [
            math.prod((depth - other) / (own - other) for other in nodes.tolist() if other != own)
            for own in nodes[1:].tolist()
        ]
    )


def across_strip(nodes: Array, width: float, y: float) -> Array:
    """Spline weights (2, m), at y, of positions solved up to the middle and of their images."""
    middle = nodes[-1] > 0.5 * width - SAME
    beyond = (width - nodes)[::-1][int(middle) :]
    both = spline_weights(np.concatenate([nodes, beyond]), y)
    mirrored = np.zeros(len(nodes))
    mirrored[: len(beyond)] = both[len(nodes) :][::-1]
    direct = both[: len(nodes)]
    if middle:  # a press in the middle is its own image, but the mesh is not quite symmetric
        direct[-1] *= 0.5
        mirrored[-1] = direct[-1]
    return np.stack([direct, mirrored])


def least_distance(stack: Stack, mechanics: Mechanics, indenter: Indenter) -> float:
    """Distance of a press from a side of the gel, at which its contact is just on the stack [m]."""
    return max(indenter.rims[1] - mechanics.margin + _LEAST * stack.levels[-1], 0.0)


def dents_to(stack: Stack, indenter: Indenter, depths: Sequence[float]) -> list[Indentation]:
    """Axisymmetric presses to depths [m] on the unbounded stack."""
    press = AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1])
    return [press.to_depth(depth) for depth in depths]


def distances_from_side(least: float, thickness: float, middle: float) -> Array:
    """Distances from a side up to the middle, wider apart farther in [m]."""
    found = least + thickness * np.array(_ALONG)
    return np.append(found[found < middle - 0.25 * thickness], middle)


def _faded(correction: Correction, shift: Array, reach: float, H: float) -> Field:
    """Correction in coordinates from its press, faded out along x."""

    def field(points: Array) -> Array:
        values = correction.in_gel(points + shift)
        return values * _fade(np.abs(points[..., :1]), reach, H)

    return field


def _difference(correction: Correction, strip: SmoothField, reach: float, H: float) -> Field:
    """Correction near an end less that on the strip, faded out away from the end."""

    def field(points: Array) -> Array:
        columns = points.reshape(-1, points.shape[-2], 3)
        far = (
            np.moveaxis(strip.values(columns), 0, -1).swapaxes(0, 1).reshape(*points.shape[:-1], 4)
        )
        return (correction.in_gel(points) - far) * _fade(points[..., :1], reach, H)

    return field


def _fade(x: Array, reach: float, H: float) -> Array:
    """Smooth step from 1 to 0 over the last part of the reach."""
    t = np.clip((reach - x) / (_FADE * H), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
