"""Full 3D model of a bend: the encapsulated gel clamped by two turning plates."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Hinge
from eitskin.geometry.deformation.kinematics import Gradients, Points
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading, graded_lines
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.load_stepping import Load, SolidError, follow
from eitskin.simulator.mechanics.mixed_solid import Solid
from eitskin.simulator.mechanics.quadratic_field import QuadraticField

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_SAME = 1e-9  # [m]
_ROUNDED = 10  # decimals, in m, by which nodes of one plane agree


@dataclass(frozen=True, slots=True, eq=False)
class BentStack:
    """Equilibrium of a clamped stack, a Deformation of gel and encapsulation.

    Attributes:
        angle_deg: between the plates.
        displacement: of the quarter x >= 0, y >= 0 of coordinates from `centre` [m].
        centre: middle of the sensor at mid-layer [m].
        offset: of the hinge axis below `centre` [m].
        energy: stored in the whole sensor [J].
        moment: of each plate about the hinge axis, the derivative of the energy by the angle in
            radians [N m].
    """

    angle_deg: float
    displacement: QuadraticField
    centre: tuple[float, float, float]
    offset: float
    energy: float
    moment: float

    def positions(self, points: Points) -> Points:
        """Deformed positions [m], (..., 3), of flat points [m], (..., 3)."""
        place, sides, solved = self._quarter(points)
        turned = _turned(place, self._half_angle, self.offset)
        moved = np.where(solved[..., None], place + self.displacement(place), turned)
        return self.centre + sides * moved

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3); it jumps between cells of the mesh, slightly."""
        place, sides, solved = self._quarter(points)
        F = np.eye(3) + self.displacement.derivative(place)
        F = np.where(solved[..., None, None], F, _rotation(self._half_angle))
        quarter: Gradients = sides[..., :, None] * F * sides[..., None, :]
        return quarter

    @property
    def _half_angle(self) -> float:
        return 0.5 * math.radians(self.angle_deg)

    def _quarter(self, points: Points) -> tuple[Points, Array, NDArray[np.bool_]]:
        """Points mirrored to the quarter, signs of mirroring, and whether in the solved part."""
        x = np.asarray(points, dtype=float) - self.centre
        sides = np.where(x < 0.0, -1.0, 1.0)
        sides[..., 2] = 1.0
        x = sides * x
        _, Y, Z = self.displacement.lines
        outside = (x[..., 1] > Y[-1] + _SAME) | (np.abs(x[..., 2]) > Z[-1] + _SAME)
        if np.any(outside):
            raise ConfigurationError(
                f"{int(outside.sum())} of {outside.size} points lie beside the bent sensor of "
                f"width {2 * Y[-1]:g} m and thickness {2 * Z[-1]:g} m"
            )
        return x, sides, x[..., 0] <= self.displacement.lines[0][-1]


