"""Full 3D model of a bend: the encapsulated gel clamped by two turning plates."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Clamp
from eitskin.geometry.deformation.kinematics import Deformation, Gradients, Points
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading, graded_lines
from eitskin.simulator.mechanics.box_fields import CornerField, QuadraticField
from eitskin.simulator.mechanics.face import Face
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.load_stepping import LinearSprings
from eitskin.simulator.mechanics.mixed_solid import Solid
from eitskin.simulator.mechanics.turning_plates import TurningPlates

Array = NDArray[np.float64]

_TOLERANCE = 1e-9  # [m]
_PLANE_DECIMALS = 10  # decimals, in m, by which nodes of one plane agree


@dataclass(frozen=True, slots=True)
class Slab:
    """Rectangular layer in its encapsulation, the part of a design that bends depend on.

    Attributes:
        length, width, thickness: extents of the gel [m].
        encapsulated_thickness: encapsulated thickness of the whole stack [m].
    """

    length: float
    width: float
    thickness: float
    encapsulated_thickness: float

    @classmethod
    def from_design(cls, design: SensorDesign) -> "Slab":
        """Slab of a design; raises ConfigurationError for outlines that are not rectangular."""
        outline = design.outline
        if not isinstance(outline, Rectangle):
            raise ConfigurationError(
                f"a clamp bends sensors of rectangular outline, got {type(outline).__name__}; "
                'choose a kinematic fixture, Hinge or FreeArc (in a recipe fixture = "hinge")'
            )
        stack = design.thickness, design.encapsulated_thickness
        return cls(outline.length, outline.width, *stack)

    @property
    def half_sizes(self) -> Array:
        """Half of length, width and thickness of the gel [m], (3,)."""
        return 0.5 * np.array([self.length, self.width, self.thickness])


@dataclass(frozen=True, slots=True, eq=False)
class BentStack(Deformation):
    """Equilibrium of a clamped stack, a Deformation of gel and encapsulation.

    Attributes:
        angle_deg: angle between the plates.
        displacement: displacement of the quarter x >= 0, y >= 0 of coordinates from `centre` [m].
        pressure: mean stress of the mixed form in that quarter [Pa].
        centre: middle of the sensor at mid-layer [m].
        energy: stored in the whole sensor [J].
        moment: moment of each plate about the axis, the derivative of the energy by the angle in
            radians [N m].
    """

    angle_deg: float
    displacement: QuadraticField
    pressure: CornerField
    centre: tuple[float, float, float]
    energy: float
    moment: float

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions, and gradients that jump between cells of the mesh, slightly."""
        place, sides = self._quarter(points)
        moved = place + self.displacement(place)
        F = np.eye(3) + self.displacement.derivative(place)
        return self.centre + sides * moved, sides[..., :, None] * F * sides[..., None, :]

    def mean_stress(self, points: Points) -> Array:
        """Mean stress of the mixed form [Pa], (...), without the part that acts directly."""
        return self.pressure(self._quarter(points)[0])

    def _quarter(self, points: Points) -> tuple[Points, Array]:
        """Points mirrored to the quarter, and the signs of mirroring."""
        x = np.asarray(points, dtype=float) - self.centre
        sides = np.where(x < 0.0, -1.0, 1.0)
        sides[..., 2] = 1.0
        return sides * x, sides


