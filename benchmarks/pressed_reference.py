"""Independent 3D reference solutions of presses, by finite elements of NGSolve.

Run by `python -m eitskin.benchmarks.pressed_reference --out FILE`; needs the extra `reference`.
docs/results/simulator.md compares with them. FILE has the form of
`published/world_reference.json` and is rewritten after each case. Units: mm, kPa, mN.
"""

import argparse
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.world import PUBLISHED_FILE, Gauge, ReferenceCase, cases
from eitskin.extras import require, require_all
from eitskin.files import atomic_file
from eitskin.geometry import Free, Plates, Substrate
from eitskin.geometry.deformation.kinematics import Displaced
from eitskin.provenance import Provenance
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Stack
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Naming = Callable[[Array], str]
"""Name of the material or boundary at a position (3,) [mm]."""

_COMMAND = "python -m eitskin.benchmarks.pressed_reference --out FILE"
_SAME, _INWARDS = 1e-6, 1e-6  # [mm]; shift of evaluated points into the gel [mm]
_LAYERS = (2, 1, 1, 1)  # prisms over substrate, encapsulation, gel and encapsulation
_MIN_LOAD_STEP, _MAX_ITERATIONS = 0.02, 20
_CELL, _STEPS = 1.0 / 60.0, 24  # finest of the axisymmetric press, over the radius; its steps
_KNOTS = 0.05  # of the contact profile [mm]
_TOLERANCE = 1e-5  # of the largest change of a displacement over the largest displacement
_STRESS = 1e2  # unit of the unknowns of the mean stress [kPa]


@dataclass(frozen=True, slots=True)
class Numerics:
    """Discretisation: order of the displacements, and edge lengths of the triangles [mm].

    Attributes:
        order: order of the displacements; the load rises at one less, down to 2.
        rim, inside, far: edges along the rims of the contacts, within these, and elsewhere.
    """

    order: int = 4
    rim: float = 1.0
    inside: float = 2.5
    far: float = 12.0


