"""Corrections of touches in the finite stack: from solved tables to fields of one sensor."""

import dataclasses
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Disc, Polygon, Rectangle
from eitskin.geometry.design.sensor import Rigid, SensorDesign, Substrate
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.deformation import indentation_tables as tables
from eitskin.simulator.deformation import pair_tables
from eitskin.simulator.deformation.field import CubicSplines, Field, Frame
from eitskin.simulator.deformation.finite_stack import require_on_stack
from eitskin.simulator.deformation.indentation_tables import Indentations
from eitskin.simulator.deformation.outline_sides import SideFade, sides_of
from eitskin.simulator.deformation.press_table import indenter_samples
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid, StackGrid
from eitskin.simulator.deformation.solution_store import Arrays, Problem, Report, load_or_solve
from eitskin.simulator.deformation.solution_table import SolutionTable
from eitskin.simulator.mechanics.layer_stack import Mechanics, Stack
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]
Place = tuple[float, float, float]
"""Position and depth (x, y, depth) of a press [m]."""

# Over the thickness of the stack: length of a rectangle, so that its ends do not feel each other,
# radius of a disc, so that there are several distances from the rim, and extent of other outlines.
_SHORTEST, _SMALLEST, _NARROWEST = 8.0, 1.0, 2.0
_BEYOND = 0.02  # of the deepest solved press, by which another may be deeper
_SAME = 1e-9  # [m]
_WORKERS = os.cpu_count() or 1
# Kinds of tables: how they are solved, and versions, to be raised whenever that changes.
_KINDS: dict[str, tuple[Callable[..., SolutionTable], int]] = {
    "strip": (tables.solve_strip, 3),
    "end": (tables.solve_end, 3),
    "side": (tables.solve_side, 2),
    "disc": (tables.solve_disc, 1),
    "pair": (pair_tables.solve_pair, 4),
    "pair-sides": (pair_tables.solve_pair_sides, 1),
}


class PressCorrection(NamedTuple):
    """Fields of a correction, and by how much deeper a press sinks [m]."""

    fields: list[Field]
    extra_depth: float


def is_tabulable(design: SensorDesign) -> bool:
    """Whether corrections on a design can be tabulated: on plane outlines on an even base.

    Both extents of an outline must be some times the thickness of its stack.
    """
    outline, thickness = design.outline, design.encapsulated_thickness
    if isinstance(outline, Surface) or not isinstance(design.support, Rigid | Substrate):
        return False
    if isinstance(outline, Disc):
        return outline.radius >= _SMALLEST * thickness
    return _has_strip(design) or min(outline.length, outline.width) >= _NARROWEST * thickness


def _has_strip(design: SensorDesign) -> bool:
    """Whether the outline is a rectangle whose presses have tables of their own."""
    long = _SHORTEST * design.encapsulated_thickness
    return isinstance(design.outline, Rectangle) and design.outline.length >= long


@dataclass(frozen=True, slots=True)
class _Sensor:
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
        kinds = ("strip", "end") if _has_strip(self.design) else ()
        return [self.problem(kind, stack) for kind in kinds]

    def varied(self, stack: Stack) -> Problem:
        """Table of single presses that is interpolated between stacks."""
        return self.problem("disc" if isinstance(self.design.outline, Disc) else "side", stack)

    def pairs(self, stack: Stack) -> list[Problem]:
        """Tables of two presses by each other."""
        kinds = ("pair", "pair-sides") if _has_strip(self.design) else ("pair",)
        return [self.problem(kind, stack) for kind in kinds]

    def stacks(self, grid: SensorGrid) -> tuple[Stack, dict[Stack, float]]:
        """Solved stack next to the sensor's, and weights of stacks in its corrections.

        On a rectangle with tables of its own, differences to the solved stack suffice.
        """
        base, weights = StackGrid.around(self.design, self.mechanics, grid).base_and_weights()
        if _has_strip(self.design):
            weights[base] = weights.get(base, 0.0) - 1.0
            weights = {} if len(weights) == 1 else weights
        return base, weights


