"""Contact of an indenter: its frame on a bent top, its dent, and the area that it holds."""

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.simulator.mechanics.box_fields import shape_functions
from eitskin.simulator.mechanics.face import Face
from eitskin.simulator.mechanics.layer_stack import Indentation, Stack
from eitskin.simulator.mechanics.load_stepping import LinearSprings
from eitskin.simulator.mechanics.mixed_solid import Solid
from eitskin.simulator.scene.indenters import Cylinder, Footprint, Indenter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_GRADIENT_OFFSET = 1e-4  # [m]; gradients of a solution in boxes jump between them
_BESIDE = np.array([[-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
_AXIS = 1e-9  # [m]
_ON_ROUNDING = 0.25  # of the rounding of an edge, that is not touched
_MAX_OFF_CENTRE = 0.02  # distance of a punch's middle from its force, over its size
_PULLED = 0.02  # pull at which a tilted punch leaves the face, over the mean pressure
_CHUNK_POINTS = 8_000  # points, so that gathered splines stay small
_PARTS = 12  # of a facet that the rim may cut, along each side, with 2 x 2 points each


class BentState(Protocol):
    """Equilibrium of the whole bent stack, in the coordinates of the design."""

    def __hash__(self) -> int:
        """Hash, under which solved presses are kept."""
        ...

    def map_points(self, points: Array) -> tuple[Array, Array]:
        """Bent positions [m], (..., 3), of flat points [m], and gradients, (..., 3, 3)."""
        ...

    def gradient(self, points: Array) -> Array:
        """Deformation gradient, (..., 3, 3)."""
        ...

    def mean_stress(self, points: Array) -> Array:
        """Mean stress of the mixed form [Pa], (...), without the part that acts directly."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ContactFrame:
    """Tangent frame of the bent top of a stack at a point under an indenter.

    A dent u_d of the flat, unbounded stack adds R u_d(x, y) to a bend, with x and y from the
    indenter's axis multiplied by the stretches of the top: the contact has its size in the bent
    sensor, and the force on the indenter is that of the dent, along the normal.

    Attributes:
        x, y: flat position of the axis [m].
        place: bent position of the touched point [m], (3,).
        rotation: R, its columns the tangents along x and y and the normal, (3, 3).
        stretches: stretches of the top along both tangents, (2,).
    """

    x: float
    y: float
    place: Array
    rotation: Array
    stretches: Array

    @classmethod
    def from_bent_top(
        cls, bent: BentState | Deformation, x: float, y: float, stack: Stack
    ) -> "ContactFrame":
        """Frame of the top of a bent stack under (x, y) [m]."""
        return cls.from_places(bent, np.array([[x, y]]), stack)[0]

    @classmethod
    def from_places(
        cls, bent: BentState | Deformation, places: Array, stack: Stack
    ) -> "list[ContactFrame]":
        """Frames of the top of a bent stack under places (n, 2) [m]."""
        top = np.full((len(places), 1), stack.levels[-1] - stack.levels[stack.gel])
        touched = np.concatenate([places, top], axis=1)
        around = touched[:, None] + _GRADIENT_OFFSET * _BESIDE
        moved, F = bent.map_points(np.concatenate([touched, around.reshape(-1, 3)]))
        F = F[len(places) :].reshape(-1, len(_BESIDE), 3, 3).mean(axis=1)
        along, normal = F[..., 0], np.cross(F[..., 0], F[..., 1])
        along, normal = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (along, normal))
        rotations = np.stack([along, np.cross(normal, along), normal], axis=2)
        stretches = np.linalg.norm(F[..., :2], axis=1)
        parts = zip(places.tolist(), moved[: len(places)], rotations, stretches, strict=True)
        return [cls(x, y, *others) for (x, y), *others in parts]

    @property
    def normal(self) -> Array:
        """Normal of the bent top, (3,)."""
        return np.asarray(self.rotation[:, 2])

    def stretch_points(self, points: Array) -> Array:
        """Points (..., 3) [m] with their distances from the axis as in the bent top."""
        axis = np.array([self.x, self.y, 0.0])
        return np.asarray(axis + (points - axis) * self._scale)

    def rotate_vectors(self, vectors: Array) -> Array:
        """Vectors (..., 3) of a dent in the directions of the bent top."""
        return np.asarray(vectors @ self.rotation.T)

    def gradient(self, gradient: Array) -> Array:
        """Displacement gradient (..., 3, 3) of the turned dent by flat positions."""
        return np.asarray(self.rotation @ gradient * self._scale)

    def nominal(self, stress: Array) -> Array:
        """First Piola-Kirchhoff stress (..., 3, 3) [Pa] of the turned dent by flat areas."""
        return np.asarray(self.rotation @ stress * (np.prod(self._scale) / self._scale))

    def flatten_points(self, points: Array) -> Array:
        """Positions (n, 3) [m] of points (n, 3) of the top that is pressed flat."""
        away = self.stretch_points(points) - np.array([self.x, self.y, 0.0])
        away[:, 2] = 0.0
        return np.asarray(self.place + self.rotate_vectors(away))

    @property
    def _scale(self) -> Array:
        return np.array([*self.stretches, 1.0])


class FieldValues(NamedTuple):
    """Displacement (n, 3) [m], its gradient (n, 3, 3) and mean stress (n,) [Pa] at n points."""

    displacement: Array
    gradient: Array
    mean_stress: Array


class _Splines(NamedTuple):
    """Splines over the radius: of the displacement, and of each layer's mean stress."""

    moved: CubicSpline
    stressed: list[tuple[Array, CubicSpline]]


@lru_cache(maxsize=8)
def _splines(press: Indentation) -> _Splines:
    r, heights = press.r[::2], press.z[::2]
    layers = [
        (heights[np.isfinite(grid[0])], grid[:, np.isfinite(grid[0])]) for grid in press.mean_stress
    ]
    return _Splines(
        CubicSpline(press.r, press.displacement, axis=0),
        [(z, CubicSpline(r, grid, axis=0)) for z, grid in layers],
    )


@dataclass(frozen=True, slots=True, eq=False)
class DentField:
    """Axisymmetric press on an unbounded stack, about a vertical axis through (x, y).

    Splines over the radius, quadratic elements over the height; zero beyond the largest radius.

    Attributes:
        x, y: position of the axis [m].
        indenter: indenter that presses.
        press: the axisymmetric solution.
        frame: frame of a bent stack, to which the dent is turned; None on a flat one.
    """

    x: float
    y: float
    indenter: Indenter
    press: Indentation
    frame: ContactFrame | None = None

    @property
    def depth(self) -> float:
        """Depth of the indenter in the unbounded stack [m]."""
        return self.press.depth

    @property
    def half(self) -> Array:
        """Half its extents along x and y, (2,) [m]."""
        return np.full(2, self.contact_radius)

    def inside(self, away: Array) -> Array:
        """Distance of points (..., 2) from the axis within the contact to its rim [m]."""
        return np.asarray(self.contact_radius - np.linalg.norm(away, axis=-1))

    def constraint_projections(self, away: Array) -> Array:
        """Projections (..., 3, 3) on the directions in which points are held; (3, 3) for all."""
        return _constraint_projections(self.indenter, away, np.linalg.norm(away, axis=-1))

    @property
    def contact_radius(self) -> float:
        """Undeformed radius of the contact [m]: of the point that moves to its deformed radius."""
        moved = self.press.r + self.press.displacement[:, -1, 0]
        return float(np.interp(self.press.contact_radius, moved, self.press.r))

    def evaluate(self, points: Array) -> FieldValues:
        """Values at points (n, 3), heights over the base of the stack [m]."""
        return self.rotate_values(self.level(points))

    def level(self, points: Array) -> FieldValues:
        """Values at points (n, 3) in directions of the flat stack, as the dent was solved."""
        if self.frame is not None:
            points = self.frame.stretch_points(points)
        parts = [
            self._part(points[start : start + _CHUNK_POINTS])
            for start in range(0, max(len(points), 1), _CHUNK_POINTS)
        ]
        return FieldValues(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def rotate_values(self, level: FieldValues) -> FieldValues:
        """Values of the flat stack turned to the frame."""
        if self.frame is None:
            return level
        u, G, p = level
        return FieldValues(self.frame.rotate_vectors(u), self.frame.gradient(G), p)

    def nominal(self, stress: Array) -> Array:
        """Stress [Pa] (..., 3, 3) of the dent as solved, turned to its frame."""
        return stress if self.frame is None else self.frame.nominal(stress)

    def _part(self, points: Array) -> FieldValues:
        dx, dy = points[:, 0] - self.x, points[:, 1] - self.y
        distance = np.maximum(np.hypot(dx, dy), _AXIS)
        c, s = np.where(distance > _AXIS, dx / distance, 1.0), dy / distance
        r = np.minimum(distance, self.press.r[-1])
        radial, upward, outward, rising = self._motion(r, points[:, 2])
        hoop = radial[:, 0] / distance
        G = np.empty((len(points), 3, 3))
        G[:, 0, 0] = outward[:, 0] * c * c + hoop * s * s
        G[:, 1, 1] = outward[:, 0] * s * s + hoop * c * c
        G[:, 0, 1] = G[:, 1, 0] = (outward[:, 0] - hoop) * c * s
        G[:, 0, 2], G[:, 1, 2] = rising[:, 0] * c, rising[:, 0] * s
        G[:, 2, 0], G[:, 2, 1] = outward[:, 1] * c, outward[:, 1] * s
        G[:, 2, 2] = rising[:, 1]
        u = np.stack([radial[:, 0] * c, radial[:, 0] * s, upward[:, 0]], axis=1)
        felt = distance <= self.press.r[-1]
        p = self._mean_stress(r, points[:, 2])
        return FieldValues(u * felt[:, None], G * felt[:, None, None], p * felt)

    def _motion(self, r: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """Radial (n, 1) and upward (n, 1) displacement, and both derivatives by r and by z."""
        spline = _splines(self.press).moved
        nodes, (values, slopes) = shape_functions(self.press.z[::2], z)
        rows = np.arange(len(r))[:, None]
        u, du = spline(r)[rows, nodes], spline(r, 1)[rows, nodes]
        moved = np.einsum("nac,na->nc", u, values)
        outward, rising = np.einsum("nac,na->nc", du, values), np.einsum("nac,na->nc", u, slopes)
        return moved[:, :1], moved[:, 1:], outward, rising

    def _mean_stress(self, r: Array, z: Array) -> Array:
        """Mean stress [Pa], (n,): linear over the height within each layer."""
        mean_stress = np.empty(len(r))
        layer = self.press.stack.layer_number(z)
        for k, (heights, spline) in enumerate(_splines(self.press).stressed):
            here = np.flatnonzero(layer == k)
            cell = np.clip(np.searchsorted(heights, z[here]) - 1, 0, len(heights) - 2)
            t = (z[here] - heights[cell]) / np.diff(heights)[cell]
            values = spline(r[here])
            rows = np.arange(len(here))
            mean_stress[here] = (1.0 - t) * values[rows, cell] + t * values[rows, cell + 1]
        return mean_stress


@dataclass(frozen=True, slots=True, eq=False)
class PunchedArea:
    """Area under a flat punch, which is level unless its force acts off its middle.

    Attributes:
        x, y: position where its force acts [m].
        indenter: its footprint.
        depth: depth to which it presses, or a typical one where it presses with a force [m].
        force: force on it [N]; None where it presses to the depth.
        frame: frame of a bent stack; None on a flat one.
    """

    x: float
    y: float
    indenter: Footprint
    depth: float
    force: float | None
    frame: ContactFrame | None = None

    @property
    def contact_radius(self) -> float:
        """Largest distance of its corners [m]."""
        return float(np.linalg.norm(self.indenter.outline, axis=1).max())

    @property
    def half(self) -> Array:
        """Half its extents along x and y, (2,) [m]."""
        low, high = self.bounds
        return np.asarray(0.5 * (high - low))

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Least and greatest x and y, (2,) each [m]."""
        corners = self.indenter.outline @ self.indenter.rotation.T + np.array([self.x, self.y])
        return corners.min(axis=0) + self.inset, corners.max(axis=0) - self.inset

    @property
    def inset(self) -> float:
        """Distance of the contact from the edge, which is as round as that of a cylinder [m]."""
        return _ON_ROUNDING * Cylinder().edge * Cylinder().radius

    @property
    def tilts(self) -> bool:
        """Whether its force acts off its middle."""
        middle = float(np.linalg.norm(self.indenter.middle))
        return self.force is not None and middle > _MAX_OFF_CENTRE * self.contact_radius

    def inside(self, away: Array) -> Array:
        """Distance of points (..., 2) from its place within the footprint to its edge [m]."""
        return self.indenter.depth_inside(away @ self.indenter.rotation) - self.inset

    def constraint_projections(self, away: Array) -> Array:  # noqa: ARG002
        """Directions in which all points are held, (3, 3)."""
        return np.diag([*[float(self.indenter.rough)] * 2, 1.0])

    def require_room(self, outline: PlaneOutline, margin: float) -> None:
        """Raise ConfigurationError for a punch that overhangs the stack."""
        corners = self.indenter.outline @ self.indenter.rotation.T + np.array([self.x, self.y])
        if not outline.contains(corners, -margin).all():
            raise ConfigurationError(
                f"a flat punch at ({self.x:g}, {self.y:g}) m must lie on the stack, which ends "
                f"{1e3 * margin:g} mm beyond the gel; press farther in"
            )


@dataclass(frozen=True, slots=True, eq=False)
class HeldContact:
    """Contact area of a face, whose displacement c springs hold at -d n - g.

    n is the normal of the face, and g the displacement of the area by the dents of other indenters
    and by the curvature of a bend. The indenter does not move sideways, and sinks by a further d
    under a force unchanged. It tilts where the face has levers for that. A smooth indenter holds c
    along its normal only.

    Attributes:
        face: contact area, with the unknown motions of the indenter.
        held: stiffness of the springs, (3, 3) or at each point (facets, q, 3, 3) [Pa/m].
        given: g (facets, q, 3) [m]; None where it is zero.
    """

    face: Face
    held: Array
    given: Array | None = None

    @classmethod
    def from_facets(
        cls,
        solid: Solid,
        facets: Indices,
        dent: DentField | PunchedArea,
        within: float,
        stiffness: float,
        motions: Sequence[int],
        given: Callable[[Array], Array] | None = None,
    ) -> "HeldContact":
        """Contact on a face that is level before any bend, and bent to the dent's frame.

        Args:
            solid: the body.
            facets: boundary facets of its mesh that the contact may reach.
            dent: dent of the indenter.
            within: the rim of the undeformed contact, by which the springs end before it [m].
            stiffness: stiffness of the springs [Pa/m].
            motions: numbers of the unknown d [m] and of two tilts, if any.
            given: g (n, 3) [m] at points (n, 3) of the face; zero when omitted.
        """
        turn, stretches = np.eye(3), np.ones(2)
        if dent.frame is not None:
            turn, stretches = dent.frame.rotation, dent.frame.stretches
        face = Face(solid, facets, _composite_rule(), motions, turn[:, 2])
        away = (face.points[..., :2] - np.array([dent.x, dent.y])) * stretches
        face.weights *= dent.inside(away) > within
        face.levers[..., 1:] = away[..., : len(motions) - 1]
        held = stiffness * (turn @ dent.constraint_projections(away) @ turn.T)
        points = face.points
        at_points = None if given is None else given(points.reshape(-1, 3)).reshape(points.shape)
        return cls(face, held, at_points)

    def springs(self, size: int) -> LinearSprings:
        """Springs among a number of unknowns."""
        at_rest = np.zeros(size)
        if self.given is not None:
            at_rest = self.face.forces((self.held @ self.given[..., None])[..., 0], size)
        return LinearSprings(self.face.stiffness(self.held, size), at_rest)

    def pressure(self, x: Array) -> Array:
        """Pressure of the indenter by the unknowns, force over undeformed area, (facets, q)."""
        moved = self.face.values @ self.face.displacements(x)
        moved += (self.face.levers @ x[list(self.face.motions)])[..., None] * self.face.direction
        if self.given is not None:
            moved += self.given
        return np.asarray((self.held @ moved[..., None])[..., 0] @ self.face.direction)

    def force_and_peak(self, x: Array) -> tuple[float, float]:
        """Force on the indenter [N], and largest mean pressure of a facet [Pa]."""
        weights = self.face.weights
        forces, areas = (self.pressure(x) * weights).sum(axis=1), weights.sum(axis=1)
        means = np.divide(forces, areas, out=np.zeros_like(forces), where=areas > 0.0)
        return float(forces.sum()), float(means.max(initial=0.0))

    def release(self, x: Array) -> "HeldContact":
        """Contact without the points at which the indenter pulls."""
        pressure = self.pressure(x)
        mean = float((pressure * self.face.weights).sum() / self.face.weights.sum())
        pulled = (pressure < -_PULLED * mean) & (self.face.weights > 0.0)
        if not pulled.any():
            return self
        face = copy(self.face)
        face.weights = np.where(pulled, 0.0, face.weights)
        return replace(self, face=face)


def _composite_rule() -> tuple[Array, Array]:
    """Points (2, q) and weights (q,) of Gauss rules on equal parts of the unit square."""
    gauss = 0.5 + np.array([-0.5, 0.5]) / math.sqrt(3.0)
    line = ((np.arange(_PARTS)[:, None] + gauss) / _PARTS).ravel()
    points = np.stack(np.meshgrid(line, line, indexing="ij")).reshape(2, -1)
    return points, np.full(points.shape[1], 1.0 / points.shape[1])


def _constraint_projections(indenter: Indenter, distances: Array, r: Array) -> Array:
    """Projections (facets, q, 3, 3) on the directions in which points are held; (3, 3) for all."""
    if indenter.rough:
        return np.eye(3)
    slope = indenter.profile(r)[1]
    sideways = -(slope / np.maximum(r, 1e-12))[..., None] * distances
    normal = np.concatenate([sideways, np.ones_like(r)[..., None]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    projections: Array = normal[..., :, None] * normal[..., None, :]
    return projections
