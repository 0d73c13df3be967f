"""Equilibrium of a case in 3D: mesh, supports, contacts and load stepping."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.reference.case import Case
from eitskin.benchmarks.reference.contact_profile import ContactProfile, contact_profile
from eitskin.benchmarks.reference.prisms import Patch, Sizes, extruded, triangulated
from eitskin.benchmarks.reference.solid import Held, MixedSolid
from eitskin.extras import require
from eitskin.simulator.mechanics.load_stepping import SolidError

Array = NDArray[np.float64]

_SAME, _INWARDS = 1e-6, 1e-6  # [mm]; shift of evaluated points into the gel [mm]
_SMALLEST_STEP = 0.02  # of the load
_SPAN, _AXIS = 40.0, 8.0  # of the plates: span, and depth of the axis under mid-layer [mm]
_FAR_OF_BENDS = 5.0  # [mm]
_KNOTS = 0.05  # of the contact profile [mm]


@dataclass(frozen=True, slots=True)
class Numerics:
    """Discretisation of the reference.

    Attributes:
        order: of the displacements.
        sizes: of the triangles in the plane.
        layers: prisms over the height of substrate, encapsulation, gel and encapsulation.
        path_order: of the displacements while the load rises, an initial guess for `order`.
    """

    order: int = 4
    sizes: Sizes = field(default_factory=Sizes)
    layers: tuple[int, int, int, int] = (2, 1, 1, 1)
    path_order: int = 3


class ReferenceStack:
    """Meshed sensor of one case; `solve` gives its equilibrium.

    Attributes:
        case: what is solved.
        solid: of the part that symmetry leaves.
        depths: of the indenters' lowest points under the undeformed or bent top [mm].
        iterations: of Newton's method, in total.
    """

    solid: MixedSolid

    def __init__(self, case: Case, numerics: Numerics | None = None) -> None:
        """Mesh the case."""
        # Without touches a bend varies most at the edges of the plates, on no finer triangles.
        bend = Numerics(sizes=Sizes(far=_FAR_OF_BENDS))
        self.case, self._numerics = case, numerics or (Numerics() if case.touches else bend)
        design, mechanics = case.design(), case.mechanics()
        self._gel = 1e3 * np.array([design.outline.length, design.outline.width, design.thickness])
        self._around = 0.5e3 * (design.encapsulated_thickness - design.thickness)
        self._margin = 1e3 * mechanics.margin
        self._moduli = {
            "gel": 1e-3 * mechanics.gel.shear_modulus,
            "encapsulation": 1e-3 * mechanics.encapsulation.shear_modulus,
            "substrate": case.substrate[1],
        }
        self._mirrored = tuple(self._symmetric(axis) for axis in (0, 1))
        self._kept = [t for t in case.touches if self._is_kept(t)]
        self.depths: Array = np.zeros(len(case.touches))
        self.iterations = 0
        self._report: Callable[[str], object] = lambda _: None
        self._mesh([Patch(t, (self.profile.radius,) * 2) for t in self._kept])

    @cached_property
    def profile(self) -> ContactProfile:
        """Contact of the axisymmetric press."""
        stack = self.case.mechanics().stack(self.case.design())
        return contact_profile(stack, self.case.indenter, self.case.force)

    def solve(self, report: Callable[[str], object] = lambda _: None) -> None:
        """Equilibrium of the case: bend, then press; raises SolidError where there is none."""
        self._report = report
        self._bend()
        pressed = self._pressed()
        if not self._starts_at_dents or not self._guessed(pressed):
            self._ramp(pressed)
        try:
            self._raise(pressed(1.0))
        except SolidError:
            # A sharp rim of the contact may be too far off at the lower order.
            self._report(f"order {self._numerics.order} is reached by steps of the load")
            self.solid = self._solid(self._numerics.order)
            if self.case.angle:
                self._ramp(self._bent)
            self._ramp(self._pressed())
        places = [self._local(touch) for touch in self.case.touches]
        own = [np.argmin([math.dist(place, kept) for kept in self._kept]) for place in places]
        self.depths = self.solid.steps[np.array(own, dtype=np.int64)]

    def bend(self, report: Callable[[str], object] = lambda _: None) -> None:
        """Equilibrium of the bend alone, on the mesh on which `solve` presses."""
        self._report = report
        self._bend()
        self._raise(self._bent(1.0))

    def _bend(self) -> None:
        """Bend at the lower order; a contact has its radius on the bent top."""
        if self.case.angle:
            self._ramp(self._bent)
            if self._patches:
                self._mesh([self._stretched(patch) for patch in self._patches])
                self._ramp(self._bent)

    def _raise(self, held: list[Held]) -> None:
        """Equilibrium at the full order, from that of the lower one; raises SolidError."""
        if self._numerics.order <= self._numerics.path_order:
            return
        lower = self.solid
        self.solid = self._solid(self._numerics.order)
        turned = ["plate"] if self.case.angle else []
        self.solid.start(lower.displacement, lower.mean_stress, turned)
        self.solid.steps = lower.steps
        self._settled(held, f"order {self._numerics.order}")

    def displacement_and_gradient(self, points: Array) -> tuple[Array, Array]:
        """Displacement [m] (..., 3) and gradient (..., 3, 3) at points (..., 3) of the gel [m]."""
        ng = require("ngsolve", "reference")
        x = np.clip(1e3 * points.reshape(-1, 3), _INWARDS, self._gel - _INWARDS)
        signs = np.ones_like(x)
        for axis, mirrored in enumerate(self._mirrored):
            if mirrored:
                beyond = x[:, axis] > 0.5 * self._gel[axis]
                x[beyond, axis] = self._gel[axis] - x[beyond, axis]
                x[:, axis] = np.minimum(x[:, axis], 0.5 * self._gel[axis] - _INWARDS)
                signs[beyond, axis] = -1.0
        u = self.solid.displacement
        at = self.solid.mesh(*x.T)
        moved = signs * 1e-3 * u(at)
        slope = signs[:, :, None] * ng.Grad(u)(at).reshape(-1, 3, 3) * signs[:, None, :]
        return moved.reshape(points.shape), slope.reshape(*points.shape, 3)

    def _symmetric(self, axis: int) -> bool:
        """Whether the touches mirror each other about the middle along an axis."""
        here = np.array(self.case.touches).reshape(-1, 2)
        there = here.copy()
        there[:, axis] = self._gel[axis] - here[:, axis]
        first, second = ({tuple(t) for t in np.round(each, 6).tolist()} for each in (here, there))
        return first == second

    def _is_kept(self, touch: tuple[float, float]) -> bool:
        middle = 0.5 * self._gel
        return all(
            touch[axis] < middle[axis] + _SAME or not self._mirrored[axis] for axis in (0, 1)
        )

    def _local(self, touch: tuple[float, float]) -> tuple[float, float]:
        """Touch, or the mirror image of the touch in the solved part."""
        x, y = (
            min(t, float(length) - t) if mirrored else t
            for t, length, mirrored in zip(touch, self._gel, self._mirrored, strict=False)
        )
        return x, y

    def _share(self, touch: tuple[float, float]) -> float:
        """Fraction of the indenter in the solved part."""
        on = [
            mirrored and abs(t - 0.5 * length) < _SAME
            for t, length, mirrored in zip(touch, self._gel, self._mirrored, strict=False)
        ]
        return math.prod(0.5 for each in on if each)

    def _mesh(self, patches: Sequence[Patch]) -> None:
        self._patches = list(patches)
        case, gel, margin, around = self.case, self._gel, self._margin, self._around
        x1, y1 = (
            0.5 * gel[axis] if mirrored else gel[axis] + margin
            for axis, mirrored in enumerate(self._mirrored)
        )
        box = (-margin, float(x1), -margin, float(y1))
        breaks = [(0, 0.0), (0, gel[0]), (1, 0.0), (1, gel[1])]
        if case.support == "plates":
            breaks += [(0, 0.5 * (gel[0] - _SPAN)), (0, 0.5 * (gel[0] + _SPAN))]
        lines = [_across(box, axis, float(at)) for axis, at in breaks]
        inside = [line for line in lines if line is not None]
        points, triangles = triangulated(box, inside, patches, self._numerics.sizes)
        levels = [-around, 0.0, gel[2], gel[2] + around]
        layers = list(self._numerics.layers[1:])
        if case.support == "substrate":
            levels = [-around - case.substrate[0], *levels]
            layers = [self._numerics.layers[0], *layers]
        heights = [levels[0]]
        for low, high, count in zip(levels[:-1], levels[1:], layers, strict=True):
            heights += list(np.linspace(low, high, count + 1)[1:])
        self._top, self._bottom = levels[-1], levels[0]
        self._end = np.array([x1, y1])
        mesh = extruded(points, triangles, heights, self._material, self._boundary)
        fixed = {"symmetry 0": "x", "symmetry 1": "y", "base": "xyz", "plate": "xyz"}
        if case.support == "free":
            fixed["side"] = "xyz"
        present = set(mesh.GetBoundaries())
        self._fixed = {name: axes for name, axes in fixed.items() if name in present}
        self._prisms = mesh
        self.solid = self._solid(self._numerics.path_order)

    def _solid(self, order: int) -> MixedSolid:
        """Solid of displacements of an order on the mesh, at rest."""
        moduli = {name: self._moduli[name] for name in set(self._prisms.GetMaterials())}
        ratio = self.case.mechanics().bulk_ratio
        return MixedSolid(self._prisms, moduli, order, self._fixed, ratio)

    def _material(self, centre: Array) -> str:
        if centre[2] < -self._around:
            return "substrate"
        in_gel = np.all((centre > 0.0) & (centre < self._gel))
        return "gel" if in_gel else "encapsulation"

    def _boundary(self, centre: Array) -> str:
        if centre[2] > self._top - _SAME:
            inside = [k for k, p in enumerate(self._patches) if p.contains(centre[:2])]
            return f"contact {inside[0]}" if inside else "top"
        if centre[2] < self._bottom + _SAME:
            return self._under(float(centre[0]))
        for axis, mirrored in enumerate(self._mirrored):
            if mirrored and centre[axis] > self._end[axis] - _SAME:
                return f"symmetry {axis}"
        return "side"

    def _under(self, x: float) -> str:
        """Name of the lower face at x."""
        if self.case.support == "free":
            return "under"
        if self.case.support == "plates":
            return "plate" if abs(x - 0.5 * self._gel[0]) > 0.5 * _SPAN else "under"
        return "base"

    def _bent(self, t: float) -> list[Held]:
        """Plates turned by a fraction t of the angle."""
        if not self.case.angle:
            return []
        ng = require("ngsolve", "reference")
        X = ng.CF((ng.x, ng.y, ng.z))
        axis = ng.CF((0.5 * self._gel[0], 0.0, 0.5 * self._gel[2] - _AXIS))
        half = math.radians(0.5 * t * self.case.angle)
        cos, sin = math.cos(half), math.sin(half)
        right, left = (
            ng.CF((cos, 0, sign * sin, 0, 1, 0, -sign * sin, 0, cos), dims=(3, 3)) * (X - axis)
            + axis
            - X
            for sign in (1.0, -1.0)
        )
        return [Held("plate", ng.IfPos(ng.x - 0.5 * self._gel[0], right, left))]

    def _pressed(self) -> Callable[[float], list[Held]]:
        """Contacts under a fraction t of the forces, on plates turned by the whole angle."""
        ng = require("ngsolve", "reference")
        before = ng.GridFunction(self.solid.displacement.space)
        before.vec.data = self.solid.displacement.vec
        frames = [self._frame(patch) for patch in self._patches]
        shapes = [
            self._shape(patch, *frame) for patch, frame in zip(self._patches, frames, strict=True)
        ]
        forces = [1e3 * self.case.force * self._share(touch) for touch in self._kept]

        def held(t: float) -> list[Held]:
            contacts = [
                Held(f"contact {k}", (1 - t) * before + t * shape, t * force, tuple(-frame[1][2]))
                for k, (shape, force, frame) in enumerate(zip(shapes, forces, frames, strict=True))
            ]
            return contacts + self._bent(1.0)

        return held

    def _frame(self, patch: Patch) -> tuple[Array, Array, Array]:
        """Position (3,) [mm], axes in rows (3, 3) and stretches (2,) of the top at a touch."""
        place = np.array([*patch.centre, self._top])
        inside = place - _INWARDS * np.array([*(1.0 * np.array(self._mirrored)), 1.0])
        ng, u = require("ngsolve", "reference"), self.solid.displacement
        at = self.solid.mesh(*inside)
        F = np.eye(3) + np.array(ng.Grad(u)(at)).reshape(3, 3)
        stretches = np.linalg.norm(F[:, :2], axis=0)
        normal = np.cross(F[:, 0], F[:, 1])
        normal /= np.linalg.norm(normal)
        along = F[:, 0] / stretches[0]
        return (
            place + np.array(u(at)),
            np.array([along, np.cross(normal, along), normal]),
            stretches,
        )

    def _stretched(self, patch: Patch) -> Patch:
        """Patch whose deformed top has the radius of the contact."""
        _, _, stretches = self._frame(patch)
        radii = self.profile.radius / stretches
        return Patch(patch.centre, (float(radii[0]), float(radii[1])))

    def _shape(self, patch: Patch, place: Array, axes: Array, stretches: Array) -> Any:
        """Displacement of a patch when the indenter's lowest point is on the top at rest."""
        ng, profile = require("ngsolve", "reference"), self.profile
        along = stretches[0] * (ng.x - patch.centre[0])
        across = stretches[1] * (ng.y - patch.centre[1])
        r = ng.sqrt(along**2 + across**2 + 1e-12)
        knots = np.arange(0.0, 1.1 * profile.radius, _KNOTS)
        outwards, upwards = (
            ng.BSpline(2, [0.0, *knots], np.interp(knots, profile.radii, values).tolist())(r)
            for values in profile.displacement.T
        )
        tangent, binormal, normal = (ng.CF(tuple(axis)) for axis in axes)
        ratio = 1.0 + outwards / r
        deformed = ratio * (along * tangent + across * binormal) + upwards * normal
        return ng.CF(tuple(place)) + deformed - ng.CF((ng.x, ng.y, ng.z))

    @property
    def _starts_at_dents(self) -> bool:
        """Whether superposed axisymmetric presses may be near the equilibrium."""
        return self.case.support == "rigid" and not self.case.angle

    def _guessed(self, stage: Callable[[float], list[Held]]) -> bool:
        """Whether Newton's method finds the whole load from superposed axisymmetric presses."""
        ng, profile = require("ngsolve", "reference"), self.profile
        height, total = ng.z - self._bottom, ng.CF((0, 0, 0))
        for x, y in self.case.touches:
            r = ng.sqrt((ng.x - x) ** 2 + (ng.y - y) ** 2 + 1e-12)
            outwards, upwards = (
                ng.VoxelCoefficient(
                    (0, 0), profile.extent, part.T.copy(), linear=True, trafocf=ng.CF((r, height))
                )
                for part in np.moveaxis(profile.field, -1, 0)
            )
            direction = ng.CF(((ng.x - x) / r, (ng.y - y) / r, 0))
            total += outwards * direction + upwards * ng.CF((0, 0, 1))
        self.solid.start(total)
        self.solid.steps = np.full(len(self._kept), profile.depth)
        try:
            self._settled(stage(1.0), "from superposed axisymmetric presses")
        except SolidError:
            self._report("the superposed axisymmetric presses are no initial guess")
            self.solid.start(ng.CF((0, 0, 0)))
            return False
        return True

    def _settled(self, held: list[Held], what: str) -> int:
        """Number of iterations to the equilibrium with held patches."""
        iterations = self.solid.settle(held)
        self.iterations += iterations
        steps = self.solid.steps[: len(self._kept)].round(4)
        self._report(f"{what}: {iterations} iterations, translation {steps} mm")
        return iterations

    def _ramp(self, stage: Callable[[float], list[Held]]) -> None:
        """Load stepping of one stage from t = 0 to 1."""
        if not stage(1.0):
            return
        self.solid.steps = np.zeros(len(stage(1.0)))
        reached, step = 0.0, 0.5
        while reached < 1.0:
            t = min(1.0, reached + step)
            try:
                iterations = self._settled(stage(t), f"t = {t:.3f}")
            except SolidError:
                step = 0.5 * (t - reached)
                self._report(f"t = {t:.3f} not reached from {reached:.3f}")
                if step < _SMALLEST_STEP:
                    raise SolidError(
                        f"{self.case.name}: {reached:.0%} of the load is carried", reached
                    ) from None
                continue
            reached, step = t, (1.5 if iterations < 7 else 1.0) * step


def _across(
    box: tuple[float, float, float, float], axis: int, at: float
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Line across the box at x (axis 0) or y; None where the line is not inside."""
    if not box[2 * axis] + _SAME < at < box[2 * axis + 1] - _SAME:
        return None
    low, high = box[2 - 2 * axis], box[3 - 2 * axis]
    return ((at, low), (at, high)) if axis == 0 else ((low, at), (high, at))
