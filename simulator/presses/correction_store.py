"""Store of correction tables, shipped and on the disk, with interpolation between stacks."""

import dataclasses
import math
import os
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Disc, Polygon, Rectangle
from eitskin.geometry.design.sensor import Rigid, SensorDesign, Substrate, Support
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.mechanics import solved_files
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.presses import table_files
from eitskin.simulator.presses.correction_table import (
    CorrectionTable,
    Report,
    solve_corrections,
)
from eitskin.simulator.presses.corrections import (
    AnyCorrections,
    Corrections,
    DiscCorrections,
    PairCorrections,
    SideCorrections,
)
from eitskin.simulator.presses.disc_table import DiscTable, in_series, solve_disc
from eitskin.simulator.presses.edge_table import EdgeTable, solve_edge
from eitskin.simulator.presses.pair_sides import PairSides, solve_pair_sides
from eitskin.simulator.presses.pair_table import PairTable, solve_pairs
from eitskin.simulator.presses.press_store import (
    REFERENCE_RATIO,
    SUBSTRATE_RATIO,
    lagrange_weights,
    scaled_heights,
    with_modulus,
)
from eitskin.simulator.presses.table_files import file_name, found_file, kept
from eitskin.simulator.scene.indenters import Indenter
from eitskin.simulator.scene.scene import AnyIndenter

Array = NDArray[np.float64]

# Over the thickness of the stack: length of a rectangle, so that its ends do not feel each other,
# radius of a disc, so that there are several distances from the rim, and extent of other outlines.
_SHORTEST, _SMALLEST, _NARROWEST = 8.0, 1.0, 2.0
# Steps of thickness and of the modulus ratio between solved stacks, as for the tables of presses.
_THICKER, _STIFFER = 1.1, math.sqrt(2.0)
# Steps up to which the neighbours of the reference serve: hand-made specimens stay within.
_FAR = 2.6
_WORKERS = os.cpu_count() or 1

Shape = TypeVar("Shape", Rectangle, Disc)


def tabulable(design: SensorDesign) -> bool:
    """Whether corrections on a design can be tabulated: on plane outlines on an even base.

    Both extents of an outline must be some times the thickness of its stack.
    """
    outline, thickness = design.outline, design.encapsulated_thickness
    if isinstance(outline, Surface) or not isinstance(design.support, Rigid | Substrate):
        return False
    if isinstance(outline, Disc):
        return outline.radius >= _SMALLEST * thickness
    return not _by_sides(design) or min(outline.length, outline.width) >= _NARROWEST * thickness


def is_shipped(
    design: SensorDesign, mechanics: Mechanics, indenter: AnyIndenter, *, pairs: bool = True
) -> bool:
    """Whether all tables that a design needs come with the package, those of pairs if wanted."""
    return tabulable(design) and all(
        table_files.is_shipped(name) for name in _all_names(design, mechanics, indenter, pairs)
    )


def missing(
    design: SensorDesign, mechanics: Mechanics, indenter: AnyIndenter, *, pairs: bool = True
) -> set[Path]:
    """Absent files of tables that `prepare` would solve; each takes minutes."""
    if not tabulable(design):
        return set()
    names = _all_names(design, mechanics, indenter, pairs)
    return {solved_files.folder() / name for name in names if found_file(name) is None}


def _names(design: SensorDesign, mechanics: Mechanics, indenter: Indenter) -> tuple[str, ...]:
    """Names of all files that a single touch on a design needs."""
    base, weights = _needed(design, mechanics)
    if isinstance(design.outline, Disc):
        return tuple(_name(design, stack, mechanics, indenter) for stack in weights)
    edges = tuple(_edge_name(stack, mechanics, indenter) for stack in weights)
    return edges if _by_sides(design) else (_name(design, base, mechanics, indenter), *edges)


@lru_cache(maxsize=64)
def _all_names(
    design: SensorDesign, mechanics: Mechanics, indenter: Indenter, pairs: bool
) -> tuple[str, ...]:
    """Names of all files that a design needs, those of several touches among them if wanted."""
    names = _names(design, mechanics, indenter)
    if not pairs:
        return names
    base, _ = _needed(design, mechanics)
    names += (_pair_name(base, mechanics, indenter),)
    if _has_table(design):
        names += (_pair_sides_name(design, base, mechanics, indenter),)
    return names


