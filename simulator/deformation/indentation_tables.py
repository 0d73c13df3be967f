"""Tables of single indentations: what is solved for a strip, its end, a side and a disc."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Disc, PlaneOutline, Rectangle
from eitskin.geometry.design.sensor import Support
from eitskin.simulator.deformation.contact import DentField
from eitskin.simulator.deformation.field import Basis, CubicSplines, Field, Polynomials
from eitskin.simulator.deformation.finite_stack import FiniteStack
from eitskin.simulator.deformation.solution_store import Report, processes
from eitskin.simulator.deformation.solution_table import TOLERANCE, Axis, SolutionTable
from eitskin.simulator.deformation.solved_correction import Correction
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.fitted_plan import Contact
from eitskin.simulator.mechanics.layer_stack import Indentation, Mechanics, Stack
from eitskin.simulator.mechanics.stack_mesh import Fineness, StackMesh, stack_mesh
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]
Bases = tuple[Basis, Basis]

# Lengths over the thickness of the stack.
DEPTHS = (0.1, 0.2, 0.32)
_FROM_SIDE = (0.0, 0.2, 0.45, 0.8, 1.25, 1.8, 2.5, 3.4, 4.5, 6.2)  # beyond the least distance
_MIN_RIM_DISTANCE = 0.08  # from the rim of the contact to the side of the stack
_FADE = 2.0  # length over which fields are faded out
_CELL = 1.0 / 40.0  # finest of the axisymmetric press, over the radius of the indenter

# Strip and its end. Corrections vary most at the sides next to a press. Near an end the strip's
# mesh would cost five times as much, and the difference to a strip of the same mesh needs less.
STRIP_REACH, END_LENGTH = 9.0, 11.0  # of the fields along x
_STRIP, _END, _STRETCH = (40, 32, 4), (20, 16, 4), 2.5  # polynomials
_ON_STRIP, _AT_END = Fineness(ends=0.0, sides=0.1, layers=2), Fineness(sides=0.0, layers=1)
_END_VANISHED = 2.0  # beyond the last distance from an end

# Straight side: distances of presses, and the splines of the field. Nodes are close next to the
# side, where stress is singular and electrodes lie. The first is beyond it, so that points on it
# are within.
_FROM_EDGE, _EDGE_VANISHED = (0.0, 0.2, 0.45, 0.8, 1.25, 1.8, 2.5, 3.4, 4.6), 1.9
_EDGE_REACH, _EDGE_DEPTH, _EDGE_FREE = 6.5, 7.5, 1.0
_EDGE_FINENESS = Fineness(ends=0.0, sides=0.1, layers=2, growth=1.0)
_EVEN, _NARROW, _WIDE, _EDGE_DEGREE = 2.5, 0.2, 0.5, 3
_SIDE_DISTANCES = (-0.02, 0.0, 0.04, 0.09, 0.15, 0.22, 0.31, 0.44)

# Disc. One layer of quadratic cells is a quadratic over the height.
_DISC_FINENESS = Fineness(ends=0.0, sides=0.0, layers=1)
_DISC_CELL, _DISC_REACH, _DISC_DEGREE = 0.2, 1.01, 2  # the reach over the radius


@dataclass(frozen=True, slots=True, eq=False)
class Indentations:
    """Stack and indenter of all solutions of a table.

    Attributes:
        stack: the layers.
        mechanics: margin next to the gel, and its material.
        support: support of the base, alike everywhere.
        indenter: rigid body that presses.
        dents: axisymmetric presses of rising depth on the unbounded stack.
    """

    stack: Stack
    mechanics: Mechanics
    support: Support
    indenter: Indenter
    dents: tuple[Indentation, ...] = ()

    def with_depths(self, depths: Sequence[float]) -> "Indentations":
        """The same with dents to depths over the thickness of the stack."""
        press = AxisymmetricPress(self.stack, self.indenter, finest=_CELL * self.indenter.rims[1])
        return replace(self, dents=tuple(press.to_depth(part * self.thickness) for part in depths))

    @property
    def thickness(self) -> float:
        """Thickness of the whole stack [m]."""
        return self.stack.levels[-1]

    @property
    def height(self) -> float:
        """Thickness of the gel [m]."""
        return self.stack.sheets[self.stack.gel].thickness

    @property
    def sizes(self) -> dict[str, float]:
        """Lengths and modulus that all tables hold."""
        modulus = self.stack.sheets[self.stack.gel].law.shear_modulus
        return {"thickness": self.thickness, "height": self.height, "modulus": modulus}

    @property
    def least(self) -> float:
        """Distance of a press from a side, at which its contact is just on the stack [m]."""
        beyond = self.indenter.rims[1] - self.mechanics.margin
        return max(beyond + _MIN_RIM_DISTANCE * self.thickness, 0.0)

    @property
    def depth_axis(self) -> Axis:
        """Solved depths [m]."""
        return Axis("depth", "from-zero", np.array([dent.depth for dent in self.dents]))

    def side_axis(self, middle: float) -> Axis:
        """Distances from a side up to the middle [m], wider apart farther in."""
        nodes = self.least + self.thickness * np.array(_FROM_SIDE)
        inside = nodes[nodes < middle - 0.25 * self.thickness]
        return Axis("distance_to_side", "mirrored", np.append(inside, middle))

    def mesh(
        self, outline: PlaneOutline, contacts: Sequence[tuple[float, float]], fineness: Fineness
    ) -> StackMesh:
        """Mesh of the stack, refined around contacts at (x, y) [m]."""
        around = [Contact(x, y, self.indenter.rims[1]) for x, y in contacts]
        return stack_mesh(outline, self.stack, self.mechanics, self.support, around, fineness)

    def solve(
        self, outline: PlaneOutline, place: tuple[float, float], fineness: Fineness
    ) -> list[Correction]:
        """Corrections of the dents at a place [m], each started from the last."""
        stack, solved = FiniteStack(self.mesh(outline, [place], fineness)), list[Correction]()
        for number, dent in enumerate(self.dents):
            start = None
            if solved:
                start = solved[-1].unknowns * dent.depth / self.dents[number - 1].depth
            solved.append(stack.correction([DentField(*place, self.indenter, dent)], start))
        return solved


class PressFields(NamedTuple):
    """Coefficients of fields of rising depth, (d, nx, ny, nz, 4), and extra depths (d,) [m]."""

    fields: Array
    extra_depth: Array


class Layout(NamedTuple):
    """Press on an outline, and the field that its corrections are fitted by.

    Attributes:
        outline: outline of the stack.
        place: place of the press, (x, y) [m].
        fineness: fineness of the mesh.
        origin: origin of the field's coordinates on the outline, (3,) [m].
        bases: bases of the field.
        degree: degree of the field over the height.
        ends: least and greatest x and y of the field, (2,) each [m].
    """

    outline: PlaneOutline
    place: tuple[float, float]
    fineness: Fineness
    origin: Sequence[float]
    bases: Bases
    degree: int
    ends: tuple[Array, Array] = (np.full(2, -np.inf), np.full(2, np.inf))


def _solve_presses(
    case: Indentations, layout: Layout, far: PressFields | None = None
) -> PressFields:
    """Fields of presses of all depths, less those far from an end."""
    fields, extra = [], []
    corrections = case.solve(layout.outline, layout.place, layout.fineness)
    for number, correction in enumerate(corrections):
        beside = None
        if far is not None:
            along, across = strip_bases(case.thickness, layout.outline.width)
            here = replace(
                along, low=along.low + layout.place[0], high=along.high + layout.place[0]
            )
            beside = Field((here, across), case.height, far.fields[number])
        values = partial(_values, layout, _FADE * case.thickness, correction, beside)
        field = Field.from_function(values, layout.bases, case.height, layout.degree)
        fields.append(field.coefficients)
        extra.append(correction.sunk[0])
    return PressFields(np.array(fields), np.array(extra))


def _values(
    layout: Layout, length: float, correction: Correction, side_field: Field | None, points: Array
) -> Array:
    """Correction, less a field, at points (nx, ny, nz, 3) of a grid in the field's coordinates."""
    values = correction.in_gel(points + np.array(layout.origin))
    if side_field is not None:
        values -= side_field.on_grid(points[:, 0, 0, 0], points[0, :, 0, 1], points[0, 0, :, 2])
    return fade_at_box(values, points, layout.ends, length)


