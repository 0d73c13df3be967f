"""Solids of NGSolve and rigid indenters that touch them: meshes, contacts, equilibria.

Units: mm, kPa, mN.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Naming = Callable[[Array], str]
"""Name of the material or boundary at a position (3,) [mm]."""

_SAME = 1e-6  # [mm]
_MAX_ITERATIONS = 60
_FIRST_TOUCHED = 0.05  # height of an indenter's surface below which it touches at first [mm]
_ROUGHLY, _TOLERANCE = 0.1, 1e-4  # largest change of a displacement over the largest displacement
_AT_REST = 1e-3  # part of the touched points that may come and go
_RULE_ORDER = 8  # of the integration over contacts
_STRESS = 1e2  # unit of the unknowns of the mean stress [kPa]


@dataclass(frozen=True, slots=True)
class Numerics:
    """Discretisation: order of the displacements, and edge lengths of the triangles [mm].

    Attributes:
        order, path: order of the displacements, and while bend and load rise.
        rim, inside, far: edges along the rims of the contacts, within these, and elsewhere.
        steps: number of steps of the load.
    """

    order: int = 4
    path: int = 3
    rim: float = 1.0
    inside: float = 3.0
    far: float = 18.0
    steps: int = 5


def triangulate_box(
    box: tuple[float, float, float, float],
    lines: Sequence[tuple[tuple[float, float], tuple[float, float]]],
    centres: Sequence[Array],
    radius: float,
    sizes: Numerics,
) -> tuple[Array, Indices]:
    """Points (n, 2) and anticlockwise triangles (m, 3) of a box (x, x, y, y) [mm].

    No triangle crosses the lines, or the circles, which are polygons of their area, about centres
    in the box or in the middle of its upper sides.
    """
    occ = require("netgen.occ", "reference")

    def face(corners: Array) -> Any:
        pen = occ.WorkPlane().MoveTo(*corners[0])
        for corner in corners[1:]:
            pen = pen.LineTo(*corner)
        return pen.Close().Face()

    x0, x1, y0, y1 = box
    count = 4 * max(3, round(0.5 * np.pi * radius / sizes.rim))
    angle = 2.0 * np.pi * np.arange(count) / count
    growth = np.sqrt(2.0 * np.pi / (count * np.sin(2.0 * np.pi / count)))
    circle = growth * radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    parts = [face(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]))]
    for centre in centres:
        inside = np.all((corners := centre + circle) < np.array([x1, y1]) + _SAME, axis=1)
        quarter = np.sum(inside) <= count // 4 + 1
        parts += [face(np.vstack([corners[inside], *([centre] if quarter else [])]))]
    parts += [occ.Segment(occ.Pnt(*a, 0.0), occ.Pnt(*b, 0.0)) for a, b in lines]
    plan = occ.Glue(parts)
    for each in plan.faces:
        corners = np.array([[v.p.x, v.p.y] for v in each.vertices])
        inside = any(np.all(is_within(corners, centre, radius)) for centre in centres)
        each.maxh = sizes.inside if inside else sizes.far
    mesh = occ.OCCGeometry(plan, dim=2).GenerateMesh(maxh=sizes.far, grading=0.45)
    points = np.array([point.p[:2] for point in mesh.Points()])
    triangles = np.array([[v.nr - 1 for v in cell.vertices] for cell in mesh.Elements2D()])
    a, b = (points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2))
    turned = a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]
    triangles[turned] = triangles[turned][:, ::-1]
    return points, triangles


def is_within(points: Array, centre: Array, radius: float) -> NDArray[np.bool_]:
    """Whether points (..., 2) lie in a circle, the corners of its polygon included."""
    return np.asarray(np.sum((points - centre) ** 2, axis=-1) < 1.05 * radius**2)


def extrude(
    points: Array, triangles: Indices, heights: Sequence[float], material: Naming, boundary: Naming
) -> Any:
    """Mesh of prisms, an `ngsolve.Mesh`, between heights of a plan (n, 2) [mm], (m, 3).

    `material` names the centroid of a prism, `boundary` that of a facet of the boundary.
    """
    netgen = require("netgen.meshing", "reference")
    mesh, count = netgen.Mesh(dim=3), len(points)
    numbers = [
        mesh.Add(netgen.MeshPoint(netgen.Pnt(*p, z))) for z in heights for p in points.tolist()
    ]
    names: list[str] = []
    faces: list[str] = []

    def add(corners: Sequence[int], centre: Array) -> None:
        if (name := boundary(centre)) not in faces:
            faces.append(name)
            mesh.Add(netgen.FaceDescriptor(surfnr=len(faces), domin=1, bc=len(faces)))
            mesh.SetBCName(len(faces) - 1, name)
        mesh.Add(netgen.Element2D(faces.index(name) + 1, [numbers[v] for v in corners]))

    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    _, first, times = np.unique(np.sort(edges), axis=0, return_index=True, return_counts=True)
    middles, top = points[triangles].mean(axis=1), count * (len(heights) - 1)
    for k, (low, high) in enumerate(pairwise(heights)):
        for cell, middle in zip(count * k + triangles, middles, strict=True):
            if (name := material(np.append(middle, 0.5 * (low + high)))) not in names:
                names.append(name)
                mesh.SetMaterial(len(names), name)
            corners = [numbers[v] for v in (*cell, *(cell + count))]
            mesh.Add(netgen.Element3D(names.index(name) + 1, corners))
        for a, b in count * k + edges[first[times == 1]]:
            middle = np.append(points[[a % count, b % count]].mean(axis=0), 0.5 * (low + high))
            add([a, b, b + count, a + count], middle)
    for cell, middle in zip(triangles, middles, strict=True):
        add(cell[::-1], np.append(middle, heights[0]))
        add(cell + top, np.append(middle, heights[-1]))
    return require("ngsolve", "reference").Mesh(mesh)


class RoughContact:
    """Unilateral contact of a rigid indenter that sticks to every point it touches.

    Springs at integration points of a boundary, where the indenter is: a point is touched as soon
    as it would lie in the indenter, sticks where it was touched, and is released under tension.

    Attributes:
        step: depth of the indenter's lowest point, an `ngsolve.Parameter` [mm].
        force: force on the indenter, against its motion [mN].
        over: measure of the boundary.
    """

    def __init__(
        self,
        mesh: Any,
        boundary: str,
        indenter: Indenter,
        stiffness: float,
        place: Array,
        axes: Array | None = None,
        moved: Any = None,
    ) -> None:
        """Touch where the indenter is almost on the surface.

        Args:
            mesh: mesh of the solid.
            boundary: name of the part of its boundary that may touch.
            indenter: its shape; it sticks, rough or not.
            stiffness: of the springs [kPa/mm].
            place: lowest point of the indenter before it presses (3,) [mm].
            axes: two tangents and the normal in rows (3, 3), against which it moves; x, y, z.
            moved: displacement of the solid before, a coefficient function [mm].
        """
        ng = self._ng = require("ngsolve", "reference")
        comp = require("ngsolve.comp", "reference")
        self._indenter, self._stiffness, self._place = indenter, stiffness, place
        self._axes = np.eye(3) if axes is None else axes
        self._normal = ng.CF(tuple(self._axes[2].tolist()))
        self._mesh, self._zone = mesh, mesh.Boundaries(boundary)
        space = comp.IntegrationRuleSpaceSurface(mesh, order=_RULE_ORDER, definedon=self._zone)
        self.step, self.force = ng.Parameter(0.0), 0.0
        self._touched, self._field = ng.GridFunction(space), ng.GridFunction(space)
        self._shape = [ng.GridFunction(space) for _ in range(3)]
        self.over = ng.ds(definedon=self._zone, intrules=space.GetIntegrationRules())
        self._own = self._values((ng.x, ng.y, ng.z))
        self._before = self._positions(moved or ng.CF((0.0, 0.0, 0.0)))
        height = self._height(self._before)[0]
        self._gap = np.maximum(height - self._before[:, 2], 0.0)
        self._is_touched = self._gap < _FIRST_TOUCHED
        self._targets = np.column_stack([self._before[:, :2], height])
        self._store()

    def energy(self, u: Any) -> Any:
        """Energy of the springs over the area for displacements u, a coefficient function."""
        away = u - self._ng.CF(tuple(self._shape)) + self.step * self._normal
        return 0.5 * self._stiffness * self._touched * self._ng.InnerProduct(away, away)

    def pull(self, v: Any) -> Any:
        """Work of the springs' forces, as the indenter sinks, on virtual displacements v."""
        return -self._stiffness * self._touched * self._ng.InnerProduct(v, self._normal)

    def reaction(self, u: Any) -> tuple[float, float]:
        """Force on the indenter [mN] and its change with the depth at fixed u [mN/mm]."""
        away = self._ng.InnerProduct(u - self._ng.CF(tuple(self._shape)), self._normal) + self.step
        force, change = (
            self._ng.Integrate(each * self._touched * self.over, self._mesh) for each in (away, 1.0)
        )
        return self._stiffness * force, self._stiffness * change

    def update(self, u: Any) -> float:
        """Touch and release points, given displacements u; the part of points that changed."""
        here, before, depth = self._positions(u), self._is_touched, self.step.Get()
        height, outwards = self._height(here)
        gap = height - depth - here[:, 2]
        push = self._targets - np.array([0.0, 0.0, depth]) - here
        is_pushed = np.sum(push * outwards, axis=1) > 0.0
        met = ~before & (gap < 0.0)
        # Where the point met the indenter on its way from the last equilibrium.
        part = np.divide(self._gap, self._gap - gap, out=np.ones_like(gap), where=met)[:, None]
        at = self._before + part * (here - self._before)
        now = (before & is_pushed) | met
        if (changed := float(np.sum(now != before) / max(np.sum(before), 1))) > _AT_REST:
            self._targets[met] = np.column_stack([at[:, :2], self._height(at)[0]])[met]
            self._is_touched = now
            self._store()
        return changed

    def advance(self, u: Any) -> None:
        """End a step of the load: points that are not touched have moved to where they are."""
        self._before = self._positions(u)
        height = self._height(self._before)[0]
        self._gap = np.maximum(height - self.step.Get() - self._before[:, 2], 0.0)

    def _values(self, fields: Sequence[Any]) -> Array:
        """Values of fields (k,) at all points (n, k)."""
        columns = []
        for field in fields:
            self._field.Interpolate(field, definedon=self._zone)
            columns.append(self._field.vec.FV().NumPy().copy())
        return np.stack(columns, axis=1)

    def _positions(self, u: Any) -> Array:
        """Positions of the displaced points (n, 3), from `place` along the axes [mm]."""
        moved = self._values([u[k] for k in range(3)])
        return np.asarray((self._own + moved - self._place) @ self._axes.T)

    def _height(self, positions: Array) -> tuple[Array, Array]:
        """Height of the surface over its lowest point (n,) [mm], and normals out of it (n, 3)."""
        r = np.linalg.norm(positions[:, :2], axis=1)
        height, slope, _ = self._indenter.profile(1e-3 * r)
        along = positions[:, :2] * (slope / np.maximum(r, 1e-9))[:, None]
        return 1e3 * height, np.column_stack([along, np.full_like(r, -1.0)])

    def _store(self) -> None:
        self._touched.vec.FV().NumPy()[:] = self._is_touched
        shape = self._place + self._targets @ self._axes - self._own
        for field, values in zip(self._shape, shape.T, strict=True):
            field.vec.FV().NumPy()[:] = np.where(self._is_touched, values, 0.0)


