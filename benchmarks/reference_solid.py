"""Nearly incompressible neo-Hookean solids in NGSolve, on prisms, with patches under given loads.

Lengths are in mm, moduli in kPa, hence forces in mN.
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

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Naming = Callable[[Array], str]
"""Name of the material or boundary at a position (3,) [mm]."""
Touches = tuple[tuple[float, float], ...]

_TOLERANCE = 1e-5  # of the largest change of a displacement over the largest displacement
_MAX_ITERATIONS = 20
_STRESS = 1e2  # unit of the unknowns of the mean stress [kPa]


@dataclass(frozen=True, slots=True)
class Numerics:
    """Discretisation: order of the displacements, and edge lengths of the triangles [mm].

    Attributes:
        order: of the displacements; the load rises at one less, down to 2.
        rim: edges along the rims of the contacts.
        inside: edges within these.
        far: edges elsewhere.
    """

    order: int = 4
    rim: float = 1.0
    inside: float = 2.5
    far: float = 12.0


def triangulated(
    box: tuple[float, float, float, float],
    lines: Sequence[tuple[tuple[float, float], tuple[float, float]]],
    centres: Touches,
    radius: float,
    sizes: Numerics,
) -> tuple[Array, Indices]:
    """Triangulation of a rectangle that resolves lines and circles.

    Args:
        box: x from, x to, y from, y to [mm].
        lines: straight segments that no triangle crosses, from and to (x, y) [mm].
        centres, radius: of circles inside the box, as polygons of their area [mm].
        sizes: of the triangles.

    Returns points (n, 2) [mm] and triangles (m, 3), anticlockwise.
    """
    occ = require("netgen.occ", "reference")

    def face(corners: Array) -> Any:
        pen = occ.WorkPlane(occ.Axes((0, 0, 0), n=occ.Z, h=occ.X)).MoveTo(*corners[0])
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
        inside = any(np.all(within(corners, centre, radius)) for centre in centres)
        each.maxh = sizes.inside if inside else sizes.far
    mesh = occ.OCCGeometry(plan, dim=2).GenerateMesh(maxh=sizes.far, grading=0.45)
    points = np.array([point.p[:2] for point in mesh.Points()])
    triangles = np.array([[v.nr - 1 for v in cell.vertices] for cell in mesh.Elements2D()])
    a, b = (points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2))
    turned = a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]
    triangles[turned] = triangles[turned][:, ::-1]
    return points, triangles


def within(points: Array, centre: tuple[float, float], radius: float) -> NDArray[np.bool_]:
    """Whether points (..., 2) lie in a circle, the corners of its polygon included."""
    inside: NDArray[np.bool_] = np.sum((points - centre) ** 2, axis=-1) < 1.05 * radius**2
    return inside


def extruded(
    points: Array, triangles: Indices, heights: Sequence[float], material: Naming, boundary: Naming
) -> Any:
    """Mesh of prisms between all neighbouring heights, an `ngsolve.Mesh`.

    Args:
        points: of the plan, (n, 2) [mm].
        triangles: anticlockwise, (m, 3).
        heights: of the layers of prisms, rising [mm].
        material: name at the centroid of a prism.
        boundary: name at the centroid of a boundary facet.
    """
    netgen = require("netgen.meshing", "reference")
    mesh, count = netgen.Mesh(dim=3), len(points)
    numbers = [
        mesh.Add(netgen.MeshPoint(netgen.Pnt(*p, z))) for z in heights for p in points.tolist()
    ]
    names: dict[str, int] = {}
    faces: dict[str, int] = {}

    def add(corners: Sequence[int], centre: Array) -> None:
        name = boundary(centre)
        if name not in faces:
            faces[name] = len(faces) + 1
            mesh.Add(netgen.FaceDescriptor(surfnr=len(faces), domin=1, bc=len(faces)))
        mesh.Add(netgen.Element2D(faces[name], [numbers[v] for v in corners]))

    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    _, first, times = np.unique(np.sort(edges), axis=0, return_index=True, return_counts=True)
    middles, top = points[triangles].mean(axis=1), count * (len(heights) - 1)
    for k, (low, high) in enumerate(pairwise(heights)):
        for cell, middle in zip(count * k + triangles, middles, strict=True):
            name = material(np.append(middle, 0.5 * (low + high)))
            domain = names.setdefault(name, len(names) + 1)
            mesh.Add(netgen.Element3D(domain, [numbers[v] for v in (*cell, *(cell + count))]))
        for a, b in count * k + edges[first[times == 1]]:
            middle = np.append(points[[a % count, b % count]].mean(axis=0), 0.5 * (low + high))
            add([a, b, b + count, a + count], middle)
    for cell, middle in zip(triangles, middles, strict=True):
        add(cell[::-1], np.append(middle, heights[0]))
        add(cell + top, np.append(middle, heights[-1]))
    for name, domain in names.items():
        mesh.SetMaterial(domain, name)
    for name, number in faces.items():
        mesh.SetBCName(number - 1, name)
    return require("ngsolve", "reference").Mesh(mesh)


@dataclass(frozen=True, slots=True)
class Held:
    """Patch of the boundary whose shape is prescribed, free to translate along one direction.

    Attributes:
        boundary: name of the boundary.
        shape: displacement of the patch, a coefficient function of 3 components [mm].
        force: on the patch along `direction` [mN].
        direction: unit vector of the translation.
    """

    boundary: str
    shape: Any
    force: float
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)


class MixedSolid:
    """Finite-strain equilibrium of a mesh of several neo-Hookean materials, by NGSolve.

    Stationary points of int mu/2 (J^(-2/3) tr F^T F - 3) + q (J - 1) - q^2 / (2 kappa) dV, with
    displacements of order p and discontinuous mean stresses q of order p - 2, which are eliminated
    cell by cell.

    Attributes:
        mesh: an `ngsolve.Mesh` [mm].
        state: displacement and scaled mean stress at the last equilibrium.
        steps: translation of the held patches along their directions [mm].
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

        Args:
            mesh: an `ngsolve.Mesh` [mm].
            moduli: shear modulus of each material [kPa].
            order: p of the displacements.
            fixed: axes "x", "y", "z" or several that are at rest on each boundary.
            bulk_ratio: kappa / mu of all materials.
        """
        ng = self._ng = require("ngsolve", "reference")
        ng.SetNumThreads(1)
        ng.ngsglobals.msg_level = 0
        self.mesh, self.steps = mesh, np.zeros(0)
        names = {
            f"dirichlet{axis}": "|".join(b for b, axes in fixed.items() if axis in axes)
            for axis in "xyz"
        }
        self._space = ng.VectorH1(mesh, order=order, **names) * ng.L2(mesh, order=order - 2)
        u, q = self._space.TrialFunction()
        mu, F = mesh.MaterialCF(dict(moduli)), ng.Id(3) + ng.Grad(u)
        J, stress = ng.Det(F), _STRESS * q
        energy = 0.5 * mu * (J ** (-2.0 / 3.0) * ng.InnerProduct(F, F) - 3.0)
        energy += stress * (J - 1.0) - stress**2 / (2.0 * bulk_ratio * mu)
        self._form = ng.BilinearForm(self._space, symmetric=True, condense=True)
        self._form += ng.Variation(energy.Compile() * ng.dx)
        self.state = ng.GridFunction(self._space)

    @property
    def unknowns(self) -> int:
        """Number of displacements and mean stresses."""
        return int(self._space.ndof)

    def start(self, other: "MixedSolid") -> None:
        """Take the equilibrium of another order as the initial guess."""
        for mine, theirs in zip(self.state.components, other.state.components, strict=True):
            mine.Set(theirs)
        free = np.array(list(self._space.FreeDofs()))
        self.state.vec.FV().NumPy()[~free] = 0.0
        self.steps = other.steps

    def settle(self, held: Sequence[Held]) -> int:
        """Equilibrium under prescribed shapes and forces by Newton's method, from `state`.

        Returns the number of iterations; raises SolidError, with `state` as it was, where there
        are too many.
        """
        state, before, steps = self.state, self.state.vec.CreateVector(), self.steps.copy()
        before.data = state.vec
        if len(steps) != len(held):
            self.steps = np.zeros(len(held))
        # NGSolve raises an error of its own where the guess is too far from an equilibrium.
        singular = require("netgen.libngpy._meshing", "reference").NgException
        displacements = int(self._space.components[0].ndof)
        try:
            lifts = [self._lift(patch) for patch in held]
            free = self._ng.BitArray(self._space.FreeDofs(True))
            for patch in held:
                for number in self._prescribed(patch.boundary):
                    free[int(number)] = False
            residual = state.vec.CreateVector()
            for iteration in range(_MAX_ITERATIONS):
                self._form.AssembleLinearization(state.vec)
                inverse = self._form.mat.Inverse(free, inverse="sparsecholesky")
                self._form.Apply(state.vec, residual)
                increment, moved = self._increment(inverse, residual, lifts, held)
                state.vec.data += increment
                self.steps += moved
                change, size = (
                    float(np.abs(vector.FV().NumPy()[:displacements]).max())
                    for vector in (increment, state.vec)
                )
                if not math.isfinite(change) or change > 1e3:
                    break
                if change < _TOLERANCE * max(size, 1e-3):
                    return iteration + 1
            raise SolidError("Newton's method found no equilibrium of the reference", 0.0)
        except (SolidError, singular) as error:
            state.vec.data, self.steps = before, steps
            raise SolidError(str(error), 0.0) from error

    def _prescribed(self, boundary: str) -> Indices:
        """Numbers of the displacements of a boundary."""
        where = self.mesh.Boundaries(boundary)
        return np.flatnonzero(np.array(list(self._space.components[0].GetDofs(where))))

    def _on(self, boundary: str, value: Any) -> Any:
        """State with a displacement on one boundary, zero elsewhere."""
        found = self._ng.GridFunction(self._space)
        found.components[0].Set(value, definedon=self.mesh.Boundaries(boundary))
        return found

    def _lift(self, patch: Held) -> Any:
        """Unit translation of a patch along its direction, zero elsewhere."""
        return self._on(patch.boundary, self._ng.CoefficientFunction(patch.direction)).vec

    def _jump(self, held: Sequence[Held]) -> Any:
        """Difference between the prescribed displacements and those of the state."""
        jump = self.state.vec.CreateVector()
        jump[:] = 0.0
        for patch, step in zip(held, self.steps, strict=True):
            shift = self._ng.CoefficientFunction(tuple(step * np.array(patch.direction)))
            target, numbers = (
                self._on(patch.boundary, patch.shape + shift),
                self._prescribed(patch.boundary),
            )
            difference = target.vec.FV().NumPy() - self.state.vec.FV().NumPy()
            jump.FV().NumPy()[numbers] = difference[numbers]
        return jump

    def _increment(
        self, inverse: Any, residual: Any, lifts: list[Any], held: Sequence[Held]
    ) -> tuple[Any, Array]:
        """Newton increment of the state and of the translations."""
        form, product = self._form, self._ng.InnerProduct
        condensed = residual.CreateVector()
        condensed.data = residual
        condensed.data += form.harmonic_extension_trans * residual

        def extended(prescribed: Any, load: Any | None) -> Any:
            """Increment on the cells' surfaces with given values on the boundary."""
            right, found = residual.CreateVector(), residual.CreateVector()
            right.data = -1.0 * (form.mat * prescribed)
            if load is not None:
                right.data -= load
            found.data = inverse * right
            found.data += prescribed
            return found

        def times(vector: Any) -> Any:
            found = residual.CreateVector()
            found.data = form.mat * vector
            return found

        total = extended(self._jump(held), condensed)
        reaction = times(total)
        reaction.data += condensed
        moved = [extended(lift, None) for lift in lifts]
        stiffness = np.array([[product(lift, times(each)) for each in moved] for lift in lifts])
        missing = [
            patch.force - product(lift, reaction) for patch, lift in zip(held, lifts, strict=True)
        ]
        steps = np.linalg.solve(stiffness, missing)
        for step, each in zip(steps.tolist(), moved, strict=True):
            total.data += step * each
        inner = residual.CreateVector()
        inner.data = form.harmonic_extension * total
        inner.data -= form.inner_solve * residual
        total.data += inner
        return total, steps