def solve_each(
    solve: Callable[..., PressFields], report: Report, workers: int, *places: Sequence[object]
) -> list[PressFields]:
    """Solutions at places, in several processes."""
    solved = []
    with processes(workers) as run:
        for each in run(solve, *places):
            solved.append(each)
            report(len(solved), len(places[0]))
    return solved


def tabulate(
    case: Indentations,
    axes: Sequence[Axis],
    solutions: Sequence[PressFields],
    tolerance: float = TOLERANCE,
    measure: Callable[[Array], Array] | None = None,
    **sizes: float | Array,
) -> SolutionTable:
    """Table of solutions over axes, the last of which are depths.

    `tolerance` and `measure` are those of `SolutionTable.from_solutions`.
    """
    shape = [axis.weights(axis.nodes[:1]).shape[-1] for axis in axes]
    fields = np.array([each.fields for each in solutions])
    extra = np.array([each.extra_depth for each in solutions])
    return SolutionTable.from_solutions(
        axes,
        fields.reshape(*shape, *fields.shape[-4:]),
        {"extra_depth": extra.reshape(shape)},
        {**case.sizes, **sizes},
        tolerance,
        measure,
    )


def solve_strip(
    case: Indentations, width: float, report: Report, workers: int = 1
) -> SolutionTable:
    """Presses on a long strip, in coordinates from the press along x, by distance and depth."""
    case = case.with_depths(DEPTHS)
    side = case.side_axis(0.5 * width)
    solve = partial(_on_strip, case, width, _ON_STRIP)
    solved = solve_each(solve, report, workers, side.nodes.tolist())
    return tabulate(case, [side, case.depth_axis], solved, width=width, least=case.least)