class MixedSolid:
    """Finite-strain equilibrium of a mesh of several neo-Hookean materials, by NGSolve.

    Stationary points of int mu/2 (J^(-2/3) tr F^T F - 3) + q (J - 1) - q^2 / (2 kappa) dV, with
    displacements of order p and discontinuous mean stresses q of order p - 2, eliminated by cells,
    and of the springs of contacts.

    Attributes:
        mesh: an `ngsolve.Mesh` [mm].
        state: displacement and scaled mean stress at the last equilibrium.
        contacts: indenters that press the mesh.
        unknowns: number of displacements and mean stresses.
    """

    def __init__(
        self,
        mesh: Any,
        moduli: Mapping[str, float],
        order: int,
        fixed: Mapping[str, str],
        contacts: Sequence[RoughContact] = (),
        bulk_ratio: float = 1e4,
    ) -> None:
        """Set up spaces and energy.

        `moduli` are shear moduli of the materials [kPa]; `fixed` names the axes at rest on each
        boundary, as "xyz"; `bulk_ratio` is kappa / mu of all materials.
        """
        ng = self._ng = require("ngsolve", "reference")
        ng.SetNumThreads(1)
        ng.ngsglobals.msg_level = 0
        self.mesh, self.contacts = mesh, contacts
        at_rest = {a: "|".join(name for name, axes in fixed.items() if a in axes) for a in "xyz"}
        rests = {f"dirichlet{axis}": names for axis, names in at_rest.items()}
        self._space = ng.VectorH1(mesh, order=order, **rests) * ng.L2(mesh, order=order - 2)
        (u, q), (v, _) = self._space.TnT()
        mu, F = mesh.MaterialCF(dict(moduli)), ng.Id(3) + ng.Grad(u)
        J, stress = ng.Det(F), _STRESS * q
        energy = 0.5 * mu * (J ** (-2.0 / 3.0) * ng.InnerProduct(F, F) - 3.0)
        energy += stress * (J - 1.0) - stress**2 / (2.0 * bulk_ratio * mu)
        self._form = ng.BilinearForm(self._space, symmetric=True, condense=True)
        self._form += ng.Variation(energy.Compile() * ng.dx)
        self._pulls = [ng.LinearForm(self._space) for _ in contacts]
        for form, contact in zip(self._pulls, contacts, strict=True):
            self._form += ng.Variation(contact.energy(u) * contact.over)
            form.Add(contact.pull(v) * contact.over)
        self.state, self.unknowns = ng.GridFunction(self._space), int(self._space.ndof)

    @property
    def displacement(self) -> Any:
        """Displacement, a coefficient function [mm]."""
        return self.state.components[0]

    def start(self, displacement: Any, mean_stress: Any, moved: Mapping[str, Any]) -> None:
        """Take coefficient functions as the initial guess.

        `moved` are the displacements of boundaries that are not at rest; prescribed there.
        """
        for mine, given in zip(self.state.components, (displacement, mean_stress), strict=True):
            mine.Set(given)
        held, values = ~np.array(list(self._space.FreeDofs())), self.state.vec.FV().NumPy()
        values[held] = 0.0
        for boundary, displaced in moved.items():
            field, zone = self._ng.GridFunction(self._space), self.mesh.Boundaries(boundary)
            field.components[0].Set(displaced, definedon=zone)
            on = np.array(list(self._space.GetDofs(zone))) & held
            values[on] = field.vec.FV().NumPy()[on]

    def press(self) -> int:
        """Equilibrium under the contacts' forces by Newton's method, from `state`.

        Returns the number of iterations; contacts touch and release points on the way. Raises
        SolidError where there is no equilibrium, or where contacts do not come to rest.
        """
        # NGSolve raises an error of its own where the guess is too far from an equilibrium.
        singular = require("netgen.libngpy._meshing", "reference").NgException
        displacements, state = int(self._space.components[0].ndof), self.state.vec
        try:
            for iteration in range(_MAX_ITERATIONS):
                increment = self._increment()
                state.data += increment
                vectors = (each.FV().NumPy()[:displacements] for each in (increment, state))
                change, size = (float(np.abs(vector).max()) for vector in vectors)
                if not math.isfinite(change) or change > 1e3:
                    break
                if change > _ROUGHLY * size:
                    continue
                came = [contact.update(self.displacement) for contact in self.contacts]
                if change < _TOLERANCE * max(size, 1e-3) and max(came, default=0.0) <= _AT_REST:
                    for contact in self.contacts:
                        contact.advance(self.displacement)
                    return iteration + 1
        except singular as error:
            raise SolidError(str(error), 0.0) from error
        raise SolidError("Newton's method found no equilibrium of the reference", 0.0)

    def _increment(self) -> Any:
        """Newton increment of the state; the depths of the contacts are moved by theirs."""
        form, product, state = self._form, self._ng.InnerProduct, self.state.vec
        form.AssembleLinearization(state)
        inverse = form.mat.Inverse(self._space.FreeDofs(True), inverse="sparsecholesky")
        residual = state.CreateVector()
        form.Apply(state, residual)
        condensed = (residual + form.harmonic_extension_trans * residual).Evaluate()
        total = (-1.0 * (inverse * condensed)).Evaluate()
        for pull in self._pulls:
            pull.Assemble()
        moved = [(inverse * pull.vec).Evaluate() for pull in self._pulls]
        reactions = [contact.reaction(self.displacement) for contact in self.contacts]
        stiffness = np.diag([stiff for _, stiff in reactions])
        stiffness -= [[product(pull.vec, each) for each in moved] for pull in self._pulls]
        missing = [
            contact.force - force + product(pull.vec, total)
            for contact, (force, _), pull in zip(self.contacts, reactions, self._pulls, strict=True)
        ]
        steps = np.linalg.solve(stiffness, np.array(missing)).tolist()
        for contact, step, each in zip(self.contacts, steps, moved, strict=True):
            contact.step.Set(contact.step.Get() + step)
            total.data += step * each
        inner = form.harmonic_extension * total - form.inner_solve * residual
        total.data += inner.Evaluate()
        return total