class ClampedStack:
    """Flat sensor between the plates of a clamp, meshed once for all angles.

    The plates hold the faces of the encapsulation wherever |x| >= span / 2 from the middle, without
    slip, over the full width, and turn by +-theta/2 about the axis. All other faces are free: top
    and bottom between the plates, and the sides everywhere. Symmetry about the middles of length
    and width leaves a quarter to solve.

    The displacement within the clamps is small but reaches far: the pressure of an incompressible
    layer with held faces obeys Laplace's equation, so the material that the bend squeezes in decays
    along x by a factor e only over width / pi.

    Attributes:
        solid: the meshed quarter, in coordinates from the middle of the sensor at mid-layer [m].
        lines: grid lines of the quarter along x, y and z [m].
        half_sizes: half of length, width and thickness of the gel [m], (3,).
    """

    def __init__(
        self,
        design: SensorDesign | Slab,
        clamp: Clamp | None = None,
        mechanics: Mechanics | None = None,
        grading: Grading | None = None,
        lines: tuple[Array, Array, Array] | None = None,
    ) -> None:
        """Mesh a quarter of the sensor by boxes.

        Args:
            design: the sensor, of rectangular outline.
            clamp: span, offset, compliance and held faces; the default clamp when omitted.
            mechanics: materials.
            grading: finest at the edges of the plates, at the sides and at the held faces, with
                `layers` cells in the gel and as many or more in the encapsulation above and below;
                by the thickness of the sensor when omitted.
            lines: grid lines in place of those by `grading`, through the edges of plates and gel
                [m].
        """
        clamp, self._mechanics = clamp or Clamp(), mechanics or Mechanics()
        slab = design if isinstance(design, Slab) else Slab.from_design(design)
        self._clamp, self.half_sizes = clamp, slab.half_sizes
        self.lines = lines or clamped_lines(slab, clamp, self._mechanics, grading)
        self.solid = self._mesh_solid()
        x, y, z = self.half_sizes.tolist()
        self._centre = (x, y, z)
        self._plates = self._plate_support()

    def equilibria(self, angles_deg: Sequence[float]) -> Iterator[BentStack]:
        """Equilibria at angles [deg], each from the nearest ones solved before.

        Raises SolidError, naming the angle reached, where no stable equilibrium is found.
        """
        for angle in angles_deg:
            yield self._result(angle, self._plates.equilibrium(angle))

    def _mesh_solid(self) -> Solid:
        mesh = skfem.MeshHex.init_tensor(*self.lines)
        middles = mesh.p[:, mesh.t].mean(axis=1).T
        gel = np.all(np.abs(middles) < self.half_sizes, axis=1)
        laws = (self._mechanics.encapsulation, self._mechanics.gel)
        return Solid(mesh, laws, gel.astype(np.int64), "solid", self._mechanics.bulk_ratio)

    def _on_plate(self, x: Array) -> NDArray[np.bool_]:
        """Whether points (3, ...) [m] lie on a held face."""
        up = self.lines[2][-1]
        below, above = x[2] < _TOLERANCE - up, x[2] > up - _TOLERANCE
        face = below if self._clamp.faces == "bottom" else below | above
        held: NDArray[np.bool_] = face & (x[0] > 0.5 * self._clamp.span - _TOLERANCE)
        return held

    def _plate_support(self) -> TurningPlates:
        """Plate of the quarter; where it is compliant, the bond has traction = gap / compliance."""
        solid, compliance = self.solid, self._clamp.compliance
        X = solid.nodes
        plate = np.flatnonzero(self._on_plate(X.T))
        moved = [] if compliance else [solid.displacement_unknowns(plate)]
        mirrored = [3 * np.flatnonzero(X[:, axis] < _TOLERANCE) + axis for axis in (0, 1)]
        fixed = np.unique(np.concatenate([*moved, *mirrored]))
        bond = None
        if compliance:
            facets = solid.mesh.facets_satisfying(self._on_plate, boundaries_only=True)
            springs = np.eye(3) / compliance
            bond = LinearSprings(Face(solid, facets, 4).stiffness(springs, solid.unknowns))
        axis = np.array([0.0, 0.0, -self._clamp.offset])
        return TurningPlates(solid, {1.0: plate}, axis, fixed, bond)

    def _result(self, angle_deg: float, x: Array) -> BentStack:
        solid = self.solid
        order = np.lexsort(solid.nodes.round(_PLANE_DECIMALS).T[::-1])
        shape = tuple(2 * len(line) - 1 for line in self.lines)
        return BentStack(
            angle_deg,
            QuadraticField(self.lines, solid.displacement(x)[order].reshape(*shape, 3)),
            CornerField.from_corner_values(solid.mesh, self.lines, solid.cell_mean_stress(x)),
            self._centre,
            4.0 * self._plates.energy(angle_deg),  # of four quarters
            4.0 * self._plates.moment(angle_deg),
        )


def clamped_lines(
    slab: Slab,
    clamp: Clamp,
    mechanics: Mechanics,
    grading: Grading | None = None,
) -> tuple[Array, Array, Array]:
    """Grid lines of a clamped quarter along x, y and z from the middle of the sensor [m].

    Raises ConfigurationError for a span that exceeds the sensor's length.
    """
    (length, width, height), margin = slab.half_sizes, mechanics.margin
    grading = grading or bend_grading(slab.encapsulated_thickness)
    edge, whole = 0.5 * clamp.span, length + margin
    if edge > length:
        raise ConfigurationError(
            f"the span of {clamp.span:g} m must not exceed the sensor's length of {slab.length:g} m"
        )
    return (
        graded_lines(whole, {edge}, {length}, grading),
        graded_lines(width + margin, {width + margin}, {width}, grading),
        _heights(height, 0.5 * slab.encapsulated_thickness, grading, clamp.faces),
    )


def bend_grading(thickness: float) -> Grading:
    """Default grading for a stack of this thickness [m].

    Stress is singular at the edges of the plates, where most of the mesh's error comes from: small
    cells there and at the held faces, growing fast, take the least time.
    """
    return Grading(finest=thickness / 20.0, coarsest=0.75 * thickness, growth=1.0)


def _heights(gel: float, stack: float, grading: Grading, faces: Literal["both", "bottom"]) -> Array:
    """Grid lines across the stack: even in the gel, graded to the held faces around the gel [m].

    The gel is even also where it is held itself: bends are evaluated by one polynomial across it.
    """
    layers, around = grading.layers, stack - gel
    even = np.linspace(-gel, gel, layers + 1)
    if around < _TOLERANCE:
        return even
    largest = max(min(grading.coarsest, around / layers), grading.finest)
    held = graded_lines(around, {0.0}, (), replace(grading, coarsest=largest))
    free = np.linspace(0.0, around, layers + 1)
    above = held if faces == "both" else free
    return np.concatenate([held[:-1] - stack, even, (stack - above[:-1])[::-1]])