def triangulate_box(
    box: tuple[float, float, float, float],
    lines: Sequence[tuple[tuple[float, float], tuple[float, float]]],
    centres: Sequence[tuple[float, float]],
    radius: float,
    sizes: Numerics,
) -> tuple[Array, Indices]:
    """Points (n, 2) and anticlockwise triangles (m, 3) of a box (x, x, y, y) [mm].

    No triangle crosses the lines, or the circles, which are polygons of their area.
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
    parts += [face(centre + circle) for centre in centres]
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


def is_within(points: Array, centre: tuple[float, float], radius: float) -> NDArray[np.bool_]:
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


@dataclass(frozen=True, slots=True)
class HeldContact:
    """Patch of the boundary whose shape is prescribed, free to translate along one direction.

    Attributes:
        boundary: name of the boundary.
        shape: displacement of the patch, a coefficient function of 3 components [mm].
        force: force on the patch along `direction` [mN].
        direction: unit vector of the translation.
    """

    boundary: str
    shape: Any
    force: float
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)


class MixedSolid:
    """Finite-strain equilibrium of a mesh of several neo-Hookean materials, by NGSolve.

    Stationary points of int mu/2 (J^(-2/3) tr F^T F - 3) + q (J - 1) - q^2 / (2 kappa) dV, with
    displacements of order p and discontinuous mean stresses q of order p - 2, eliminated by cells.

    Attributes:
        mesh: an `ngsolve.Mesh` [mm].
        state: displacement and scaled mean stress at the last equilibrium.
        steps: translation of the held patches along their directions [mm].
        unknowns: number of displacements and mean stresses.
    """

    def __init__(
        self,
        mesh: Any,
        moduli: Mapping[str, float],
        order: int,
        fixed: Mapping[str, str],
        bulk_ratio: float = 1e4,
    ) -> None:
        """Set up spaces and energy.

        `moduli` are shear moduli of the materials [kPa]; `fixed` names the axes at rest on each
        boundary, as "xyz"; `bulk_ratio` is kappa / mu of all materials.
        """
        ng = self._ng = require("ngsolve", "reference")
        ng.SetNumThreads(1)
        ng.ngsglobals.msg_level = 0
        self.mesh, self.steps = mesh, np.zeros(0)
        at_rest = {a: "|".join(name for name, axes in fixed.items() if a in axes) for a in "xyz"}
        rests = {f"dirichlet{axis}": names for axis, names in at_rest.items()}
        self._space = ng.VectorH1(mesh, order=order, **rests) * ng.L2(mesh, order=order - 2)
        u, q = self._space.TrialFunction()
        mu, F = mesh.MaterialCF(dict(moduli)), ng.Id(3) + ng.Grad(u)
        J, stress = ng.Det(F), _STRESS * q
        energy = 0.5 * mu * (J ** (-2.0 / 3.0) * ng.InnerProduct(F, F) - 3.0)
        energy += stress * (J - 1.0) - stress**2 / (2.0 * bulk_ratio * mu)
        self._form = ng.BilinearForm(self._space, symmetric=True, condense=True)
        self._form += ng.Variation(energy.Compile() * ng.dx)
        self.state, self.unknowns = ng.GridFunction(self._space), int(self._space.ndof)

    def start(self, other: "MixedSolid") -> None:
        """Take the equilibrium of another order as the initial guess."""
        for mine, theirs in zip(self.state.components, other.state.components, strict=True):
            mine.Set(theirs)
        self.state.vec.FV().NumPy()[~np.array(list(self._space.FreeDofs()))] = 0.0
        self.steps = other.steps

    def settle(self, held_contacts: Sequence[HeldContact]) -> int:
        """Equilibrium under prescribed shapes and forces by Newton's method, from `state`.

        Returns the number of iterations; raises SolidError, `state` unchanged, at too many.
        """
        state, before, steps = self.state, self.state.vec.CreateVector(), self.steps
        before.data = state.vec
        if len(steps) != len(held_contacts):
            self.steps = np.zeros(len(held_contacts))
        # NGSolve raises an error of its own where the guess is too far from an equilibrium.
        singular = require("netgen.libngpy._meshing", "reference").NgException
        displacements = int(self._space.components[0].ndof)
        try:
            for iteration in range(_MAX_ITERATIONS):
                increment, moved = self._increment(held_contacts)
                state.vec.data += increment
                self.steps = self.steps + moved
                vectors = (each.FV().NumPy()[:displacements] for each in (increment, state.vec))
                change, size = (float(np.abs(vector).max()) for vector in vectors)
                if not math.isfinite(change) or change > 1e3:
                    break
                if change < _TOLERANCE * max(size, 1e-3):
                    return iteration + 1
            raise SolidError("Newton's method found no equilibrium of the reference", 0.0)
        except (SolidError, singular) as error:
            state.vec.data, self.steps = before, steps
            raise SolidError(str(error), 0.0) from error

    def _boundary_displacement(self, boundary: str, value: Any) -> Any:
        """Vector of a displacement on one boundary, zero elsewhere."""
        field = self._ng.GridFunction(self._space)
        field.components[0].Set(value, definedon=self.mesh.Boundaries(boundary))
        return field.vec

    def _increment(self, held: Sequence[HeldContact]) -> tuple[Any, Array]:
        """Newton increment of the state and of the translations."""
        form, product, state = self._form, self._ng.InnerProduct, self.state.vec
        free = self._ng.BitArray(self._space.FreeDofs(True))
        jump = state.CreateVector()  # from the displacements of the patches to the prescribed ones
        jump[:] = 0.0
        for patch, step in zip(held, self.steps, strict=True):
            dofs = self._space.components[0].GetDofs(self.mesh.Boundaries(patch.boundary))
            shift = self._ng.CoefficientFunction(tuple(step * np.array(patch.direction)))
            target = self._boundary_displacement(patch.boundary, patch.shape + shift)
            for number in np.flatnonzero(np.array(list(dofs))).tolist():
                free[number] = False
                jump[number] = target[number] - state[number]
        form.AssembleLinearization(state)
        inverse = form.mat.Inverse(free, inverse="sparsecholesky")
        residual = state.CreateVector()
        form.Apply(state, residual)
        condensed = (residual + form.harmonic_extension_trans * residual).Evaluate()
        # Increments on the surfaces of the cells, with given values on the boundary.
        load = (form.mat * jump + condensed).Evaluate()
        total = (jump - inverse * load).Evaluate()
        reaction = (form.mat * total + condensed).Evaluate()
        direction = self._ng.CoefficientFunction
        lifts = [
            self._boundary_displacement(patch.boundary, direction(patch.direction))
            for patch in held
        ]
        moved = [(lift - inverse * (form.mat * lift).Evaluate()).Evaluate() for lift in lifts]
        forces = [(form.mat * each).Evaluate() for each in moved]
        stiffness = [[product(lift, force) for force in forces] for lift in lifts]
        missing = np.array([patch.force for patch in held])
        missing -= [product(lift, reaction) for lift in lifts]
        steps = np.linalg.solve(np.array(stiffness), missing)
        for step, each in zip(steps.tolist(), moved, strict=True):
            total.data += step * each
        inner = form.harmonic_extension * total - form.inner_solve * residual
        total.data += inner.Evaluate()
        return total, steps


def contact_profile(stack: Stack, indenter: Indenter, force: float) -> tuple[float, Any, Any]:
    """Contact of the axisymmetric press at a force [N].

    Returns the undeformed radius where contact ends [mm], and by the radius the displacement
    outwards, and upwards from the indenter's lowest point, splines [mm].
    """
    press = AxisymmetricPress(stack, indenter, finest=_CELL * indenter.rims[1])
    # Small steps, since a rough indenter sticks to newly touched points only after each.
    for part in (np.arange(1, _STEPS + 1) / _STEPS) ** 1.5:
        pressed = press.to_force(part * force)
    pressure = press.contact.nominal_pressure(press.unknowns).ravel()
    r = press.contact.face.points[..., 0].ravel()
    order = np.argsort(r)
    last = np.flatnonzero(pressure[order] > 0.0)[-1]
    radius = 1e3 * float(r[order][last : last + 2].mean())
    knots = np.arange(0.0, 1.1 * radius, _KNOTS)
    spline, top = require("ngsolve", "reference").BSpline, pressed.displacement[:, -1]
    outwards, upwards = (
        spline(2, [0.0, *knots], (1e3 * np.interp(knots, 1e3 * pressed.r, values)).tolist())
        for values in (top + np.array([0.0, pressed.depth])).T
    )
    return radius, outwards, upwards


class ReferenceStack:
    """Meshed sensor of one case; `solve` gives its equilibrium.

    Attributes:
        solid: solid of the last order.
        depths: depths of the indenters' lowest points under the undeformed top [mm].
    """

    def __init__(self, case: ReferenceCase, numerics: Numerics | None = None) -> None:
        """Mesh the case."""
        self._case, self._numerics = case, numerics or Numerics()
        design, mechanics, support = case.design, case.mechanics, case.design.support
        self._gel = 1e3 * np.array([design.outline.length, design.outline.width, design.thickness])
        self._around = 0.5e3 * (design.encapsulated_thickness - design.thickness)
        self._touches = tuple((1e3 * touch.x, 1e3 * touch.y) for touch in case.scene.touches)
        first, stack = case.scene.touches[0], mechanics.stack(design)
        self._force = 1e3 * (first.force or 0.0)
        self._profile = contact_profile(stack, first.indenter, 1e-3 * self._force)
        self.depths: Array = np.zeros(len(self._touches))
        margin, (length, width, height) = 1e3 * mechanics.margin, self._gel.tolist()
        box = (-margin, length + margin, -margin, width + margin)
        gap = support.gap(design.outline) if isinstance(support, Plates) else ()
        breaks = [0.0, length, *(1e3 * x for x in gap)]
        lines = [((x, box[2]), (x, box[3])) for x in breaks]
        lines += [((box[0], y), (box[1], y)) for y in (0.0, width)]
        plan = triangulate_box(box, lines, self._touches, self._profile[0], self._numerics)
        levels = [-self._around, 0.0, height, height + self._around]
        if isinstance(support, Substrate):
            levels = [levels[0] - 1e3 * support.thickness, *levels]
        heights = levels[:1]
        for (low, high), count in zip(pairwise(levels), _LAYERS[-len(levels) + 1 :], strict=True):
            heights += np.linspace(low, high, count + 1)[1:].tolist()
        self._top, self._bottom = levels[-1], levels[0]
        self._mesh = extrude(*plan, heights, self._material, self._boundary)
        self.solid = self._solid(max(2, self._numerics.order - 1))

    def solve(self) -> None:
        """Equilibrium by steps of the load, then of full order; raises SolidError without one."""
        shapes = [self._shape(touch) for touch in self._touches]

        def held_contacts(t: float) -> list[HeldContact]:
            return [
                HeldContact(f"contact {k}", t * u, t * self._force) for k, u in enumerate(shapes)
            ]

        reached, step = 0.0, 0.5
        while reached < 1.0:
            t = min(1.0, reached + step)
            try:
                iterations = self.solid.settle(held_contacts(t))
            except SolidError:
                if (step := 0.5 * (t - reached)) < _MIN_LOAD_STEP:
                    raise
                continue
            reached, step = t, (1.5 if iterations < 7 else 1.0) * step
        lower, self.solid = self.solid, self._solid(self._numerics.order)
        self.solid.start(lower)
        self.solid.settle(held_contacts(1.0))
        self.depths = self.solid.steps

    def gradient(self, points: Array) -> Array:
        """Displacement gradient (..., 3, 3) at points (..., 3) of the gel [m]."""
        x = np.clip(1e3 * points.reshape(-1, 3), _INWARDS, self._gel - _INWARDS)
        grad = require("ngsolve", "reference").Grad(self.solid.state.components[0])
        slope: Array = grad(self.solid.mesh(*x.T))
        return slope.reshape(*points.shape, 3)

    def _solid(self, order: int) -> MixedSolid:
        """Solid of displacements of an order on the mesh, at rest."""
        mechanics, support = self._case.mechanics, self._case.design.support
        laws = {"gel": mechanics.gel, "encapsulation": mechanics.encapsulation}
        moduli = {name: 1e-3 * law.shear_modulus for name, law in laws.items()}
        if isinstance(support, Substrate):
            moduli["substrate"] = 1e-3 * support.shear_modulus
        fixed = {"base": "xyz"} | ({"side": "xyz"} if isinstance(support, Free) else {})
        return MixedSolid(self._mesh, moduli, order, fixed, mechanics.bulk_ratio)

    def _material(self, centre: Array) -> str:
        if np.all((centre > 0.0) & (centre < self._gel)):
            return "gel"
        return "substrate" if centre[2] < -self._around else "encapsulation"

    def _boundary(self, centre: Array) -> str:
        if centre[2] > self._top - _SAME:
            for number, touch in enumerate(self._touches):
                if is_within(centre[:2], touch, self._profile[0]):
                    return f"contact {number}"
            return "top"
        if centre[2] > self._bottom + _SAME:
            return "side"
        support, x = self._case.design.support, 1e-3 * float(centre[0])
        if isinstance(support, Plates):
            low, high = support.gap(self._case.design.outline)
            return "under" if low < x < high else "base"
        return "under" if isinstance(support, Free) else "base"

    def _shape(self, touch: tuple[float, float]) -> Any:
        """Displacement of a contact when the indenter's lowest point is on the top at rest."""
        ng, (_, outwards, upwards) = require("ngsolve", "reference"), self._profile
        along, across = ng.x - touch[0], ng.y - touch[1]
        r = ng.sqrt(along**2 + across**2 + 1e-12)
        return ng.CF((outwards(r) * along / r, outwards(r) * across / r, upwards(r)))


