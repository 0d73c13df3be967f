"""Bends of clamped sensors: solved tables, and those of one sensor interpolated between them.

A bend depends on span, offset, thickness and ratio of the moduli. About nominal values of the four,
displacements are the nominal ones plus one correction per parameter, each quadratic through solved
neighbours. Lengths over thickness and moduli over the gel's matter, so that everything is solved
at one thickness and one modulus of the gel.
"""

import dataclasses
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial, reduce

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import Plates, SensorDesign, Support
from eitskin.simulator.bends.bend_3d import BentStack, ClampedStack, Slab, clamped_lines
from eitskin.simulator.bends.bent_layer import BentLayer
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid, cut_weights
from eitskin.simulator.deformation.solution_store import Arrays, Problem, Report, load_or_solve
from eitskin.simulator.deformation.solution_table import Axis, SolutionTable
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.load_stepping import SolidError

Array = NDArray[np.float64]

log = logging.getLogger(__name__)

# Downwards the sensor's lower side is pressed together, and the steps are shorter towards the end:
# from -30 degrees straight to -40 takes three times as many iterations as by way of -35.
ANGLES_DEG = tuple(map(float, (-40, -35, *range(-30, 61, 10), 75, 90)))
# Version of the tables: raise it whenever bends are solved or tabulated in another way.
_VERSION = 2
# Everything is solved for a stack this thick [m], whose gel has this shear modulus [Pa].
_THICKNESS, _MODULUS = 0.012, 20e3
# Distances of solved neighbours: of the span and of the thickness, relative; of the offset, over
# the thickness of the stack; of the ratio of the moduli, as a factor.
_SPAN, _OFFSET, _THICKER, _STIFFER = 0.04, 0.08, 0.06, 1.4
_REACH = 1.5  # steps from the nominal value within which its two neighbours serve
_TOLERANCE = 1e-6  # singular values of displacements, relative to the largest, that tables keep
_FEWEST = 4
_SAME = 1e-9  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class BendTable:
    """Bends of the gel of one sensor, by solved tables with weights.

    Attributes:
        tables: over the angle, of the same angles; weights add up to 1.
    """

    tables: tuple[tuple[SolutionTable, float], ...]

    @property
    def angles_deg(self) -> Array:
        """Solved angles, rising [deg]."""
        return self.tables[0][0].nodes("angle")

    def check(self, angle_deg: float) -> None:
        """Raise ConfigurationError for an angle outside the tables [deg]."""
        first, last = self.angles_deg[[0, -1]]
        if not first <= angle_deg <= last:
            raise ConfigurationError(
                f"this sensor is solved for bends of its clamp from {first:g} to {last:g} deg, got "
                f"{angle_deg:g} deg; bend it less, or choose a kinematic fixture, "
                "fixture=Hinge(...) or fixture=FreeArc(...)"
            )

    def at(self, angle_deg: float) -> BentLayer:
        """Layer bent by an angle within the tables [deg].

        Raises ConfigurationError for an angle outside.
        """
        self.check(angle_deg)
        values, energy, moment = np.zeros(1), 0.0, 0.0
        for table, weight in self.tables:
            coefficients, _ = table.evaluate(angle=angle_deg)
            values = values + weight * coefficients[0]
            spline = _energy_over_angle(table)
            energy += weight * float(spline(angle_deg))
            moment += weight * float(np.degrees(spline(angle_deg, 1)))
        x, y, z, centre, thickness = (
            np.asarray(sum(weight * table.sizes[name] for table, weight in self.tables))
            for name in ("x", "y", "z", "centre", "thickness")
        )
        return BentLayer((x, y, z), values, centre, float(thickness), angle_deg, energy, moment)


@lru_cache(maxsize=32)
def _energy_over_angle(table: SolutionTable) -> CubicHermiteSpline:
    """Energy [J] over the angle [deg], whose slope is the moment."""
    numbers = table.numbers["energy"], np.radians(table.numbers["moment"])
    return CubicHermiteSpline(table.nodes("angle"), *numbers)


