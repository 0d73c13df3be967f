"""Bends of clamped sensors: solved tables, and those of one sensor interpolated between them.

A bend depends on span, offset, thickness and ratio of the moduli. About nominal values of the four,
displacements are the nominal ones plus one correction per parameter, each quadratic through solved
neighbours. Lengths over thickness and moduli over the gel's matter, so that everything is solved
at one thickness and one modulus of the gel.
"""

import dataclasses
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, reduce

import numpy as np
from numpy.typing import NDArray

from eitskin.compiled import compiled_kernels
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Clamp, Fixture
from eitskin.geometry.deformation.kinematics import Deformation, Gradients, Points
from eitskin.geometry.design.sensor import Plates, SensorDesign, Support
from eitskin.simulator.bends.bend_3d import BentStack, ClampedStack, Slab, clamped_lines
from eitskin.simulator.deformation.field import CubicSplines, Field, field_powers
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
_MIN_NODES = 4
_SAME = 1e-9  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class BentLayer(Deformation):
    """Layer of a bent sensor, a Deformation of the gel.

    Cubic splines along x and y and a polynomial along z interpolate the nodal displacements of a
    quarter, mirrored to all four: positions and deformation gradients are continuous. Beyond the
    layer, where presses push gel, positions are extrapolated linearly.

    Attributes:
        field: displacements, from the middle along x and y and from the bottom face.
        centre: middle of the layer [m], (3,).
        half_sizes: half sizes of the layer [m], (3,).
        thickness: thickness of the whole stack [m].
        angle_deg: angle between the plates.
    """

    field: Field
    centre: Array
    half_sizes: Array
    thickness: float
    angle_deg: float

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and gradients, continuous everywhere."""
        return self.map_deformed(points, np.broadcast_to(np.eye(3), (*np.shape(points), 3)))

    def map_deformed(self, points: Points, gradients: Gradients) -> tuple[Points, Gradients]:
        """Positions and gradients of points that have moved already, by the chain rule."""
        x, upwards = np.asarray(points, dtype=float) - self.centre, 0.5 * self.thickness
        outside = np.abs(x) > [np.inf, self.half_sizes[1] + upwards, upwards + _SAME]
        if np.any(outside):
            raise ConfigurationError(
                f"{int(outside.any(axis=-1).sum())} of {x.size // 3} points lie outside the bent "
                f"sensor, whose gel is {2 * self.half_sizes[1]:g} m wide and whose stack is "
                f"{self.thickness:g} m thick; a rolled sensor needs a kinematic fixture, "
                "Hinge(...) or FreeArc(...)"
            )
        if kernels := compiled_kernels("eitskin.simulator.deformation.kernels"):
            places, F = np.array(points, dtype=float, order="C"), np.array(gradients, order="C")
            box = np.stack([self.centre, self.half_sizes])
            kernels.bend(box, *field_powers(self.field), places.reshape(-1, 3), F.reshape(-1, 9))
            return places, F
        inside = np.clip(x, -self.half_sizes, self.half_sizes)
        columns = inside.reshape(-1, 1, 3) + np.array([0.0, 0.0, self.half_sizes[2]])
        moved = self.field.displacement_and_gradient(columns).reshape(12, *x.shape[:-1])
        positions: Points = self.centre + x + np.moveaxis(moved[:3], 0, -1)
        slope, beyond = moved[3:].reshape(3, 3, *x.shape[:-1]), x - inside
        if np.any(beyond):
            positions = positions + np.einsum("ij...,...j->...i", slope, beyond)
        moved[3::4] += 1.0  # the diagonal
        return positions, np.moveaxis(slope, (0, 1), (-2, -1)) @ gradients


def _mirror_quarter(values: Array) -> Array:
    """Values (..., nx, ny, nz, 3) for a quarter, at nodes or of splines, mirrored to all."""
    for axis in range(2):
        # u_x is odd and the others are even along x; likewise u_y along y.
        half = values.shape[axis - 4] - 1
        values = np.take(values, np.abs(np.arange(-half, half + 1)), axis - 4)
        odd = np.moveaxis(values, axis - 4, 0)[..., axis]
        odd[:half] *= -1.0
        odd[half] = 0.0
    return values


def _quarter_splines(nodes: Sequence[Array], values: Array) -> tuple[Field, Array]:
    """A field, and coefficients of its splines of a quarter that interpolate values in it.

    Both values and coefficients are (angles, nx, ny, nz, 3); the field has those of all angles.
    """
    angles, nx, ny, nz, _ = values.shape
    every = np.moveaxis(_mirror_quarter(values), 0, 3).reshape(2 * nx - 1, 2 * ny - 1, nz, -1)
    x, y = (CubicSplines(np.concatenate([-node[:0:-1], node])) for node in nodes[:2])
    top = float(nodes[2][-1])
    field = Field.from_values(every, (x, y), 2.0 * top, nodes[2] / top)
    own = field.coefficients[nx - 1 :, ny - 1 :].reshape(nx, ny, nz, angles, 3)
    return field, np.ascontiguousarray(np.moveaxis(own, 3, 0))


@dataclass(frozen=True, eq=False)
class BendTable:
    """Bends of the gel of one sensor.

    Attributes:
        angles_deg: solved angles, rising [deg].
        values: displacements of the nodes of a quarter, (angles, nx, ny, nz, 3) [m].
        sizes: nodes x, y and z, centre of the layer and thickness of the stack [m].
    """

    angles_deg: Array
    values: Array
    sizes: Mapping[str, Array]

    @cached_property
    def _splines(self) -> tuple[Field, Array]:
        """Splines that take the values at all angles, as of `_quarter_splines`."""
        return _quarter_splines([self.sizes[name] for name in "xyz"], self.values)

    @classmethod
    def from_tables(cls, tables: Sequence[tuple[SolutionTable, float]]) -> "BendTable":
        """Sum of solved tables with weights that add up to 1, over the angles of all."""
        angles = reduce(np.intersect1d, (table.nodes("angle") for table, _ in tables))
        wanted = tuple(angles.tolist())
        values = sum(weight * _evaluate(table, wanted) for table, weight in tables)
        sizes = {
            name: np.asarray(sum(weight * table.sizes[name] for table, weight in tables))
            for name in tables[0][0].sizes
        }
        return cls(angles, np.asarray(values), sizes)

    def check(self, angle_deg: float) -> None:
        """Raise ConfigurationError for an angle outside the tables [deg]."""
        first, last = self.angles_deg[[0, -1]]
        if not first <= angle_deg <= last:
            raise ConfigurationError(
                f"this sensor is solved for bends of its clamp from {first:g} to {last:g} deg, got "
                f"{angle_deg:g} deg; bend it less, or choose a kinematic fixture, "
                "fixture=Hinge(...) or fixture=FreeArc(...)"
            )

    def bent_layer(self, angle_deg: float) -> BentLayer:
        """Layer bent by an angle within the tables [deg].

        Raises ConfigurationError for an angle outside.
        """
        self.check(angle_deg)
        over_angle = Axis("angle", "spline", self.angles_deg)
        (weights,) = over_angle.weights(np.array([angle_deg]))[0]
        splines, quarters = self._splines
        coefficients = _mirror_quarter(np.tensordot(weights, quarters, axes=1))
        ends = np.array([self.sizes[name][-1] for name in "xyz"])
        return BentLayer(
            dataclasses.replace(splines, coefficients=coefficients),
            self.sizes["centre"],
            ends,
            float(self.sizes["thickness"]),
            angle_deg,
        )


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
    stacks: dict[float, BentStack] = {}
    for path in (angles[angles >= 0.0], angles[angles < 0.0][::-1]):
        try:
            for bent in stack.equilibria(path.tolist()):
                stacks[bent.angle_deg] = bent
                report(len(stacks), len(angles))
        except SolidError:
            if len(stacks) < _MIN_NODES:
                raise
    solved = [stacks[angle] for angle in sorted(stacks)]
    nodes = [
        np.interp(np.arange(2 * len(line) - 1) / 2.0, np.arange(len(line)), line)
        for line in stack.lines
    ]
    inside = [
        np.abs(node) < half + _SAME for node, half in zip(nodes, stack.half_sizes, strict=True)
    ]
    values = np.stack([bent.displacement.values for bent in solved])
    x, y, z = (node[within] for node, within in zip(nodes, inside, strict=True))
    return SolutionTable.from_solutions(
        [Axis("angle", "spline", np.array([bent.angle_deg for bent in solved]))],
        values[:, inside[0]][:, :, inside[1]][:, :, :, inside[2]],
        {},
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
        return bend_table(design, fixture, mechanics, grid).bent_layer(angle.angle_deg)
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
    clamped_lines(Slab.from_design(design), clamp, mechanics)


@lru_cache(maxsize=16)
def bend_table(
    design: SensorDesign, clamp: Clamp, mechanics: Mechanics, grid: SensorGrid = OWN_GRID
) -> BendTable:
    """Bend table of a clamped sensor; the first time takes half a minute."""
    cases = _cases(design, clamp, mechanics, grid)
    return BendTable.from_tables([(case.table(), weight) for case, weight in cases])


@lru_cache(maxsize=64)
def bend_problems(
    design: SensorDesign, clamp: Clamp, mechanics: Mechanics, grid: SensorGrid = OWN_GRID
) -> tuple[Problem, ...]:
    """Tables that `bend_table` needs; each takes half a minute to solve."""
    return tuple(case.problem() for case, _ in _cases(design, clamp, mechanics, grid))


def on_support(clamp: Clamp, support: Support) -> Clamp:
    """Clamp of a supported sensor: plates that support the sensor hold its bottom face only."""
    return dataclasses.replace(clamp, faces="bottom") if isinstance(support, Plates) else clamp


@dataclass(frozen=True, slots=True)
class _Case:
    """One stack to be solved, on the grid lines of its quarter [m]."""

    slab: Slab
    clamp: Clamp
    mechanics: Mechanics
    lines: tuple[tuple[float, ...], ...]

    def problem(self) -> Problem:
        """Table of the case, described at the solved thickness and modulus."""
        length, clamp, mechanics = self._length, self.clamp, self.mechanics
        modulus = mechanics.gel.shear_modulus / _MODULUS
        slab, compliance = self.slab, clamp.compliance * modulus / length
        laws = [
            dataclasses.replace(law, shear_modulus=law.shear_modulus / modulus)
            for law in (mechanics.gel, mechanics.encapsulation)
        ]
        described = {
            "version": _VERSION,
            "sizes": [x / length for x in (*(2.0 * slab.half_sizes), slab.encapsulated_thickness)],
            "clamp": [clamp.span / length, clamp.offset / length, compliance, clamp.faces],
            "laws": [[type(law).__name__, *dataclasses.astuple(law)] for law in laws],
            "margin": mechanics.margin / length,
            "bulk_ratio": mechanics.bulk_ratio,
            "lines": [[x / length for x in line] for line in self.lines],
            "angles_deg": ANGLES_DEG,
        }
        return Problem("bend", described, self._solve)

    def table(self) -> SolutionTable:
        """Table of the case, solved where it is not stored."""
        return _rescale(load_or_solve(self.problem(), _from_arrays), self._length)

    def _solve(self, report: Report) -> Arrays:
        log.info("solving the bends of a clamped sensor, which takes half a minute")
        x, y, z = (np.array(line) for line in self.lines)
        stack = ClampedStack(self.slab, self.clamp, self.mechanics, lines=(x, y, z))
        return tabulate_bends(stack, ANGLES_DEG, report).rescale(1.0 / self._length).arrays()

    @property
    def _length(self) -> float:
        """Thickness relative to the solved one."""
        return self.slab.encapsulated_thickness / _THICKNESS


def _from_arrays(arrays: Arrays) -> SolutionTable:
    return SolutionTable.from_arrays(arrays, np.float64)


# Solved stacks are those of many specimens, each of which weighs some of them.
@lru_cache(maxsize=64)
def _rescale(table: SolutionTable, length: float) -> SolutionTable:
    return table.rescale(length)


@lru_cache(maxsize=64)
def _evaluate(table: SolutionTable, angles_deg: tuple[float, ...]) -> Array:
    """Displacements of a table at angles, (angles, nx, ny, nz, 3) [m]."""
    return np.asarray(table.evaluate(angle=np.array(angles_deg))[0])


def _cases(
    design: SensorDesign, clamp: Clamp, mechanics: Mechanics, grid: SensorGrid
) -> Iterator[tuple[_Case, float]]:
    """Solved stacks on the nominal mesh, stretched, and their weights in the table of a design."""
    clamp, slab = on_support(clamp, design.support), Slab.from_design(design)
    gel, around = mechanics.gel.shear_modulus, slab.encapsulated_thickness / slab.thickness

    def vary_case(
        span: float, offset: float, thickness: float, ratio: float
    ) -> tuple[Slab, Clamp, Mechanics]:
        law = dataclasses.replace(mechanics.encapsulation, shear_modulus=ratio * gel)
        sizes = {"thickness": thickness, "encapsulated_thickness": around * thickness}
        return (
            dataclasses.replace(slab, **sizes),
            dataclasses.replace(clamp, span=span, offset=offset),
            dataclasses.replace(mechanics, encapsulation=law),
        )

    ratio = mechanics.encapsulation.shear_modulus / gel
    wanted = clamp.span, clamp.offset, slab.thickness, ratio
    axes = grid.span, grid.offset, grid.thickness, grid.ratio
    nominal = [own if one is None else one for own, one in zip(wanted, axes, strict=True)]
    sizes = _SPAN * nominal[0], _OFFSET * around * nominal[2], _THICKER * nominal[2]
    positions = [(a - b) / size for a, b, size in zip(wanted, nominal, sizes, strict=False)]
    positions.append(math.log(ratio / nominal[3]) / math.log(_STIFFER))
    middles = [round(t) if abs(t) > _REACH else 0 for t in positions]  # specimens share nodes
    stencils = [range(middle - 1, middle + 2) for middle in middles]
    x, y, z = clamped_lines(*vary_case(*nominal))
    ends = float(slab.half_sizes[0]), float(x[-1])
    for steps, weight in cut_weights(positions, stencils).items():
        values = [b + n * size for b, n, size in zip(nominal, steps, sizes, strict=False)]
        values.append(nominal[3] * _STIFFER ** steps[3])
        along = np.interp(x, [0.0, 0.5 * nominal[0], *ends], [0.0, 0.5 * values[0], *ends])
        lines = along, y, z * (values[2] / nominal[2])
        yield _Case(*vary_case(*values), tuple(tuple(line.tolist()) for line in lines)), weight
