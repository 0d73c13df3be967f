"""Corrections of touches in the finite stack: from solved tables to fields of one sensor."""

import dataclasses
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Disc, Polygon, Rectangle
from eitskin.geometry.design.sensor import Plates, Rigid, SensorDesign, Substrate
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.deformation import indentation_tables as tables
from eitskin.simulator.deformation import pair_tables
from eitskin.simulator.deformation.field import CubicSplines, Field, Frame
from eitskin.simulator.deformation.finite_stack import require_on_stack
from eitskin.simulator.deformation.indentation_tables import Indentations
from eitskin.simulator.deformation.node_sums import (
    BOTH_MIRRORED,
    DIRECT,
    MIRRORED_X,
    MIRRORED_Y,
    NodeSums,
    basis_values,
    sum_of,
)
from eitskin.simulator.deformation.outline_sides import SideFade, sides_in_reach
from eitskin.simulator.deformation.press_table import indenter_samples
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid, StackGrid
from eitskin.simulator.deformation.solution_store import Arrays, Problem, Report, load_or_solve
from eitskin.simulator.deformation.solution_table import SolutionTable
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]
Numbers = NDArray[np.floating]
Indices = NDArray[np.int64]
Corrected = tuple[list[Field], float]
"""Fields of a correction, and by how much deeper a press sinks [m]."""

# Over the thickness of the stack: length of a rectangle, so that its ends do not affect each other,
# radius of a disc, so that there are several distances from the rim, and extent of other outlines.
_SHORTEST, _SMALLEST, _NARROWEST = 8.0, 1.0, 2.0
_DEPTH_MARGIN = 0.02  # of the deepest solved press, by which another may be deeper
_TOLERANCE = 1e-9  # [m]
_NODES, _FEWEST = 0.18, 12  # of sums along each side, over the thickness of the stack
_WORKERS = os.cpu_count() or 1
_Straight = Rectangle | Polygon
# Kinds of tables: how they are solved, and versions, to be raised whenever that changes.
_KINDS: dict[str, tuple[Callable[..., SolutionTable], int]] = {
    "strip": (tables.solve_strip, 4),
    "end": (tables.solve_end, 4),
    "side": (tables.solve_side, 3),
    "disc": (tables.solve_disc, 3),
    "pair": (pair_tables.solve_pair, 5),
    "pair-sides": (pair_tables.solve_pair_sides, 2),
}


def is_tabulable(design: SensorDesign) -> bool:
    """Whether corrections on a design can be tabulated: on plane outlines on an even base.

    Both extents of an outline must be some times the thickness of its stack. So are those of
    rectangles on plates.
    """
    outline, thickness = design.outline, design.encapsulated_thickness
    if isinstance(design.support, Plates):
        return isinstance(outline, Rectangle) and is_tabulable(on_even_base(design))
    if isinstance(outline, Surface) or not isinstance(design.support, Rigid | Substrate):
        return False
    if isinstance(outline, Disc):
        return outline.radius >= _SMALLEST * thickness
    return has_strip(design) or min(outline.length, outline.width) >= _NARROWEST * thickness


def on_even_base(design: SensorDesign) -> SensorDesign:
    """Design on a rigid base in place of plates, whose part is added to its corrections."""
    if isinstance(design.support, Plates):
        return dataclasses.replace(design, support=Rigid())
    return design


def has_strip(design: SensorDesign) -> bool:
    """Whether the outline is a rectangle whose presses have tables of their own."""
    long = _SHORTEST * design.encapsulated_thickness
    return isinstance(design.outline, Rectangle) and design.outline.length >= long