def _on_strip(case: Indentations, width: float, fineness: Fineness, y: float) -> PressFields:
    """Presses at y on a long strip."""
    H = case.thickness
    x, reach, bases = (STRIP_REACH + 1.0) * H, STRIP_REACH * H, strip_bases(H, width)
    outline, origin, end = Rectangle(2.0 * x, width), [x, 0.0, 0.0], np.array([reach, np.inf])
    layout = Layout(outline, (x, y), fineness, origin, bases, _STRIP[2] - 1, (-end, end))
    return _solve_presses(case, layout)


def strip_bases(thickness: float, width: float) -> tuple[Polynomials, Polynomials]:
    """Bases of the field of a press on a strip, from the press along x."""
    reach = STRIP_REACH * thickness
    along = Polynomials(-reach, reach, _STRIP[0], _STRETCH, vanish=True)
    return along, Polynomials(0.0, width, _STRIP[1])


def solve_end(case: Indentations, width: float, report: Report, workers: int = 1) -> SolutionTable:
    """Differences of presses near an end of a strip to those far from it, from the end along x."""
    case = case.with_depths(DEPTHS)
    side, H = case.side_axis(0.5 * width), case.thickness
    ends = case.least + H * np.array(_FROM_SIDE)
    strips = solve_each(
        partial(_on_strip, case, width, _AT_END), lambda *_: None, workers, side.nodes.tolist()
    )
    places = product(ends.tolist(), zip(side.nodes.tolist(), strips, strict=True))
    at = [(x, y, strip) for x, (y, strip) in places]
    solved = solve_each(
        partial(_solve_end_difference, case, width), report, workers, *zip(*at, strict=True)
    )
    end = Axis("distance_to_end", "vanishing", np.append(ends, ends[-1] + _END_VANISHED * H))
    return tabulate(case, [end, side, case.depth_axis], solved, width=width)


def _solve_end_difference(
    case: Indentations, width: float, x: float, y: float, strip: PressFields
) -> PressFields:
    """Difference of presses at a distance x from an end to those on an equally meshed strip."""
    H = case.thickness
    outline, end = Rectangle((END_LENGTH + 3.0) * H, width), np.array([END_LENGTH * H, np.inf])
    bases, origin = end_bases(H, width), [0.0, 0.0, 0.0]
    layout = Layout(outline, (x, y), _AT_END, origin, bases, _END[2] - 1, (-end, end))
    near = _solve_presses(case, layout, strip)
    return PressFields(near.fields, near.extra_depth - strip.extra_depth)


def end_bases(thickness: float, width: float) -> Bases:
    """Bases of the field near an end of a strip, from the end along x."""
    along = Polynomials(0.0, END_LENGTH * thickness, _END[0], vanish=True)
    return along, Polynomials(0.0, width, _END[1])