def prepare(
    design: SensorDesign,
    mechanics: Mechanics,
    indenter: AnyIndenter,
    report: Report | None = None,
    *,
    pairs: bool = True,
) -> None:
    """Solve and store the absent tables of a design that is `tabulable`, those of pairs if wanted.

    `report` is called with the numbers of solved positions and of all that take long.
    """
    base, weights = _needed(design, mechanics)
    given = (mechanics, indenter)
    tasks: list[Callable[[Report | None], object]] = []
    if _has_table(design) and found_file(_name(design, base, *given)) is None:
        tasks.append(partial(_table, design, base, *given))
    for stack in weights:
        if isinstance(design.outline, Disc):
            if found_file(_name(design, stack, *given)) is None:
                tasks.append(partial(_disc, design, stack, *given))
        elif found_file(_edge_name(stack, *given)) is None:
            tasks.append(partial(_edge, design.support, stack, *given))
    for number, solve in enumerate(tasks):
        solve(in_series(report, number, len(tasks)))
    if pairs:
        pair_corrections(design, mechanics, indenter)


@lru_cache(maxsize=64)
def corrections(design: SensorDesign, mechanics: Mechanics, indenter: Indenter) -> AnyCorrections:
    """Corrections on a design that is `tabulable`; those not stored take minutes to solve."""
    height, given = design.thickness, (mechanics, indenter)
    base, weights = _needed(design, mechanics)
    if isinstance(design.outline, Disc):
        discs = [(_disc(design, stack, *given), weight) for stack, weight in weights.items()]
        return DiscCorrections(height, _disc(design, base, *given), tuple(discs))
    sides = None
    if weights:
        own = _edge(design.support, base, *given)
        edges = [
            (_edge(design.support, stack, *given).resampled(own), weight)
            for stack, weight in weights.items()
        ]
        thickness = design.encapsulated_thickness
        sides = SideCorrections(height, thickness, _straight(design), own, tuple(edges))
    if sides is not None and _by_sides(design):
        return sides
    return Corrections(height, _table(design, base, *given), sides)


@lru_cache(maxsize=64)
def pair_corrections(
    design: SensorDesign, mechanics: Mechanics, indenter: Indenter
) -> PairCorrections:
    """Changes of pairs on the solved stack nearest to a design's; minutes where not stored.

    The part of the sides is of long rectangles.
    """
    stack, _ = _needed(design, mechanics)
    around = _around(stack, mechanics)

    def solve() -> PairTable:
        return solve_pairs(stack, around, indenter, _WORKERS)

    def solve_sides() -> PairSides:
        width = _outline(design, Rectangle).width
        return solve_pair_sides(width, stack, around, indenter, _WORKERS)

    wide = kept(PairTable, _pair_name(stack, mechanics, indenter), solve)
    if not _has_table(design):
        return PairCorrections(wide, None)
    name = _pair_sides_name(design, stack, mechanics, indenter)
    return PairCorrections(wide, kept(PairSides, name, solve_sides))


def _has_table(design: SensorDesign) -> bool:
    """Whether the outline is a rectangle whose presses have a table of their own."""
    return isinstance(design.outline, Rectangle) and not _by_sides(design)


def _by_sides(design: SensorDesign) -> bool:
    """Whether corrections are sums over the sides of the outline."""
    outline = design.outline
    if isinstance(outline, Rectangle):
        return outline.length < _SHORTEST * design.encapsulated_thickness
    return isinstance(outline, Polygon)


def _needed(design: SensorDesign, mechanics: Mechanics) -> tuple[Stack, dict[Stack, float]]:
    """Solved stack next to a design's, and weights of that stack and its neighbours.

    Thickness and moduli are varied one at a time, quadratically, about the solved stack (cut-HDMR,
    Rabitz and Alis 1999): the correction is that of the solved stack plus weighted differences of
    neighbours to it. The neighbours are the next on both sides, for moduli beyond those the two
    next on one side. On a rectangle, which has a table of its own, differences beside straight
    sides suffice: weights add up to 0 there, else to 1.
    """
    stack = mechanics.stack(design)
    exact = _positions(stack, design, mechanics)
    nearest = tuple(0 if abs(t) < _FAR else round(t) for t in exact)
    base = _solved(stack, design, mechanics, nearest)
    weights: dict[Stack, float] = {}
    for axis, position in enumerate(exact):
        t = position - nearest[axis]
        near = axis == 0 or abs(t) <= 1.0  # thickness comes first
        beside = range(-1, 2) if near else range(3) if t > 0.0 else range(-2, 1)
        for step, weight in lagrange_weights(t, beside):
            if step:
                steps = tuple(n + step * (k == axis) for k, n in enumerate(nearest))
                weights[_solved(stack, design, mechanics, steps)] = weight
    total = 0.0 if _has_table(design) else 1.0
    if not weights and not total:
        return base, {}
    return base, {base: total - sum(weights.values())} | weights