@dataclass(frozen=True, slots=True)
class TabledSensor:
    """Sensor and indenter, whose tables are needed."""

    design: SensorDesign
    mechanics: Mechanics
    indenter: Indenter

    def problem(self, kind: str, stack: Stack) -> Problem:
        """Table of a kind on a stack."""
        mechanics, outline = self.mechanics, self.design.outline
        gel = stack.sheets[stack.gel].law.shear_modulus
        if stack.gel + 1 < len(stack.sheets):
            mechanics = dataclasses.replace(mechanics, encapsulation=stack.sheets[-1].law)
        laws = [sheet.law for sheet in stack.sheets]
        laws += [] if stack.gel + 1 < len(laws) else [mechanics.encapsulation]
        sizes = {"width": outline.width} if kind in ("strip", "end", "pair-sides") else {}
        if kind == "disc" and isinstance(outline, Disc):
            sizes = {"radius": outline.radius}
        solve, version = _KINDS[kind]
        described = {
            "version": version,
            **sizes,
            "heights": [sheet.thickness for sheet in stack.sheets],
            "laws": [
                [type(law).__name__, law.shear_modulus / gel, getattr(law, "alpha", 2.0)]
                for law in laws
            ],
            "bulk_ratio": stack.bulk_ratio,
            "substrate": stack.substrate,
            "indenter": indenter_samples(self.indenter),
        }
        if kind != "pair":
            described["margin"] = mechanics.margin
        about = Indentations(stack, mechanics, self.design.support, self.indenter)
        solved = partial(_solve, solve, about, tuple(sizes.values()))
        return Problem(kind, described, solved, divided=True)

    def singles(self, stack: Stack) -> list[Problem]:
        """Tables of single presses that only the solved stack next to the sensor's needs."""
        kinds = ("strip", "end") if has_strip(self.design) else ()
        return [self.problem(kind, stack) for kind in kinds]

    def stack_table(self, stack: Stack) -> Problem:
        """Table of single presses that is interpolated between stacks."""
        return self.problem("disc" if isinstance(self.design.outline, Disc) else "side", stack)

    def pairs(self, stack: Stack) -> list[Problem]:
        """Tables of two presses by each other."""
        kinds = ("pair", "pair-sides") if has_strip(self.design) else ("pair",)
        return [self.problem(kind, stack) for kind in kinds]

    def stacks(self, grid: SensorGrid) -> tuple[Stack, dict[Stack, float]]:
        """Solved stack next to the sensor's, and weights of stacks in its corrections.

        On a rectangle with tables of its own, differences to the solved stack suffice.
        """
        base, weights = StackGrid.from_design(self.design, self.mechanics, grid).base_and_weights()
        if has_strip(self.design):
            weights[base] = weights.get(base, 0.0) - 1.0
            weights = {} if len(weights) == 1 else weights
        return base, weights


def _solve(
    solve: Callable[..., SolutionTable],
    case: Indentations,
    sizes: tuple[float, ...],
    report: Report,
) -> Arrays:
    return solve(case, *sizes, report, _WORKERS).arrays()


@lru_cache(maxsize=64)
def correction_problems(
    design: SensorDesign,
    mechanics: Mechanics,
    indenter: Indenter,
    grid: SensorGrid = OWN_GRID,
    pairs: bool = True,
) -> tuple[Problem, ...]:
    """Tables that a design needs, those of several touches among them if wanted.

    There are none for a design that is not `is_tabulable`; each takes minutes to solve. On plates
    they are those of a rigid base.
    """
    if not is_tabulable(design):
        return ()
    sensor = TabledSensor(on_even_base(design), mechanics, indenter)
    base, weights = sensor.stacks(grid)
    problems = [*sensor.singles(base), *(sensor.stack_table(stack) for stack in weights)]
    return (*problems, *(sensor.pairs(base) if pairs else ()))


@lru_cache(maxsize=64)
def corrections(
    design: SensorDesign, mechanics: Mechanics, indenter: Indenter, grid: SensorGrid = OWN_GRID
) -> "Corrections":
    """Corrections on a design that `is_tabulable`; those not stored take minutes to solve."""
    sensor = TabledSensor(on_even_base(design), mechanics, indenter)
    base, weights = sensor.stacks(grid)
    return Corrections(
        design,
        tuple(map(load_table, sensor.singles(base))),
        None if has_strip(design) and not weights else load_table(sensor.stack_table(base)),
        tuple((load_table(sensor.stack_table(stack)), each) for stack, each in weights.items()),
        mechanics.gel.shear_modulus,
    )


def load_table(problem: Problem) -> SolutionTable:
    """Table of a problem; minutes where it is not stored."""
    return load_or_solve(problem, SolutionTable.from_arrays)


def rectangle_sums(design: SensorDesign, scenes: int, components: int) -> NodeSums:
    """Sums for corrections of scenes on a long rectangle, whose nodes are denser towards its sides.

    Components are the displacement and, as the fourth, the mean stress, as cubics over the height.
    """
    outline = design.outline
    along, across = (
        max(_FEWEST, math.ceil(extent / (_NODES * design.encapsulated_thickness)))
        for extent in (outline.length, outline.width)
    )
    turned = 0.5 * (1.0 - np.cos(np.linspace(0.0, math.pi, across + 1)))
    nodes = np.linspace(0.0, outline.length, along + 1), outline.width * turned
    return NodeSums(nodes, scenes, 4, components)