def _solve(
    solve: Callable[..., SolutionTable],
    about: Indentations,
    sizes: tuple[float, ...],
    report: Report,
) -> Arrays:
    return solve(about, *sizes, report, _WORKERS).arrays()


@lru_cache(maxsize=64)
def correction_problems(
    design: SensorDesign,
    mechanics: Mechanics,
    indenter: Indenter,
    grid: SensorGrid = OWN_GRID,
    pairs: bool = True,
) -> tuple[Problem, ...]:
    """Tables that a design needs, those of several touches among them if wanted.

    There are none for a design that is not `is_tabulable`; each takes minutes to solve.
    """
    if not is_tabulable(design):
        return ()
    sensor = _Sensor(design, mechanics, indenter)
    base, weights = sensor.stacks(grid)
    found = [*sensor.singles(base), *(sensor.varied(stack) for stack in weights)]
    return (*found, *(sensor.pairs(base) if pairs else ()))


@lru_cache(maxsize=64)
def corrections(
    design: SensorDesign, mechanics: Mechanics, indenter: Indenter, grid: SensorGrid = OWN_GRID
) -> "Corrections":
    """Corrections on a design that `is_tabulable`; those not stored take minutes to solve."""
    sensor = _Sensor(design, mechanics, indenter)
    base, weights = sensor.stacks(grid)
    modulus = mechanics.gel.shear_modulus
    return Corrections(
        design,
        tuple(_loaded(problem, modulus) for problem in sensor.singles(base)),
        None if _has_strip(design) and not weights else _loaded(sensor.varied(base), modulus),
        tuple((_loaded(sensor.varied(stack), modulus), each) for stack, each in weights.items()),
    )


@lru_cache(maxsize=64)
def pair_corrections(
    design: SensorDesign, mechanics: Mechanics, indenter: Indenter, grid: SensorGrid = OWN_GRID
) -> "PairCorrections":
    """Changes of pairs on the solved stack next to a design's; minutes where not stored.

    The part of the sides is of long rectangles.
    """
    sensor = _Sensor(design, mechanics, indenter)
    problems = sensor.pairs(sensor.stacks(grid)[0])
    return PairCorrections(*(_loaded(each, mechanics.gel.shear_modulus) for each in problems))


def _loaded(problem: Problem, modulus: float) -> SolutionTable:
    """Table whose gel has a shear modulus [Pa]."""
    table = SolutionTable.from_arrays(load_or_solve(problem))
    ratio = modulus / table.size("modulus")
    return table if ratio == 1.0 else table.scaled([1.0, 1.0, 1.0, ratio])


