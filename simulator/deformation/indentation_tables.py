"""Tables of single indentations: what is solved for a strip, its end, a side and a disc."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import Disc, PlaneOutline, Rectangle
from eitskin.geometry.design.sensor import Support
from eitskin.simulator.deformation.contact import DentField
from eitskin.simulator.deformation.field import Basis, CubicSplines, Field, Polynomials
from eitskin.simulator.deformation.finite_stack import Correction, FiniteStack
from eitskin.simulator.deformation.solution_store import Report, processes
from eitskin.simulator.deformation.solution_table import Axis, SolutionTable
from eitskin.simulator.deformation.stack_mesh import Contact, Fineness, StackMesh, stack_mesh
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Indentation, Mechanics, Stack
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]
Bases = tuple[Basis, Basis]

# Lengths over the thickness of the stack.
DEPTHS = (0.1, 0.2, 0.32)
_FROM_SIDE = (0.0, 0.2, 0.45, 0.8, 1.25, 1.8, 2.5, 3.4, 4.5, 6.2)  # beyond the least distance
_LEAST = 0.08  # from the rim of the contact to the side of the stack
_FADE = 2.0  # length over which fields are faded out
_CELL = 1.0 / 40.0  # finest of the axisymmetric press, over the radius of the indenter

# Strip and its end. Corrections vary most at the sides beside a press. Near an end the strip's mesh
# would cost five times as much, and the difference to a strip of the same mesh needs less.
STRIP_REACH, END_LENGTH = 9.0, 11.0  # of the fields along x
_STRIP, _END, _STRETCH = (40, 32, 4), (20, 16, 4), 2.5  # polynomials
_ON_STRIP, _AT_END = Fineness(ends=0.0, sides=0.1, layers=2), Fineness(sides=0.0, layers=1)
_END_VANISHED = 2.0  # beyond the last distance from an end

# Straight side: distances of presses, and the splines of the field. Nodes are close beside the
# side, where stress is singular and electrodes lie. The first is beyond it, so that points on it
# are within.
_FROM_EDGE, _EDGE_VANISHED = (0.0, 0.2, 0.45, 0.8, 1.25, 1.8, 2.5, 3.4, 4.6), 1.9
_EDGE_REACH, _EDGE_DEPTH, _EDGE_FREE = 6.5, 7.5, 1.0
_EDGE_FINENESS = Fineness(ends=0.0, sides=0.1, layers=2, growth=1.0)
_EVEN, _NARROW, _WIDE, _EDGE_DEGREE = 2.5, 0.2, 0.5, 3
_BESIDE = (-0.02, 0.0, 0.04, 0.09, 0.15, 0.22, 0.31, 0.44)

# Disc. One layer of quadratic cells is a quadratic over the height.
_DISC_FINENESS = Fineness(ends=0.0, sides=0.0, layers=1)
_DISC_CELL, _DISC_REACH, _DISC_DEGREE = 0.2, 1.01, 2  # the reach over the radius


@dataclass(frozen=True, slots=True, eq=False)
class Indentations:
    """Stack and indenter of all solutions of a table.

    Attributes:
        stack: the layers.
        mechanics: margin beside the gel, and its material.
        support: of the base, alike everywhere.
        indenter: rigid body that presses.
        dents: axisymmetric presses of rising depth on the unbounded stack.
    """

    stack: Stack
    mechanics: Mechanics
    support: Support
    indenter: Indenter
    dents: tuple[Indentation, ...] = ()

    def to_depths(self, depths: Sequence[float]) -> "Indentations":
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
        return max(beyond + _LEAST * self.thickness, 0.0)

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
        self, outline: PlaneOutline, x: float, y: float, fineness: Fineness
    ) -> list[Correction]:
        """Corrections of the dents at (x, y) [m], each started from the last."""
        stack, solved = FiniteStack(self.mesh(outline, [(x, y)], fineness)), list[Correction]()
        for number, dent in enumerate(self.dents):
            start = None
            if solved:
                start = solved[-1].unknowns * dent.depth / self.dents[number - 1].depth
            solved.append(stack.correction([DentField(x, y, self.indenter, dent)], start))
        return solved


class Solved(NamedTuple):
    """Coefficients of fields of rising depth, (d, nx, ny, nz, 4), and extra depths (d,) [m]."""

    fields: Array
    extra_depth: Array


def _fitted(
    solved: Sequence[Correction],
    function: Callable[[Correction], Callable[[Array], Array]],
    bases: Bases,
    height: float,
    degree: int,
) -> Solved:
    """Fields of corrections, made by `function`, on bases."""
    fields = [Field.from_function(function(each), bases, height, degree) for each in solved]
    extra = np.array([each.sunk[0] for each in solved])
    return Solved(np.array([field.coefficients for field in fields]), extra)


def solve_each(
    solve: Callable[..., Solved], report: Report, workers: int, *places: Sequence[object]
) -> list[Solved]:
    """Solutions at places, in several processes."""
    solved = []
    with processes(workers) as run:
        for each in run(solve, *places):
            solved.append(each)
            report(len(solved), len(places[0]))
    return solved


def tabulate(
    about: Indentations,
    axes: Sequence[Axis],
    solved: Sequence[Solved],
    **sizes: float | Array,
) -> SolutionTable:
    """Table of solutions over axes, the last of which are depths."""
    shape = [each.weights(each.nodes[:1]).shape[-1] for each in axes]
    fields = np.array([each.fields for each in solved])
    extra = np.array([each.extra_depth for each in solved])
    return SolutionTable.from_solutions(
        axes,
        fields.reshape(*shape, *fields.shape[-4:]),
        {"extra_depth": extra.reshape(shape)},
        {**about.sizes, **sizes},
    )


def solve_strip(
    about: Indentations, width: float, report: Report, workers: int = 1
) -> SolutionTable:
    """Presses on a long strip, in coordinates from the press along x, by distance and depth."""
    about = about.to_depths(DEPTHS)
    side = about.side_axis(0.5 * width)
    solve = partial(_on_strip, about, width, _ON_STRIP)
    solved = solve_each(solve, report, workers, side.nodes.tolist())
    return tabulate(about, [side, about.depth_axis], solved, width=width, least=about.least)


def solve_end(about: Indentations, width: float, report: Report, workers: int = 1) -> SolutionTable:
    """Differences of presses near an end of a strip to those far from it, from the end along x."""
    about = about.to_depths(DEPTHS)
    side, H = about.side_axis(0.5 * width), about.thickness
    ends = about.least + H * np.array(_FROM_SIDE)
    strips = solve_each(
        partial(_on_strip, about, width, _AT_END), lambda *_: None, workers, side.nodes.tolist()
    )
    places = [(x, k) for x in ends.tolist() for k in range(len(side.nodes))]
    solved = solve_each(
        partial(_at_end, about, width),
        report,
        workers,
        [x for x, _ in places],
        [float(side.nodes[k]) for _, k in places],
        [strips[k] for _, k in places],
    )
    end = Axis("distance_to_end", "vanishing", np.append(ends, ends[-1] + _END_VANISHED * H))
    return tabulate(about, [end, side, about.depth_axis], solved, width=width)


def strip_bases(thickness: float, width: float) -> Bases:
    """Bases of the field of a press on a strip, from the press along x."""
    reach = STRIP_REACH * thickness
    along = Polynomials(-reach, reach, _STRIP[0], _STRETCH, vanish=True)
    return along, Polynomials(0.0, width, _STRIP[1])


def end_bases(thickness: float, width: float) -> Bases:
    """Bases of the field near an end of a strip, from the end along x."""
    along = Polynomials(0.0, END_LENGTH * thickness, _END[0], vanish=True)
    return along, Polynomials(0.0, width, _END[1])


def _on_strip(about: Indentations, width: float, fineness: Fineness, y: float) -> Solved:
    """Press at y on a long strip."""
    H, middle = about.thickness, (STRIP_REACH + 1.0) * about.thickness
    solved = about.solve(Rectangle(2.0 * middle, width), middle, y, fineness)
    shift = np.array([middle, 0.0, 0.0])

    def function(correction: Correction) -> Callable[[Array], Array]:
        return faded(
            lambda points: correction.in_gel(points + shift), (STRIP_REACH * H,), _FADE * H
        )

    return _fitted(solved, function, strip_bases(H, width), about.height, _STRIP[2] - 1)


def _at_end(about: Indentations, width: float, x: float, y: float, strip: Solved) -> Solved:
    """Difference of a press at a distance x from an end to that on an equally meshed strip."""
    H = about.thickness
    solved = about.solve(Rectangle((END_LENGTH + 3.0) * H, width), x, y, _AT_END)
    far = iter(Field(strip_bases(H, width), about.height, each).shifted(x) for each in strip.fields)

    def function(correction: Correction) -> Callable[[Array], Array]:
        beside = next(far)

        def difference(points: Array) -> Array:
            axes = points[:, 0, 0, 0], points[0, :, 0, 1], points[0, 0, :, 2]
            return correction.in_gel(points) - beside.on_grid(*axes)

        return faded(difference, (END_LENGTH * H,), _FADE * H)

    near = _fitted(solved, function, end_bases(H, width), about.height, _END[2] - 1)
    return Solved(near.fields, near.extra_depth - strip.extra_depth)


def solve_side(about: Indentations, report: Report, workers: int = 1) -> SolutionTable:
    """Presses beside a straight side of a wide stack, by distance and depth.

    Fields are in a frame with x along the side from the foot of the press and y into the gel, from
    the size `middle`.
    """
    about, H = about.to_depths(DEPTHS), about.thickness
    distances = about.least + H * np.array(_FROM_EDGE)
    solved = solve_each(partial(_beside_side, about), report, workers, distances.tolist())
    vanished = np.append(distances, distances[-1] + _EDGE_VANISHED * H)
    side = Axis("distance_to_side", "vanishing", vanished)
    along, inward = _side_nodes(H)
    return tabulate(
        about, [side, about.depth_axis], solved, along=along, inward=inward, middle=_side_middle(H)
    )


def _beside_side(about: Indentations, distance: float) -> Solved:
    """Presses at a distance from the side [m]."""
    H = about.thickness
    x, middle = (_EDGE_REACH + _EDGE_FREE) * H, _side_middle(H)
    width = max(distance + _EDGE_REACH * H, (_EDGE_DEPTH + _EDGE_FREE) * H)
    solved = about.solve(Rectangle(2.0 * x, width), x, distance, _EDGE_FINENESS)
    shift, along, across = np.array([x, middle, 0.0]), _EDGE_REACH * H, _EDGE_DEPTH * H - middle

    def function(correction: Correction) -> Callable[[Array], Array]:
        inner = faded(lambda points: correction.in_gel(points + shift), (along,), _FADE * H)

        def field(points: Array) -> Array:
            return inner(points) * _step(across - points[..., 1], _FADE * H)[..., None]

        return field

    bases = CubicSplines(_side_nodes(H)[0]), CubicSplines(_side_nodes(H)[1])
    return _fitted(solved, function, bases, about.height, _EDGE_DEGREE)


def _side_middle(thickness: float) -> float:
    """Distance of the middle of the fields from the side [m]."""
    return 0.5 * (_EDGE_DEPTH + _BESIDE[0]) * thickness


def _side_nodes(thickness: float) -> tuple[Array, Array]:
    """Nodes of the splines along the side and into the gel [m]."""

    def cells(end: float) -> Array:
        even = np.arange(0.0, _EVEN + 0.5 * _NARROW, _NARROW)
        wide = math.ceil((end - even[-1]) / _WIDE)
        return np.append(even, np.linspace(even[-1], end, wide + 1)[1:])

    half, inner = cells(_EDGE_REACH), cells(_EDGE_DEPTH)
    inward = np.append(_BESIDE, inner[inner > _BESIDE[-1] + 0.5 * _NARROW])
    along = np.append(-half[:0:-1], half)
    return thickness * along, thickness * inward - _side_middle(thickness)


def solve_disc(
    about: Indentations, radius: float, report: Report, workers: int = 1
) -> SolutionTable:
    """Presses between the rim of a disc and its middle, by distance from the rim and depth.

    Fields are of presses at positive x, from the middle of the disc.

    Raises ConfigurationError for an indenter too large for the disc.
    """
    side, H = about.side_axis(radius), about.thickness
    if len(side.nodes) < 2:
        raise ConfigurationError(
            f"an indenter of {1e3 * about.indenter.rims[1]:.1f} mm radius leaves no room for a "
            f"table on a disc of {1e3 * radius:.1f} mm radius; use touch_model='solved'"
        )
    about = about.to_depths(DEPTHS)
    reach = _DISC_REACH * radius
    cells = max(4, math.ceil(reach / (_DISC_CELL * H)))
    nodes = np.linspace(-reach, reach, 2 * cells + 1)
    solve = partial(_on_disc, about, radius, nodes)
    solved = solve_each(solve, report, workers, side.nodes.tolist())
    return tabulate(about, [side, about.depth_axis], solved, nodes=nodes, least=about.least)


def _on_disc(about: Indentations, radius: float, nodes: Array, distance: float) -> Solved:
    """Presses at a distance from the rim [m]."""
    solved = about.solve(Disc(radius), 2.0 * radius - distance, radius, _DISC_FINENESS)
    middle = np.array([radius, radius, 0.0])

    def function(correction: Correction) -> Callable[[Array], Array]:
        return lambda points: correction.in_gel(points + middle)

    bases = CubicSplines(nodes), CubicSplines(nodes)
    return _fitted(solved, function, bases, about.height, _DISC_DEGREE)


def faded(
    field: Callable[[Array], Array], ends: Sequence[float], length: float
) -> Callable[[Array], Array]:
    """Field that is faded out towards ends along x and y, from the origin, over a length [m]."""

    def fading(points: Array) -> Array:
        values = field(points)
        for axis, end in enumerate(ends):
            values = values * _step(end - np.abs(points[..., axis]), length)[..., None]
        return values

    return fading


def _step(inside: Array, length: float) -> Array:
    """Smooth step from 0 to 1 over a length [m], of distances inside the end [m]."""
    t = np.clip(inside / length, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