def tabulate_bends(
    stack: ClampedStack, angles_deg: Sequence[float], report: Report = lambda *_: None
) -> SolutionTable:
    """Solve a stack at all angles, from flat upwards and from flat downwards, as far as possible.

    Args:
        stack: the clamped sensor.
        angles_deg: four or more, on both sides of 0 [deg].
        report: called with the number of solved angles and of all angles.

    Raises SolidError where fewer than four angles can be reached.
    """
    angles = np.unique(np.asarray(angles_deg, dtype=float))
    if len(angles) < _FEWEST or not angles[0] <= 0.0 <= angles[-1]:
        raise ConfigurationError(
            f"a table of bends needs four angles or more, on both sides of 0, got {angles_deg}"
        )
    found: dict[float, BentStack] = {}
    for path in (angles[angles >= 0.0], angles[angles < 0.0][::-1]):
        try:
            for bent in stack.equilibria(path.tolist()):
                found[bent.angle_deg] = bent
                report(len(found), len(angles))
        except SolidError:
            if len(found) < _FEWEST:
                raise
    solved = [found[angle] for angle in sorted(found)]
    nodes = [
        np.interp(np.arange(2 * len(line) - 1) / 2.0, np.arange(len(line)), line)
        for line in stack.lines
    ]
    inside = [
        np.abs(each) < half + _SAME for each, half in zip(nodes, stack.half_sizes, strict=True)
    ]
    values = np.stack([bent.displacement.values for bent in solved])
    x, y, z = (each[within] for each, within in zip(nodes, inside, strict=True))
    return SolutionTable.from_solutions(
        [Axis("angle", "spline", np.array([bent.angle_deg for bent in solved]))],
        values[:, inside[0]][:, :, inside[1]][:, :, :, inside[2]],
        {name: [getattr(bent, name) for bent in solved] for name in ("energy", "moment")},
        {
            "x": x,
            "y": y,
            "z": z,
            "centre": solved[0].centre,
            "thickness": 2.0 * stack.lines[2][-1],
        },
        _TOLERANCE,
    )


def bend(
    design: SensorDesign,
    fixture: Fixture,
    mechanics: Mechanics,
    angle: Bend,
    grid: SensorGrid = OWN_GRID,
) -> Deformation:
    """Deformation of a sensor by its fixture.

    The first bend of a clamped sensor that has not been solved takes half a minute.

    Raises:
        ConfigurationError: for a bend out of reach, or a clamped sensor that is not a rectangle.
        SolidError: where even small bends of the clamped sensor have no stable equilibrium.
    """
    if isinstance(fixture, Clamp):
        return bend_table(design, fixture, mechanics, grid).at(angle.angle_deg)
    return fixture.flexure(design, angle)


@lru_cache(maxsize=8)
def equilibrium(design: SensorDesign, clamp: Clamp, mechanics: Mechanics, angle: Bend) -> BentStack:
    """Equilibrium of a whole clamped stack at one angle, the state in which it is pressed.

    Each takes some seconds and is not stored. Raises SolidError where there is none.
    """
    held = on_support(clamp, design.support)
    return next(ClampedStack(design, held, mechanics).equilibria([angle.angle_deg]))


@lru_cache(maxsize=64)
def check_clamp(design: SensorDesign, clamp: Clamp, mechanics: Mechanics) -> None:
    """Raise ConfigurationError for a sensor that cannot be clamped."""
    clamped_lines(Slab.of(design), clamp, mechanics)


@lru_cache(maxsize=16)
def bend_table(
    design: SensorDesign, clamp: Clamp, mechanics: Mechanics, grid: SensorGrid = OWN_GRID
) -> BendTable:
    """Bend table of a clamped sensor; the first time takes half a minute."""
    weighted = [(_loaded(case), each) for case, each in _cases(design, clamp, mechanics, grid)]
    common = reduce(np.intersect1d, (table.nodes("angle") for table, _ in weighted))
    return BendTable(tuple((table.restricted(common), weight) for table, weight in weighted))


def bend_problems(
    design: SensorDesign, clamp: Clamp, mechanics: Mechanics, grid: SensorGrid = OWN_GRID
) -> list[Problem]:
    """Tables that `bend_table` needs; each takes half a minute to solve."""
    return [_problem(case) for case, _ in _cases(design, clamp, mechanics, grid)]


def on_support(clamp: Clamp, support: Support) -> Clamp:
    """Clamp of a supported sensor: plates that support the sensor hold its bottom face only."""
    return dataclasses.replace(clamp, faces="bottom") if isinstance(support, Plates) else clamp


@dataclass(frozen=True, slots=True)
class _Case:
    """One stack to be solved.

    Attributes:
        slab: the layer.
        clamp: span, offset, compliance and held faces.
        mechanics: materials.
        lines: grid lines of the quarter [m].
    """

    slab: Slab
    clamp: Clamp
    mechanics: Mechanics
    lines: tuple[tuple[float, ...], ...]

    @property
    def scales(self) -> tuple[float, float]:
        """Thickness and modulus relative to the solved ones."""
        modulus = self.mechanics.gel.shear_modulus / _MODULUS
        return self.slab.encapsulated_thickness / _THICKNESS, modulus

    def scaled(self) -> "_Case":
        """Equal case of the solved thickness and modulus."""
        length, modulus = self.scales
        outline, old = self.slab.outline, self.mechanics
        gel, around = (
            dataclasses.replace(law, shear_modulus=law.shear_modulus / modulus)
            for law in (old.gel, old.encapsulation)
        )
        return _Case(
            Slab(
                Rectangle(outline.length / length, outline.width / length),
                self.slab.thickness / length,
                self.slab.encapsulated_thickness / length,
            ),
            Clamp(
                self.clamp.span / length,
                self.clamp.offset / length,
                self.clamp.compliance * modulus / length,
                self.clamp.faces,
            ),
            Mechanics(gel, around, old.margin / length, old.bulk_ratio),
            tuple(tuple(x / length for x in line) for line in self.lines),
        )