@dataclass(frozen=True, slots=True, eq=False)
class Corrections:
    """Corrections of presses on one sensor by tables of solved stacks.

    Attributes:
        design: design of the sensor.
        strip: tables of a strip and of its end, for a long rectangle; else none.
        base: table next to one side or on a disc of the solved stack next to the sensor's; None
            where the strip's suffice.
        varied: such tables of solved stacks with weights, which add up to 1, or with a strip to 0.
        modulus: shear modulus of the gel; that of the tables when omitted [Pa].
    """

    design: SensorDesign
    strip: tuple[SolutionTable, ...]
    base: SolutionTable | None
    varied: tuple[tuple[SolutionTable, float], ...]
    modulus: float | None = None

    @property
    def first(self) -> SolutionTable:
        """Table of the solved stack next to the sensor's."""
        return next(table for table in (*self.strip, self.base) if table is not None)

    @property
    def scales(self) -> Array:
        """Factors of the components of fields in sums, (4,)."""
        modulus = self.first.size("modulus") if self.modulus is None else self.modulus
        return np.array([1.0, 1.0, self.design.thickness, modulus])

    def check_depth(self, depth: float) -> None:
        """Raise ConfigurationError for a depth [m] beyond the tables."""
        higher = self.design.thickness / self.first.size("height")
        deepest = higher * float(self.first.nodes("depth")[-1])
        if depth > deepest * (1.0 + _DEPTH_MARGIN):
            raise ConfigurationError(
                f"touches are tabulated to a depth of {1e3 * deepest:.2f} mm, got "
                f"{1e3 * depth:.2f} mm; press less, or solve scenes with touch_model='solved'"
            )

    def evaluate(
        self,
        places: Array,
        scenes: Indices,
        sums: NodeSums | None,
        turns: Numbers | None = None,
    ) -> tuple[list[list[Field]], Array]:
        """Corrections of presses at places (x, y, depth), (n, 3) [m].

        Returns fields of each that cannot be summed, and by how much deeper each sinks [m], (n,).
        On a long rectangle all fields are added to those of `scenes` (n,) in the `sums`, if given,
        each turned as by `NodeSums.add`.

        Raises ConfigurationError for a press that overhangs the stack or is deeper than the tables.
        """
        outline, least = self.design.outline, float(self.first.nodes("distance_to_side")[0])
        for x, y, depth in places.tolist():
            self.check_depth(depth)
            require_on_stack(outline, x, y, least)
        if self.strip and isinstance(outline, Rectangle):
            where = places, scenes, sums, turns
            extra = self._on_strip(outline, *where) + self._rectangle_side_corrections(*where)
            return [[] for _ in places], extra
        press = self._on_disc if isinstance(outline, Disc) else self._straight_side_correction
        found = [press(*place) for place in places.tolist()]
        return [fields for fields, _ in found], np.array([extra for _, extra in found])

    def _on_strip(
        self,
        outline: Rectangle,
        places: Array,
        scenes: Indices,
        sums: NodeSums | None,
        turns: Numbers | None,
    ) -> Array:
        """Corrections on a long rectangle: those of a strip, and differences near both ends."""
        (x, y, depth), (strip, end) = places.T, self.strip
        H, height = strip.size("thickness"), self.design.thickness
        k = sums.components if sums else 4
        images, pressed = (DIRECT, MIRRORED_Y), {"distance_to_side": y, "depth": depth}
        table = sum_of(strip, (strip,), k, images)
        amounts, extra = table.amounts([1.0], height, **pressed)
        if sums:
            bases = tables.strip_bases(H, outline.width)
            along = basis_values(bases[0], sums.nodes[0], x)
            across = bases[1].dense(sums.nodes[1])
            sums.add(table.modes, amounts, along, across, scenes, turns=turns)
        distance = np.stack([x, outline.length - x])
        far, near = np.nonzero(distance < end.nodes("distance_to_end")[-1])
        if not len(near):
            return extra
        pressed = {name: values[near] for name, values in pressed.items()}
        table = sum_of(end, (end,), k, images)
        amounts, more = table.amounts([1.0], height, distance_to_end=distance[far, near], **pressed)
        np.add.at(extra, near, more)
        if sums:
            ends = tables.end_bases(H, outline.width)
            along, across = (basis.dense(at) for basis, at in zip(ends, sums.nodes, strict=True))
            image = np.stack([far, np.zeros_like(far)], axis=1)
            own = None if turns is None else turns[near]
            sums.add(table.modes, amounts, along, across, scenes[near], image, own)
        return extra

    def _rectangle_side_corrections(
        self, places: Array, scenes: Indices, sums: NodeSums | None, turns: Numbers | None
    ) -> Array:
        """Corrections next to the sides in reach, each of which is as one without ends.

        A right corner throws back all of a side's field; the share of its images is left out, since
        all this is a difference to a solved strip.
        """
        extra = np.zeros(len(places))
        if self.base is None:
            return extra
        (x, y, depth), outline, base = places.T, self.design.outline, self.base
        there_x, there_y = outline.length - x, outline.width - y
        # Below, above, left and right: distance of a press, its foot, and the image.
        distance, foot = np.array([y, there_y, x, there_x]), np.array([x, there_x, there_y, y])
        images = np.array([DIRECT, BOTH_MIRRORED, MIRRORED_Y, MIRRORED_X])
        side, press = np.nonzero((distance < base.nodes("distance_to_side")[-1]) & (distance > 0.0))
        if not len(press):
            return extra
        varied, weights = zip(*self.varied, strict=True)
        table = sum_of(base, varied, sums.components if sums else 4)
        pressed = {"distance_to_side": distance[side, press], "depth": depth[press]}
        amounts, more = table.amounts(weights, self.design.thickness, **pressed)
        np.add.at(extra, press, more)
        if not sums:
            return extra
        inward = CubicSplines(base.sizes["inward"] + base.size("middle"))
        along = CubicSplines(base.sizes["along"])
        for upright in (0, 1):  # along y the components along x and y change places
            here = np.flatnonzero(side // 2 == upright)
            s, p, nodes = side[here], press[here], sums.nodes
            own = basis_values(along, nodes[upright], foot[s, p])
            factors = [own, inward.dense(nodes[1 - upright])]
            modes, factors = (
                (table.transposed_modes, factors[::-1]) if upright else (table.modes, factors)
            )
            if len(here):
                turned = None if turns is None else turns[p]
                sums.add(modes, amounts[here], factors[0], factors[1], scenes[p], images[s], turned)
        return extra

    def _straight_side_correction(self, x: float, y: float, depth: float) -> Corrected:
        """Sum of corrections next to the sides in reach, each without ends but for its fade."""
        base, outline = self.first, self.design.outline
        reach = float(base.nodes("distance_to_side")[-1])
        sides = list(sides_in_reach(outline, x, y, reach)) if isinstance(outline, _Straight) else []
        thickness = self.design.encapsulated_thickness
        sides += [image for side in sides for image in side.corner_images(reach, thickness)]
        if not sides:
            return [], 0.0
        bases = CubicSplines(base.sizes["along"]), CubicSplines(base.sizes["inward"])
        varied, weights = zip(*self.varied, strict=True)
        table, asides = sum_of(base, varied, 4), np.array([side.aside for side in sides])
        amounts, extra = table.amounts(
            weights, self.design.thickness, distance_to_side=asides, depth=np.array([depth])
        )
        total = table.fields(amounts) * self.scales
        middle, fields, sunk = base.size("middle"), [], 0.0
        for side, coefficients, more in zip(sides, total, extra.tolist(), strict=True):
            (foot_x, foot_y), (cos, sin) = side.foot, side.along
            frame = Frame(foot_x - middle * sin, foot_y + middle * cos, cos, sin)
            fade = SideFade(side, middle, thickness)
            parts = side.share * coefficients
            fields.append(Field(bases, self.design.thickness, parts, frame, fade))
            sunk += more * fade.press_fraction() if side.ends else 0.0
        return fields, sunk

    def _on_disc(self, x: float, y: float, depth: float) -> Corrected:
        """Correction on a disc: by symmetry that of a press on the x axis, turned."""
        radius, height = 0.5 * self.design.outline.length, self.design.thickness
        distance = math.dist((x, y), (radius, radius))
        cos, sin = 1.0, 0.0
        if distance > _TOLERANCE:
            cos, sin = (x - radius) / distance, (y - radius) / distance
        frame, fields, extra = Frame(radius, radius, cos, sin), [], 0.0
        pressed = {"distance_to_side": np.array([radius - distance]), "depth": np.array([depth])}
        for table, weight in self.varied:
            # A press beyond the middle is one on this side, turned by half a turn.
            mirror_sums = sum_of(table, (table,), 4, (DIRECT, BOTH_MIRRORED))
            amounts, more = mirror_sums.amounts([weight], height, **pressed)
            coefficients = mirror_sums.fields(amounts)[0] * self.scales
            splines = CubicSplines(table.sizes["nodes"])
            fields.append(Field((splines, splines), height, coefficients, frame))
            extra += float(more[0])
        return fields, extra