def solution(case: ReferenceCase) -> dict[str, Any]:
    """Solution of a case as it is written, with changes by the finest forward model."""
    start, gauge = time.perf_counter(), Gauge(case.design, "fine")
    stack = ReferenceStack(case)
    try:
        stack.solve()
    except SolidError as error:
        return {"changes": None, "refused": str(error)}
    seconds = time.perf_counter() - start
    return {
        "depth": stack.depths.tolist(),
        "unknowns": stack.solid.unknowns,
        "seconds": round(seconds, 1),
        "changes": gauge.changes(Displaced(np.zeros_like, stack.gradient)).tolist(),
    }


def main() -> None:
    """Solve the cases."""
    require_all(reference="ngsolve netgen")
    options = argparse.ArgumentParser(description="Reference solutions of presses in 3D.")
    options.add_argument("--out", type=Path, required=True, help="JSON file; gone on with")
    options.add_argument("--only", nargs="*", help="names of cases")
    chosen = options.parse_args()
    solutions = json.loads(chosen.out.read_text())["solutions"] if chosen.out.is_file() else []
    solved_names = {one["name"] for one in solutions}
    provenance = msgspec.to_builtins(Provenance.now(seed=0))
    provenance["packages"]["ngsolve"] = metadata.version("ngsolve")
    described = {one["name"]: one for one in json.loads(PUBLISHED_FILE.read_text())["solutions"]}
    for case in cases():
        flat = case.kind in ("press", "supported press")
        if flat and case.name not in solved_names and case.name in (chosen.only or described):
            print(case.name, flush=True)
            solutions.append(described[case.name] | solution(case))
            data = {"command": _COMMAND, "provenance": provenance, "solutions": solutions}
            with atomic_file(chosen.out) as temporary:
                temporary.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