def solve_side(case: Indentations, report: Report, workers: int = 1) -> SolutionTable:
    """Presses next to a straight side of a wide stack, by distance and depth.

    Fields are in a frame with x along the side from the foot of the press and y into the gel, from
    the size `middle`.
    """
    case, H = case.with_depths(DEPTHS), case.thickness
    distances = case.least + H * np.array(_FROM_EDGE)
    solved = solve_each(partial(_solve_side, case), report, workers, distances.tolist())
    vanished = np.append(distances, distances[-1] + _EDGE_VANISHED * H)
    side = Axis("distance_to_side", "vanishing", vanished)
    (along, inward), middle = _side_nodes(H)
    return tabulate(
        case, [side, case.depth_axis], solved, along=along, inward=inward, middle=middle
    )


def _solve_side(case: Indentations, distance: float) -> PressFields:
    """Presses at a distance from the side [m]."""
    H, ((along, inward), middle) = case.thickness, _side_nodes(case.thickness)
    x, reach, depth = (_EDGE_REACH + _EDGE_FREE) * H, _EDGE_REACH * H, _EDGE_DEPTH * H - middle
    width = max(distance + _EDGE_REACH * H, (_EDGE_DEPTH + _EDGE_FREE) * H)
    place, outline, origin = (x, distance), Rectangle(2.0 * x, width), [x, middle, 0.0]
    bases = CubicSplines(along), CubicSplines(inward)
    ends = np.array([-reach, -np.inf]), np.array([reach, depth])
    layout = Layout(outline, place, _EDGE_FINENESS, origin, bases, _EDGE_DEGREE, ends)
    return _solve_presses(case, layout)


def _side_nodes(thickness: float) -> tuple[tuple[Array, Array], float]:
    """Nodes of splines along the side and into the gel, and where they begin from the side [m]."""

    def cells(end: float) -> Array:
        even = np.arange(0.0, _EVEN + 0.5 * _NARROW, _NARROW)
        wide = math.ceil((end - even[-1]) / _WIDE)
        return np.append(even, np.linspace(even[-1], end, wide + 1)[1:])

    half, inner = cells(_EDGE_REACH), cells(_EDGE_DEPTH)
    inward = np.append(_SIDE_DISTANCES, inner[inner > _SIDE_DISTANCES[-1] + 0.5 * _NARROW])
    along = np.append(-half[:0:-1], half)
    middle = 0.5 * (_EDGE_DEPTH + _SIDE_DISTANCES[0]) * thickness
    return (thickness * along, thickness * inward - middle), middle


def solve_disc(
    case: Indentations, radius: float, report: Report, workers: int = 1
) -> SolutionTable:
    """Presses between the rim of a disc and its middle, by distance from the rim and depth.

    Fields are of presses at positive x, from the middle of the disc.

    Raises ConfigurationError for an indenter too large for the disc.
    """
    side, H = case.side_axis(radius), case.thickness
    if len(side.nodes) < 2:
        raise ConfigurationError(
            f"an indenter of {1e3 * case.indenter.rims[1]:.1f} mm radius leaves no room for a "
            f"table on a disc of {1e3 * radius:.1f} mm radius; use touch_model='solved'"
        )
    case = case.with_depths(DEPTHS)
    reach = _DISC_REACH * radius
    cells = max(4, math.ceil(reach / (_DISC_CELL * H)))
    nodes = np.linspace(-reach, reach, 2 * cells + 1)
    solve = partial(_on_disc, case, radius, nodes)
    solved = solve_each(solve, report, workers, side.nodes.tolist())
    return tabulate(case, [side, case.depth_axis], solved, nodes=nodes, least=case.least)


def _on_disc(case: Indentations, radius: float, nodes: Array, distance: float) -> PressFields:
    """Presses at a distance from the rim [m]."""
    place, middle = (2.0 * radius - distance, radius), [radius, radius, 0.0]
    bases = CubicSplines(nodes), CubicSplines(nodes)
    layout = Layout(Disc(radius), place, _DISC_FINENESS, middle, bases, _DISC_DEGREE)
    return _solve_presses(case, layout)


def fade_at_box(values: Array, points: Array, ends: tuple[Array, Array], length: float) -> Array:
    """Values (..., k) at points (..., 3) that end smoothly at a box, over a length [m].

    `ends` are the least and the greatest x and y, (2,) each [m].
    """
    low, high = ends
    inside = np.minimum(points[..., :2] - low, high - points[..., :2])
    t = np.clip(inside / length, 0.0, 1.0)
    return np.asarray(values * (t * t * (3.0 - 2.0 * t)).prod(axis=-1)[..., None])
