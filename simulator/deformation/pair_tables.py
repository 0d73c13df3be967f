"""Tables of pairs of indentations: what is solved on a wide stack and next to sides."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import Rigid
from eitskin.simulator.deformation.contact import DentField
from eitskin.simulator.deformation.field import CubicSplines, Field, Polynomials
from eitskin.simulator.deformation.finite_stack import FiniteStack
from eitskin.simulator.deformation.indentation_tables import (
    Bases,
    Indentations,
    PressFields,
    fade_at_box,
    solve_each,
    tabulate,
)
from eitskin.simulator.deformation.solution_store import Report
from eitskin.simulator.deformation.solution_table import Axis, SolutionTable
from eitskin.simulator.deformation.solved_correction import Correction
from eitskin.simulator.mechanics.layer_stack import Indentation
from eitskin.simulator.mechanics.stack_mesh import Fineness

Array = NDArray[np.float64]

# Lengths over the thickness of the stack.
#
# Pairs, at distances between the rims of the indenters; the field reaches beyond the axes. The
# change varies most near the contacts: to a distance beyond the axes cells are even, farther out
# they grow. Numbers of cells in a half are along x and y.
_PAIR_DEPTHS, _APART, _PAIR_VANISHED = (0.16, 0.23, 0.3), (0.25, 0.45, 0.8, 1.25, 1.9, 2.8), 1.4
_PAIR_REACH, _PAIR_FADE, _PAIR_FREE = 4.5, 1.5, 6.5
_PAIR_EVEN, _PAIR_GROWTH, _PAIR_DEGREE, _PAIR_CELLS = 1.0, 1.5, 2, ((10, 6), (6, 6))
_PAIR_FINENESS = Fineness(ends=0.0, sides=0.0, layers=1)

# The change of pairs by sides is smooth, and needs fewer distances and depths.
_SIDES_APART, _SIDES_DEPTH = (1, 3, 5), 1
_QUARTER = 3  # parts of a quarter turn; more directions follow by symmetry
_FROM_SIDES = (0.0, 0.3, 1.0)  # of the way from the nearest side to the middle
PAIR_STRETCH, PAIR_AROUND = 1.5, 6.0  # of the field along x
_PAIR_STRIP = 9.0  # half of the mesh along x
_COUNTS_BESIDE, _FINER = (16, 14, 3), 2  # polynomials, and how many are cut off


def solve_pair(case: Indentations, report: Report, workers: int = 1) -> SolutionTable:
    """Change of displacement and mean stress by a second press on a wide stack.

    Pairs are solved with equal indenters and depths. To leading order the change is bilinear in
    both depths, so that unequal ones are scaled by their product. Fields are in the frame of the
    pair, x from press to press.
    """
    case = case.with_depths(_PAIR_DEPTHS)
    apart = _pair_axis(case)
    solved = solve_each(partial(_on_wide, case), report, workers, apart.nodes[:-1].tolist())
    product_axis = Axis("product", "bilinear", case.depth_axis.nodes)
    return tabulate(case, [apart, product_axis], solved)


def _pair_axis(case: Indentations) -> Axis:
    """Distances between the axes of solved pairs, and one at which nothing changes [m]."""
    H = case.thickness
    solved = 2.0 * case.indenter.rims[1] + H * np.array(_APART)
    nodes = np.append(solved, solved[-1] + _PAIR_VANISHED * H)
    return Axis("axis_distance", "logarithmic", nodes)


def pair_bases(spacing: float, thickness: float) -> Bases:
    """Splines along x and y, from the middle between presses at a distance [m]."""
    halves = []
    for axis, (even, growing) in zip((0.5 * spacing, 0.0), _PAIR_CELLS, strict=True):
        first, end = axis + _PAIR_EVEN * thickness, axis + _PAIR_REACH * thickness
        grown = np.expm1(_PAIR_GROWTH * np.linspace(0.0, 1.0, growing + 1)[1:])
        outer = first + (end - first) * grown / np.expm1(_PAIR_GROWTH)
        half = np.append(np.linspace(0.0, first, even + 1), outer)
        halves.append(np.append(-half[:0:-1], half))
    return CubicSplines(halves[0]), CubicSplines(halves[1])


def _on_wide(case: Indentations, spacing: float) -> PressFields:
    """Fields of pairs on a wide stack, and by how much deeper each press sinks."""
    H = case.thickness
    outline, middle = _wide(case, spacing, 0.0)
    end, bases = np.array([0.5 * spacing, 0.0]) + _PAIR_REACH * H, pair_bases(spacing, H)
    fields, extra = [], []
    for change in _changes(case, outline, middle, spacing, 0.0, case.dents):
        ending = partial(_ending, change, end, _PAIR_FADE * H)
        field = Field.from_function(ending, bases, case.height, _PAIR_DEGREE)
        fields.append(field.coefficients)
        extra.append(change.extra_depth)
    return PressFields(np.array(fields), np.array(extra))


def _wide(case: Indentations, apart: float, angle: float) -> tuple[Rectangle, tuple[float, float]]:
    """Wide stack around a pair, and where the middle of the pair is on it [m]."""
    free = _PAIR_FREE * case.thickness
    half = [0.5 * apart * abs(way) + free for way in (math.cos(angle), math.sin(angle))]
    return Rectangle(2.0 * half[0], 2.0 * half[1]), (half[0], half[1])


@dataclass(frozen=True, slots=True, eq=False)
class PairChange:
    """Correction of a pair less those of its presses alone, from the middle between them [m]."""

    pair: Correction
    alone: list[Correction]
    middle: Array

    @property
    def extra_depth(self) -> float:
        """By which each press sinks deeper, in the mean [m]."""
        return float(np.mean(self.pair.sunk - [each.sunk[0] for each in self.alone]))

    def __call__(self, points: Array) -> Array:
        placed = points + self.middle
        change: Array = self.pair.in_gel(placed)
        for each in self.alone:
            change -= each.in_gel(placed)
        return change


def _changes(
    case: Indentations,
    outline: Rectangle,
    middle: tuple[float, float],
    spacing: float,
    angle: float,
    dents: Sequence[Indentation],
) -> Iterator[PairChange]:
    """Changes of two presses by each other at rising depths, on an outline on a rigid base."""
    x, y = 0.5 * spacing * math.cos(angle), 0.5 * spacing * math.sin(angle)
    places = [(middle[0] + way * x, middle[1] + way * y) for way in (-1.0, 1.0)]
    body = replace(case, support=Rigid()).mesh(outline, places, _PAIR_FINENESS)
    pair_stack, one = FiniteStack(body, 2), FiniteStack(body)
    starts: list[Array | None] = [None] * 3
    before = 1.0
    for dent in dents:
        fields = [DentField(*place, case.indenter, dent) for place in places]
        # Deep dents close together may turn the stack inside out before their correction.
        given = [None if x is None else x * (dent.depth / before) ** 2 for x in starts]
        pair = pair_stack.correction(fields, given[0])
        alone = [
            one.correction([field], start) for field, start in zip(fields, given[1:], strict=True)
        ]
        starts, before = [each.unknowns for each in (pair, *alone)], dent.depth
        yield PairChange(pair, alone, np.array([*middle, 0.0]))


def solve_pair_sides(
    case: Indentations, width: float, report: Report, workers: int = 1
) -> SolutionTable:
    """Fields that the sides of a strip add to the change of two presses by each other.

    It answers the tractions that the change leaves on the sides, and is smooth. It is tabulated at
    one depth; ends are left out, of which electrodes are far. Fields are from the middle of the
    pair along x. Places are 0 where the pair is nearest to a side, and 1 in the middle.
    """
    case = case.with_depths(_PAIR_DEPTHS)
    every = _pair_axis(case).nodes
    apart = Axis("axis_distance", "logarithmic", every[[*_SIDES_APART, -1]])
    directions = Axis("direction", "direction", np.arange(_QUARTER + 1) * math.pi / 2 / _QUARTER)
    grid = list(product(apart.nodes[:-1].tolist(), directions.nodes.tolist()))
    solved = solve_each(
        partial(_solve_pair_sides, case, width), report, workers, *zip(*grid, strict=True)
    )
    axes = [apart, directions, Axis("place", "mirrored", np.array(_FROM_SIDES))]
    depth = case.dents[_SIDES_DEPTH].depth
    return tabulate(case, axes, solved, width=width, depth=depth, least=case.least)


def _solve_pair_sides(case: Indentations, width: float, apart: float, angle: float) -> PressFields:
    """Fields that the sides add to pairs in one direction; zero where such pairs have no room."""
    H, half = case.thickness, 0.5 * width
    values = np.zeros((len(_FROM_SIDES), *_COUNTS_BESIDE, 4))
    low = float(lowest_middle(case.least, apart, angle))
    if low <= half:
        dents = case.dents[_SIDES_DEPTH : _SIDES_DEPTH + 1]
        (wide,) = _changes(case, *_wide(case, apart, angle), apart, angle, dents)
        outline = Rectangle(2.0 * _PAIR_STRIP * H, width)
        bases = pair_side_bases(H, width, _FINER)
        for k, part in enumerate(_FROM_SIDES):
            middle = (_PAIR_STRIP * H, low + part * (half - low))
            (beside,) = _changes(case, outline, middle, apart, angle, dents)
            added = partial(_strip_difference, beside, wide, np.array([0.0, middle[1], 0.0]))
            ending = partial(_ending, added, np.array([PAIR_AROUND * H, np.inf]), _PAIR_FADE * H)
            field = Field.from_function(ending, bases, case.height, _COUNTS_BESIDE[2] - 1)
            values[k] = field.coefficients[tuple(slice(count) for count in _COUNTS_BESIDE)]
    return PressFields(values, np.zeros(len(_FROM_SIDES)))


def _ending(field: Callable[[Array], Array], end: Array, length: float, points: Array) -> Array:
    """Values of a field at points, faded out towards -end and end along x and y, (2,) [m]."""
    return fade_at_box(field(points), points, (-end, end), length)


def _strip_difference(strip: PairChange, wide: PairChange, middle: Array, points: Array) -> Array:
    """Difference of the change on a strip to that on a wide stack."""
    return strip(points - middle) - wide(points - middle)


def pair_side_bases(thickness: float, width: float, finer: int = 1) -> Bases:
    """Bases of what sides add, from the middle of the pair along x."""
    around, (along, across, _) = PAIR_AROUND * thickness, _COUNTS_BESIDE
    return (
        Polynomials(-around, around, finer * along, PAIR_STRETCH, vanish=True),
        Polynomials(0.0, width, finer * across),
    )


def lowest_middle(min_distance: float, spacing: ArrayLike, angle: ArrayLike) -> Array:
    """Least distance from a side of the middle of a pair [m]."""
    return np.asarray(min_distance + 0.5 * np.abs(spacing * np.sin(angle)))