def _cases(
    design: SensorDesign, clamp: Clamp, mechanics: Mechanics, grid: SensorGrid
) -> Iterator[tuple[_Case, float]]:
    """Solved stacks, and their weights in the table of a design."""
    clamp, slab = on_support(clamp, design.support), Slab.of(design)
    ratio = mechanics.encapsulation.shear_modulus / mechanics.gel.shear_modulus
    wanted = clamp.span, clamp.offset, slab.thickness, ratio
    nominal = (
        grid.span or clamp.span,
        clamp.offset if grid.offset is None else grid.offset,
        grid.thickness or slab.thickness,
        grid.ratio or ratio,
    )
    stack = slab.encapsulated_thickness * nominal[2] / slab.thickness
    sizes = _SPAN * nominal[0], _OFFSET * stack, _THICKER * nominal[2]
    positions = [(a - b) / size for a, b, size in zip(wanted, nominal, sizes, strict=False)]
    positions.append(math.log(ratio / nominal[3]) / math.log(_STIFFER))
    middles = [round(t) if abs(t) > _REACH else 0 for t in positions]  # specimens share nodes
    stencils = [range(middle - 1, middle + 2) for middle in middles]
    for steps, weight in cut_weights(positions, stencils).items():
        values = [b + n * size for b, n, size in zip(nominal, steps, sizes, strict=False)]
        values.append(nominal[3] * _STIFFER ** steps[3])
        yield _case(slab, clamp, mechanics, nominal, tuple(values)), weight


def _case(
    slab: Slab,
    clamp: Clamp,
    mechanics: Mechanics,
    nominal: tuple[float, ...],
    values: tuple[float, ...],
) -> _Case:
    """Stack of a span, offset, thickness and ratio, on the nominal mesh, stretched."""
    around = slab.encapsulated_thickness / slab.thickness
    law = dataclasses.replace(
        mechanics.encapsulation, shear_modulus=values[3] * mechanics.gel.shear_modulus
    )
    made = dataclasses.replace(mechanics, encapsulation=law)

    def body(span: float, offset: float, thickness: float, _: float) -> tuple[Slab, Clamp]:
        return (
            dataclasses.replace(
                slab, thickness=thickness, encapsulated_thickness=around * thickness
            ),
            Clamp(span, offset, clamp.compliance, clamp.faces),
        )

    x, y, z = clamped_lines(*body(*nominal), made)
    ends = [float(slab.half_sizes[0]), float(x[-1])]
    x = np.interp(x, [0.0, 0.5 * nominal[0], *ends], [0.0, 0.5 * values[0], *ends])
    z = z * (values[2] / nominal[2])
    lines = tuple(tuple(line.tolist()) for line in (x, y, z))
    return _Case(*body(*values), made, lines)


def _problem(case: _Case) -> Problem:
    """Table of a scaled case."""
    scaled = case.scaled()
    laws = (scaled.mechanics.gel, scaled.mechanics.encapsulation)
    clamp = scaled.clamp
    described = {
        "version": _VERSION,
        "sizes": [*(2.0 * scaled.slab.half_sizes), scaled.slab.encapsulated_thickness],
        "clamp": [clamp.span, clamp.offset, clamp.compliance, clamp.faces],
        "laws": [[type(law).__name__, *dataclasses.astuple(law)] for law in laws],
        "margin": scaled.mechanics.margin,
        "bulk_ratio": scaled.mechanics.bulk_ratio,
        "lines": scaled.lines,
        "angles_deg": ANGLES_DEG,
    }
    return Problem("bend", described, partial(_solve, scaled))


def _solve(scaled: _Case, report: Report) -> Arrays:
    log.info("solving the bends of a clamped sensor, which takes half a minute")
    x, y, z = (np.array(line) for line in scaled.lines)
    stack = ClampedStack(scaled.slab, scaled.clamp, scaled.mechanics, lines=(x, y, z))
    return tabulate_bends(stack, ANGLES_DEG, report).arrays()


def _loaded(case: _Case) -> SolutionTable:
    length, modulus = case.scales
    table = SolutionTable.from_arrays(load_or_solve(_problem(case)), np.float64)
    return table.scaled(length, modulus * length**3, length)