@dataclass(frozen=True, slots=True, eq=False)
class Corrections:
    """Corrections of presses on one sensor by tables of solved stacks.

    Attributes:
        design: of the sensor.
        strip: tables of a strip and of its end, for a long rectangle; else none.
        base: table beside one side or on a disc of the solved stack next to the sensor's; None
            where the strip's suffice.
        varied: such tables of solved stacks with weights, which add up to 1, or with a strip to 0.
    """

    design: SensorDesign
    strip: tuple[SolutionTable, ...]
    base: SolutionTable | None
    varied: tuple[tuple[SolutionTable, float], ...]

    @property
    def _first(self) -> SolutionTable:
        return next(table for table in (*self.strip, self.base) if table is not None)

    def check_depth(self, depth: float) -> None:
        """Raise ConfigurationError for a depth [m] beyond the tables."""
        deepest = self._higher(self._first) * float(self._first.nodes("depth")[-1])
        if depth > deepest * (1.0 + _BEYOND):
            raise ConfigurationError(
                f"touches are tabulated to a depth of {1e3 * deepest:.2f} mm, got "
                f"{1e3 * depth:.2f} mm; press less, or solve scenes with touch_model='solved'"
            )

    def at(self, x: float, y: float, depth: float) -> PressCorrection:
        """Correction of a press at (x, y) to a depth [m].

        Raises ConfigurationError for a press that overhangs the stack or is deeper than the tables.
        """
        self.check_depth(depth)
        outline = self.design.outline
        require_on_stack(outline, x, y, float(self._first.nodes("distance_to_side")[0]))
        if isinstance(outline, Disc):
            return self._on_disc(outline, x, y, depth)
        parts = [self._on_strip(x, y, depth)] if self.strip else []
        if self.base is not None and isinstance(outline, Rectangle | Polygon):
            parts.append(self._beside_sides(self.base, outline, x, y, depth))
        fields = [field for part in parts for field in part.fields]
        return PressCorrection(fields, sum(part.extra_depth for part in parts))

    def _higher(self, table: SolutionTable) -> float:
        """Height of the gel over a table's."""
        return self.design.thickness / table.size("height")

    def _on_strip(self, x: float, y: float, depth: float) -> PressCorrection:
        """Correction on a long rectangle: that of a strip, and the differences near both ends."""
        strip, end = self.strip
        H, width, height = (strip.size(name) for name in ("thickness", "width", "height"))
        higher, length = self._higher(strip), self.design.outline.length
        pressed = {"distance_to_side": y, "depth": depth / higher}

        def folded(images: Array, bases: tables.Bases) -> Field:
            direct, mirrored = (Field(bases, height, each[0]) for each in images)
            image = mirrored.mirrored(1, 0.5 * width)
            return Field(bases, height, direct.coefficients + image.coefficients)

        images, numbers = strip.evaluate(**pressed)
        fields = [folded(images, tables.strip_bases(H, width)).shifted(x)]
        extra = float(numbers["extra_depth"][0])
        for distance, far in ((x, False), (length - x, True)):
            if distance < end.nodes("distance_to_end")[-1]:
                images, numbers = end.evaluate(distance_to_end=distance, **pressed)
                field = folded(images, tables.end_bases(H, width))
                fields.append(field.mirrored(0, 0.5 * length) if far else field)
                extra += float(numbers["extra_depth"][0])
        return PressCorrection([field.raised(higher) for field in fields], higher * extra)

    def _beside_sides(
        self, base: SolutionTable, outline: Rectangle | Polygon, x: float, y: float, depth: float
    ) -> PressCorrection:
        """Sum of corrections beside the sides in reach, each without ends but for its fade."""
        sides = list(sides_of(outline, x, y, float(base.nodes("distance_to_side")[-1])))
        if not sides:
            return PressCorrection([], 0.0)
        bases = CubicSplines(base.sizes["along"]), CubicSplines(base.sizes["inward"])
        distances = np.array([side.aside for side in sides])
        total: Array = np.zeros(1)
        extra = np.zeros(len(sides))
        for table, weight in self.varied:
            higher = self._higher(table)
            found, numbers = table.evaluate(distance_to_side=distances, depth=depth / higher)
            found = _resampled(found, table, base)
            total = total + found * (weight * np.array([1.0, 1.0, higher, 1.0]))
            extra += weight * higher * numbers["extra_depth"]
        middle, fields, sunk = base.size("middle"), [], 0.0
        for side, coefficients, more in zip(sides, total, extra.tolist(), strict=True):
            (foot_x, foot_y), (cos, sin) = side.foot, side.along
            frame = Frame(foot_x - middle * sin, foot_y + middle * cos, cos, sin)
            fade = SideFade(side, middle, self.design.encapsulated_thickness)
            field = Field(bases, self.design.thickness, coefficients, frame, fade)
            # A right corner throws back all of a side's field, which is that of the whole line.
            fields.append(field.straightened() if self.strip else field)
            sunk += more * fade.at_press()
        return PressCorrection(fields, sunk)

    def _on_disc(self, outline: Disc, x: float, y: float, depth: float) -> PressCorrection:
        """Correction on a disc: by symmetry that of a press on the x axis, turned."""
        radius = outline.radius
        distance = math.dist((x, y), (radius, radius))
        cos, sin = 1.0, 0.0
        if distance > _SAME:
            cos, sin = (x - radius) / distance, (y - radius) / distance
        fields, extra = [], 0.0
        for table, weight in self.varied:
            higher = self._higher(table)
            images, numbers = table.evaluate(
                distance_to_side=radius - distance, depth=depth / higher
            )
            # A press beyond the middle is one on this side, turned by half a turn.
            (here,), (there,) = images
            coefficients = here + there[::-1, ::-1] * np.array([-1.0, -1.0, 1.0, 1.0])
            splines = CubicSplines(table.sizes["nodes"])
            frame = Frame(radius, radius, cos, sin)
            field = Field((splines, splines), table.size("height"), weight * coefficients, frame)
            fields.append(field.raised(higher))
            extra += weight * higher * float(numbers["extra_depth"][0])
        return PressCorrection(fields, extra)