class ClampedStack:
    """Flat sensor between the plates of a hinge, meshed once for all angles.

    The plates hold the top and bottom faces of the encapsulation wherever |x| >= span / 2 from the
    middle, without slip, over the full width, and turn by +-theta/2 about the hinge axis. All
    other faces are free: top and bottom between the plates, and the sides everywhere. Symmetry
    about the middles of length and width leaves a quarter to solve.

    The displacement within the clamps is small but reaches far: the pressure of an incompressible
    layer with held faces obeys Laplace's equation, so the material that the bend squeezes in decays
    along x by a factor e only over width / pi.

    Attributes:
        solid: the meshed quarter, in coordinates from the middle of the sensor at mid-layer [m].
    """

    def __init__(
        self,
        design: SensorDesign,
        hinge: Hinge | None = None,
        mechanics: Mechanics | None = None,
        grading: Grading | None = None,
        inside: float | None = None,
    ) -> None:
        """Mesh a quarter of the sensor by boxes.

        Args:
            design: the sensor, of rectangular outline.
            hinge: only span and offset are used, not the profile of its kinematic model.
            mechanics: materials.
            grading: finest at the edges of the plates and at the long sides of the gel, `layers`
                cells in each of encapsulation, gel and encapsulation; by the thickness of the
                sensor when omitted.
            inside: length solved within each clamp, beyond which the sensor turns rigidly with the
                plate [m]; the whole clamp when omitted.
        """
        hinge, self._mechanics = hinge or Hinge(), mechanics or Mechanics()
        outline, margin = design.outline, self._mechanics.margin
        if not isinstance(outline, Rectangle):
            raise ConfigurationError(
                f"a clamped stack needs a rectangular outline, got {type(outline).__name__}"
            )
        thickness = design.encapsulated_thickness
        grading = grading or bend_grading(thickness)
        self._gel = 0.5 * np.array([outline.length, outline.width, design.thickness])
        self._clamp, self._offset = 0.5 * hinge.span, hinge.offset
        whole = self._gel[0] + margin
        if inside is not None and not inside > 0.0:
            raise ConfigurationError(f"inside must be a positive length in m, got {inside}")
        if self._clamp > self._gel[0]:
            raise ConfigurationError(
                f"the span of {hinge.span:g} m must not exceed the sensor's {outline.length:g} m"
            )
        end = whole if inside is None else self._clamp + inside
        self._truncated = end < whole
        width = self._gel[1]
        self._lines = (
            graded_lines(min(end, whole), {self._clamp}, {self._gel[0]}, grading),
            graded_lines(width + margin, {width}, (), grading),
            _heights(self._gel[2], 0.5 * thickness, grading.layers),
        )
        self.solid = self._meshed()
        self._centre = (float(self._gel[0]), float(self._gel[1]), float(self._gel[2]))
        self._held, self._fixed = self._supports()

    def equilibria(self, angles_deg: Sequence[float]) -> Iterator[BentStack]:
        """Equilibria at angles [deg], by load stepping from the one before, the first from flat.

        Raises SolidError, naming the angle reached, where no stable equilibrium is found.
        """
        flat = np.zeros(self.solid.unknowns)
        x = flat
        for before, angle in itertools.pairwise([0.0, *angles_deg]):
            if angle == 0.0:
                x = flat  # without strain, Newton's relative tolerance has no scale
            elif angle != before:
                x = self._followed(x, before, angle)
            yield self._result(angle, x)

    def _followed(self, x: Array, before: float, angle: float) -> Array:
        try:
            return follow([self.solid], x, partial(self._between, before, angle))[0]
        except SolidError as error:
            reached = before + error.reached * (angle - before)
            raise SolidError(
                f"the clamped stack was bent to {reached:.1f} deg of {angle:g} deg: {error}",
                error.reached,
            ) from error

    def _meshed(self) -> Solid:
        mesh = skfem.MeshHex.init_tensor(*self._lines)
        middles = mesh.p[:, mesh.t].mean(axis=1).T
        gel = np.all(np.abs(middles) < self._gel, axis=1)
        laws = (self._mechanics.encapsulation, self._mechanics.gel)
        return Solid(mesh, laws, gel.astype(np.int64), "solid", self._mechanics.bulk_ratio)

    def _supports(self) -> tuple[Indices, Indices]:
        """Nodes that move with the plate, and numbers of all prescribed unknowns."""
        X = self.solid.nodes
        along, _, up = self._lines
        plate = (np.abs(X[:, 2]) > up[-1] - _SAME) & (X[:, 0] > self._clamp - _SAME)
        if self._truncated:
            plate |= X[:, 0] > along[-1] - _SAME
        held = np.flatnonzero(plate)
        moved = (3 * held[:, None] + np.arange(3)).ravel()
        mirrored = [3 * np.flatnonzero(X[:, axis] < _SAME) + axis for axis in (0, 1)]
        return held, np.unique(np.concatenate([moved, *mirrored]))

    def _between(self, before: float, after: float, t: float) -> Load:
        """Prescribed displacements at the fraction t between two angles [deg]."""
        solid, held, angle_deg = self.solid, self._held, before + t * (after - before)
        X = solid.nodes[held]
        u = np.zeros_like(solid.nodes)
        u[held] = _turned(X, 0.5 * math.radians(angle_deg), self._offset) - X
        return Load(self._fixed, u.ravel()[self._fixed], np.zeros(solid.unknowns))

    def _result(self, angle_deg: float, x: Array) -> BentStack:
        solid, held = self.solid, self._held
        u = solid.displacement(x)
        f = solid.displacement(solid.forces(x))[held]
        arm = solid.nodes[held] + u[held] + np.array([0.0, 0.0, self._offset])
        moment = float(np.sum(arm[:, 2] * f[:, 0] - arm[:, 0] * f[:, 2]))
        order = np.lexsort(solid.nodes.round(_ROUNDED).T[::-1])
        shape = tuple(2 * len(line) - 1 for line in self._lines)
        values = QuadraticField(self._lines, u[order].reshape(*shape, 3))
        energy = 4.0 * solid.energy(x)
        # Each plate holds two quarters.
        return BentStack(angle_deg, values, self._centre, self._offset, energy, 2.0 * moment)


def bend_grading(thickness: float) -> Grading:
    """Default grading for a stack of this thickness [m]."""
    return Grading(finest=thickness / 5.0, coarsest=0.75 * thickness, growth=0.4)


def _heights(gel: float, stack: float, layers: int) -> Array:
    ends = np.unique([-stack, -gel, gel, stack])
    parts = [np.linspace(a, b, layers + 1)[1:] for a, b in itertools.pairwise(ends)]
    return np.concatenate([ends[:1], *parts])


def _rotation(angle: float) -> Array:
    """Rotation of the plate at x > 0 by an angle [rad], downwards for positive angles."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def _turned(points: Array, angle: float, offset: float) -> Array:
    """Points rotated about the hinge axis by an angle [rad]."""
    axis = np.array([0.0, 0.0, -offset])
    turned: Array = (points - axis) @ _rotation(angle).T + axis
    return turned