def _positions(stack: Stack, design: SensorDesign, mechanics: Mechanics) -> tuple[float, ...]:
    """Thickness, and moduli of encapsulation and substrate, in steps from solved ones."""
    moduli = [sheet.law.shear_modulus for sheet in stack.sheets]
    gel = moduli[stack.gel]
    solved = mechanics.solved_thickness or design.thickness
    found = [math.log(design.thickness / solved) / math.log(_THICKER)]
    if stack.gel + 1 < len(moduli):
        found.append(math.log(moduli[-1] / gel / REFERENCE_RATIO) / math.log(_STIFFER))
    if stack.substrate:
        found.append(math.log(moduli[0] / gel / SUBSTRATE_RATIO) / math.log(_STIFFER))
    return tuple(found)


def _solved(
    stack: Stack, design: SensorDesign, mechanics: Mechanics, steps: tuple[int, ...]
) -> Stack:
    """Stack at a number of steps from the reference along each axis of `_positions`."""
    thickness = (mechanics.solved_thickness or design.thickness) * _THICKER ** steps[0]
    stack = scaled_heights(stack, thickness / design.thickness)
    rest, gel = list(steps[1:]), stack.sheets[stack.gel].law.shear_modulus
    if stack.gel + 1 < len(stack.sheets):
        around = (stack.gel - 1, stack.gel + 1)
        stack = with_modulus(stack, around, REFERENCE_RATIO * gel * _STIFFER ** rest.pop(0))
    if stack.substrate:
        stack = with_modulus(stack, (0,), SUBSTRATE_RATIO * gel * _STIFFER ** rest.pop(0))
    return stack


def _table(
    design: SensorDesign,
    stack: Stack,
    mechanics: Mechanics,
    indenter: Indenter,
    report: Report | None = None,
) -> CorrectionTable:
    def solve() -> CorrectionTable:
        outline, around = _outline(design, Rectangle), _around(stack, mechanics)
        return solve_corrections(outline, stack, around, design.support, indenter, report, _WORKERS)

    return kept(CorrectionTable, _name(design, stack, mechanics, indenter), solve)


def _disc(
    design: SensorDesign,
    stack: Stack,
    mechanics: Mechanics,
    indenter: Indenter,
    report: Report | None = None,
) -> DiscTable:
    def solve() -> DiscTable:
        outline, around = _outline(design, Disc), _around(stack, mechanics)
        return solve_disc(outline, stack, around, design.support, indenter, report, _WORKERS)

    return kept(DiscTable, _name(design, stack, mechanics, indenter), solve)


def _edge(
    support: Support,
    stack: Stack,
    mechanics: Mechanics,
    indenter: Indenter,
    report: Report | None = None,
) -> EdgeTable:
    def solve() -> EdgeTable:
        return solve_edge(stack, _around(stack, mechanics), support, indenter, report, _WORKERS)

    return kept(EdgeTable, _edge_name(stack, mechanics, indenter), solve)


def _around(stack: Stack, mechanics: Mechanics) -> Mechanics:
    """Materials whose encapsulation is that of a solved stack."""
    if stack.gel + 1 == len(stack.sheets):
        return mechanics
    return dataclasses.replace(mechanics, encapsulation=stack.sheets[-1].law)


def _straight(design: SensorDesign) -> Polygon | Rectangle:
    """Outline of straight sides of a design that has one."""
    if isinstance(design.outline, Polygon):
        return design.outline
    return _outline(design, Rectangle)


def _outline(design: SensorDesign, kind: type[Shape]) -> Shape:
    if isinstance(design.outline, kind):
        return design.outline
    found, wanted = type(design.outline).__name__.lower(), kind.__name__.lower()
    raise ConfigurationError(f"table of a {wanted}, got a {found}; use touch_model='solved'")


def _name(design: SensorDesign, stack: Stack, mechanics: Mechanics, indenter: Indenter) -> str:
    """Name of the file of a table of corrections of single presses."""
    size: dict[str, object] = {"margin": mechanics.margin}
    if isinstance(design.outline, Disc):
        size["radius"] = design.outline.radius
        return file_name("discs", stack, mechanics, indenter, size)
    outline = _outline(design, Rectangle)
    size["outline"] = [outline.length, outline.width]
    return file_name("corrections", stack, mechanics, indenter, size)


def _edge_name(stack: Stack, mechanics: Mechanics, indenter: Indenter) -> str:
    """Name of the file of a table of presses beside a straight side."""
    return file_name("edges", stack, mechanics, indenter, {"margin": mechanics.margin})


def _pair_name(stack: Stack, mechanics: Mechanics, indenter: Indenter) -> str:
    """Name of the file of a table of pairs on a wide stack."""
    return file_name("pairs", stack, mechanics, indenter, {})


def _pair_sides_name(
    design: SensorDesign, stack: Stack, mechanics: Mechanics, indenter: Indenter
) -> str:
    """Name of the file of a table of what the sides of a strip add to pairs."""
    width = _outline(design, Rectangle).width
    across: dict[str, object] = {"width": width, "margin": mechanics.margin}
    return file_name("pair-sides", stack, mechanics, indenter, across)