def _resampled(coefficients: Array, table: SolutionTable, base: SolutionTable) -> Array:
    """Coefficients (t, nx, ny, nz, k) of a table beside a side, on the splines of another."""
    if np.array_equal(table.sizes["along"], base.sizes["along"]) and np.array_equal(
        table.sizes["inward"], base.sizes["inward"]
    ):
        return coefficients
    moved = table.size("middle") - base.size("middle")
    along, inward = (
        CubicSplines(new).fit @ CubicSplines(own).dense(new)
        for own, new in (
            (table.sizes["along"], base.sizes["along"]),
            (table.sizes["inward"] + moved, base.sizes["inward"]),
        )
    )
    return np.asarray(np.einsum("ai,bj,tijlk->tablk", along, inward, coefficients, optimize=True))


@dataclass(frozen=True, slots=True, eq=False)
class PairCorrections:
    """Change of two presses by each other on one sensor.

    Attributes:
        wide: table on a wide stack.
        sides: table of what the sides add; None where they are left out.
    """

    wide: SolutionTable
    sides: SolutionTable | None = None

    def at(self, first: Place, second: Place) -> PressCorrection:
        """Change by presses (x, y, depth) [m], and by how much deeper each sinks [m].

        No fields where the presses do not feel each other.
        """
        (x, y, depth), (x_other, y_other, other_depth) = first, second
        apart = math.dist((x, y), (x_other, y_other))
        if apart >= self.wide.nodes("axis_distance")[-1]:
            return PressCorrection([], 0.0)
        angle = math.atan2(y_other - y, x_other - x)
        middle = 0.5 * (x + x_other), 0.5 * (y + y_other)
        deep = depth * other_depth
        (coefficients,), numbers = self.wide.evaluate(axis_distance=apart, product=deep)
        nearest = max(apart, float(self.wide.nodes("axis_distance")[0]))
        bases = pair_tables.pair_bases(nearest, self.wide.size("thickness"))
        frame = Frame(*middle, math.cos(angle), math.sin(angle))
        fields = [Field(bases, self.wide.size("height"), coefficients, frame)]
        if self.sides is not None and apart < self.sides.nodes("axis_distance")[-1]:
            fields.append(_of_sides(self.sides, middle, apart, angle, deep))
        return PressCorrection(fields, float(numbers["extra_depth"][0]))


def _of_sides(
    table: SolutionTable, middle: tuple[float, float], apart: float, angle: float, deep: float
) -> Field:
    """Field that the sides of a strip add to a pair about its middle, of a product of depths."""
    width, height = table.size("width"), table.size("height")
    low = pair_tables.lowest_middle(table.size("least"), apart, angle)
    place = (middle[1] - low) / max(0.5 * width - low, _SAME)
    images, _ = table.evaluate(
        axis_distance=apart, direction=angle, place=min(max(place, 0.0), 2.0)
    )
    bases = pair_tables.pair_side_bases(table.size("thickness"), width)
    (direct, opposite), (mirrored, turned) = (
        [Field(bases, height, each[0]) for each in of_direction] for of_direction in images
    )
    # The mirror image along x of a pair is that at the opposite angle. Turned by half a turn, a
    # pair is the same at the same distance from the other side.
    half = 0.5 * width
    parts = [
        direct,
        opposite.mirrored(0, 0.0).mirrored(1, half),
        mirrored.mirrored(0, 0.0),
        turned.mirrored(1, half),
    ]
    total = np.sum([part.coefficients for part in parts], axis=0)
    total *= deep / table.size("depth") ** 2
    return Field(bases, height, total).shifted(middle[0])
