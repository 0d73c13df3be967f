"""Finite stack under presses: dents of the unbounded stack, and their correction in 3D.

A dent of the unbounded stack leaves tractions on the free sides, stresses of gel where the margin
is of silicone, and a base where the support may have none. The correction c and its pressure q are
the smooth difference to equilibrium of the whole stack at finite strain,

    int P(F_d + dc/dX, p_d + q) : dv dV = int P_d : dv dV - int P_d N . v dA  for all v,

F_d = 1 + sum G_d of all dents, the last integral over the faces that are free in the finite stack
only: at a free base it is the reaction in the first integral, at the sides it is integrated. Under
an indenter that sticks, c takes back what the dents of other indenters move, but for a vertical
translation at an unchanged force.

A bent stack is pressed likewise: F_d = F_b + sum R G_d, with the equilibrium F_b of the bend and
its pressure, and dents that are turned to the bent top (`ContactFrame`). The residual of F_b joins
the right-hand side, as that of coarse quadrature, and the contact takes back the curvature of the
bent top.

A flat punch has no dent: c is all that it does, and its force acts on the unknown depth. One whose
force acts off its middle tilts, and leaves the face where it would pull.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import islice

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.geometry.design.surface import Surface
from eitskin.simulator.deformation.contact import (
    BentState,
    DentField,
    HeldContact,
    PunchedArea,
)
from eitskin.simulator.deformation.solved_correction import Correction, gel_interpolator, on_grid
from eitskin.simulator.mechanics.box_fields import QuadraticField
from eitskin.simulator.mechanics.face import Face
from eitskin.simulator.mechanics.load_stepping import (
    ForceTerm,
    Load,
    SolidError,
    follow,
    newton,
)
from eitskin.simulator.mechanics.materials import Law, cofactor, determinant
from eitskin.simulator.mechanics.mixed_solid import Solid, StrainState
from eitskin.simulator.mechanics.stack_mesh import StackMesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Springs that hold a contact, relative to shear modulus over its radius. Those of a punch carry all
# of its force: they are relative to the modulus over the thickness where the punch is wider.
_STIFFNESS, _PUNCH_STIFFNESS = 200.0, 2000.0
# A cell that the rim of a contact cuts is held almost as a whole, as by a larger contact, which
# takes up to 7 % from the signal. The springs therefore end before the rim, by this part of a cell.
_WITHIN, _LEAST_HELD = 0.15, 0.5  # the least over the radius of the contact
_INSIDE = 0.9  # of the radius, where the cells at the rim are measured
_LEVEL = 1e-9  # [m]
_TOLERANCE = 1e-2  # of the last correction; the error is its square
# Corrections over the depth of the dents, below which they need no digits: far from all sides of a
# thin stack there are none.
_NEGLIGIBLE = 1e-4
_FIRST_STEP, _REMEDY = 0.25, "Press it less, or farther from its edge"
# Unknowns of a solid; 95,000 took 3 GB at their peak, and memory grows a little faster.
_MAX_UNKNOWNS = 250_000


class DentedSolid(Solid):
    """Solid with F = 1 + G + dc/dX and mean stress p_0 + p: c and p change a given state.

    The sharp part of a deformation, G and p_0, is thus no unknown, and what remains is smooth and
    needs few cells. On those cells the given state has a residual of its own, which is that of
    coarse quadrature; subtracted as a dead force, it does not disturb the equilibrium.

    Attributes:
        points: quadrature points, (cells, q, 3) [m].
    """

    def __init__(
        self, mesh: skfem.Mesh, laws: Sequence[Law], law_of_cell: Indices, bulk_ratio: float
    ) -> None:
        """Number the unknowns of a solid at rest; arguments as for `Solid`."""
        super().__init__(mesh, laws, law_of_cell, "solid", bulk_ratio)
        self.points: Array = np.moveaxis(np.asarray(self.basis.global_coordinates()), 0, -1)
        self._gradient: Array = np.zeros((1, 1, 3, 3))
        self._given_stress: Array = np.zeros((1, 1))

    def dent(self, gradient: Array, mean_stress: Array) -> None:
        """Set the given state: G (n, 3, 3) and p_0 (n,) [Pa] at all quadrature points."""
        self._gradient = gradient.reshape(*self.weights.shape, 3, 3)
        self._given_stress = mean_stress.reshape(self.weights.shape)
        self._last = None

    def state_residual(
        self,
        gradient: Array,
        mean_stress: Array,
        law_of_cell: Indices,
        nominal: Callable[[Array], Array] | None = None,
    ) -> Array:
        """Residual (unknowns,) of a state G (n, 3, 3), p_0 (n,), in cells of other materials.

        `nominal` turns the stresses (..., 3, 3) of a state that is given in a frame of its own.
        """
        shape = self.weights.shape
        P, dilation = np.empty((*shape, 3, 3)), np.empty(shape)
        for k in range(len(self.laws)):
            cells = law_of_cell == k
            G, p = gradient.reshape(*shape, 3, 3)[cells], mean_stress.reshape(shape)[cells]
            P[cells], dilation[cells] = self.stress_and_dilation(k, G, p)
        return self._integrate(nominal(P) if nominal else P, dilation, self.unknowns)

    def stress_and_dilation(self, law: int, gradient: Array, p: Array) -> tuple[Array, Array]:
        """First Piola-Kirchhoff stress [Pa] and volume error of a state G (..., 3, 3), p (...)."""
        F = np.eye(3) + gradient
        H = cofactor(F)
        J = determinant(F, H)
        mu = self.laws[law].shear_modulus
        mean = p + self.direct_ratio * mu * (J - 1.0)
        dilation = J - 1.0 - p / ((self.bulk_ratio - self.direct_ratio) * mu)
        return self.laws[law].stress(F) + mean[..., None, None] * H, dilation

    def _evaluate_strain(self, x: Array) -> StrainState:
        moved = super()._evaluate_strain(x)
        F = moved.F + self._gradient
        H = cofactor(F)
        J = determinant(F, H)
        return StrainState(moved.x, F, H, J, moved.multiplier + self._given_stress)


class FiniteStack:
    """Stack of a finite outline under presses whose dents in the unbounded stack are known.

    Attributes:
        body: the mesh and its support.
        solid: the meshed stack about the dents.
    """

    def __init__(self, body: StackMesh, motions: int = 1, bend: BentState | None = None) -> None:
        """Number the unknowns on a mesh that is refined for presses.

        Each press has a motion, that of a tilting punch three. The stack is pressed in its state
        `bend`, or flat. Raises ConfigurationError for more unknowns than memory is allowed for.
        """
        self.body, self._bent = body, bend
        self.solid = DentedSolid(body.mesh, body.laws, body.law_of_cell, body.stack.bulk_ratio)
        if self.solid.unknowns > _MAX_UNKNOWNS:
            raise ConfigurationError(
                f"the stack under these touches needs {self.solid.unknowns} unknowns, of which "
                f"{_MAX_UNKNOWNS} (about 8 GB) are allowed; press with larger indenters, or "
                "model a smaller part of the sensor"
            )
        self._size = self.solid.unknowns + motions
        held = self.solid.facet_nodes(body.facets("held"))
        base = np.flatnonzero(self.solid.nodes[:, 2] < _LEVEL)
        self._fixed = self.solid.displacement_unknowns(held)
        self._loose = self.solid.displacement_unknowns(np.setdiff1d(base, held))
        self._bend = np.zeros(self.solid.unknowns)

    def correction(
        self,
        dents: Sequence[DentField],
        start: Array | None = None,
        punches: Sequence[PunchedArea] = (),
    ) -> Correction:
        """Correction of dents in equilibrium, found from none or from the unknowns `start`.

        Flat punches follow the dents in the numbers of presses. Where Newton's method fails, the
        load is applied in steps. Raises SolidError where no stable equilibrium is found, with the
        fraction of the missing forces that were applied.
        """
        areas: list[DentField | PunchedArea] = [*dents, *punches]
        tilts = iter(range(self.solid.unknowns + len(areas), self._size))
        contacts = []
        for number, area in enumerate(areas, self.solid.unknowns):
            tilting = isinstance(area, PunchedArea) and area.tilts
            motions = [number, *(islice(tilts, 2) if tilting else ())]
            others = [dent for dent in dents if dent is not area]
            contacts.append(self._hold_contact(area, others, motions))
        pressing = np.zeros(self._size - self.solid.unknowns)
        pressing[len(dents) : len(areas)] = [area.force or 0.0 for area in punches]
        forces = np.append(self._assemble_dent_load(dents), pressing)
        to_depth = [n for n, area in enumerate(punches, len(dents)) if area.force is None]
        load = Load(
            np.append(self._fixed, np.array(to_depth, dtype=np.int64) + self.solid.unknowns),
            np.append(np.zeros(len(self._fixed)), [areas[n].depth for n in to_depth]),
            forces,
        )
        solve = partial(
            newton,
            tolerance=_TOLERANCE,
            scale=_NEGLIGIBLE * max(area.depth for area in areas),
            chords=True,
        )
        touched = contacts
        x = self._equilibrium(touched, load, solve, start)
        while True:
            released = [each.release(x) if len(each.face.motions) > 1 else each for each in touched]
            if released == touched:
                return self._result(x, contacts, touched)
            touched = released
            x = self._equilibrium(touched, load, solve, x)

    def _equilibrium(
        self,
        contacts: Sequence[HeldContact],
        load: Load,
        solve: Callable[[Sequence[ForceTerm], Array, Load], Array],
        start: Array | None,
    ) -> Array:
        """Unknowns in equilibrium with contacts under a load."""
        terms = self.solid, *(contact.springs(self._size) for contact in contacts)
        none = np.zeros(self._size)
        x = none if start is None else start
        try:
            if self.solid.admissible(x):
                return solve(terms, x, load)
        except SolidError:
            pass
        if not self.solid.admissible(none):
            raise SolidError(
                "the dents of these presses turn the stack inside out where they overlap; press "
                "farther apart, or less"
            )
        own = self.solid.forces(none)  # in which the dents are an equilibrium

        def path(t: float) -> Load:
            return Load(load.fixed, t * load.values, own + t * (load.forces - own))

        return follow(terms, none, path, _FIRST_STEP, solve, _REMEDY)[0]

    def reaction(self, correction: Correction) -> Array:
        """Force of the support against the presses of the last correction [N], (3,).

        That against the bend is left out, since on a coarse mesh it does not add up to zero.
        """
        forces = self.solid.forces(correction.unknowns)[: self.solid.unknowns] - self._bend
        held = self.solid.facet_nodes(self.body.facets("held"))
        return np.asarray(self.solid.displacement(forces)[held].sum(axis=0))

    def _assemble_dent_load(self, dents: Sequence[DentField]) -> Array:
        """Forces (unknowns,) in equilibrium with the dents; sets the state of the solid."""
        points = self.solid.points.reshape(-1, 3)
        heights = self.body.mesh.p[2, self.body.mesh.t].mean(axis=0)
        laws = self.body.layer_materials(heights)
        G, p = np.zeros((len(points), 3, 3)), np.zeros(len(points))
        load = np.zeros(self.solid.unknowns)
        for dent in dents:
            level = dent.level(points)
            load += self.solid.state_residual(level.gradient, level.mean_stress, laws, dent.nominal)
            if not self.body.free:  # a free base is held at the sides
                load -= self._tractions(dent)
            _, gradient, stress = dent.rotate_values(level)
            G += gradient
            p += stress
        # Reactions of the base sum to the force; tractions from the dent's stresses leave 4 % out.
        load[self._loose] = 0.0
        if self._bent is not None:
            here = self._in_design(points)
            bend, pressure = self._bent.gradient(here) - np.eye(3), self._bent.mean_stress(here)
            self._bend = self.solid.state_residual(bend, pressure, self.body.law_of_cell)
            load += self._bend
            G += bend
            p += pressure
        self.solid.dent(G, p)
        return load

    def _tractions(self, dent: DentField) -> Array:
        """Nodal forces (unknowns,) of a dent's tractions on the sides."""
        sides = Face(self.solid, self.body.facets("sides"), 6)
        _, G, p = dent.level(sides.points.reshape(-1, 3))
        laws = self.body.layer_materials(sides.points[..., 2]).ravel()
        P = np.empty_like(G)
        for k in range(len(self.body.laws)):
            here = laws == k
            P[here] = self.solid.stress_and_dilation(k, G[here], p[here])[0]
        stress = dent.nominal(P).reshape(*sides.points.shape, 3)
        traction = np.einsum("fqij,fqj->fqi", stress, sides.normals)
        return sides.forces(traction, self.solid.unknowns)

    def _hold_contact(
        self, dent: DentField | PunchedArea, others: Sequence[DentField], motions: Sequence[int]
    ) -> HeldContact:
        frame = dent.frame

        def motion_before(points: Array) -> Array:
            moved = sum((other.evaluate(points).displacement for other in others), np.zeros((1, 3)))
            if self._bent is None or frame is None:
                return moved
            bent = self._bent.map_points(self._in_design(points))[0]
            return np.asarray(moved + bent - frame.flatten_points(points))

        mesh, top = self.body.mesh, self.body.facets("top")
        stretches = np.ones(2) if frame is None else frame.stretches
        corners = mesh.p[:2, mesh.facets[:, top]]
        centre, radius = np.array([dent.x, dent.y]), dent.contact_radius
        nearest = np.clip(centre[:, None], corners.min(axis=1), corners.max(axis=1))
        away = stretches[:, None] * (nearest - centre[:, None])
        near = np.linalg.norm(away, axis=0) < radius
        rims = _INSIDE * np.array([-1.0, 1.0])
        cells = [
            stretch * np.diff(line)[np.searchsorted(line[1:-1], c + half * rims / stretch)]
            for line, c, half, stretch in zip(
                self.body.lines, centre, dent.half, stretches, strict=False
            )
        ]
        # A contact may be smaller than a cell, as those of balls are.
        held = max(radius - _WITHIN * float(np.mean(cells)), _LEAST_HELD * radius)
        stiff, size, within = _STIFFNESS, radius, radius - held
        if isinstance(dent, PunchedArea):
            stiff, size = _PUNCH_STIFFNESS, min(radius, self.body.stack.levels[-1])
            within = 0.0 if dent.indenter.is_aligned else within
        stiffness = stiff * self.body.stack.sheets[-1].law.shear_modulus / size
        moved = motion_before if others or frame is not None else None
        return HeldContact.from_facets(
            self.solid, top[near], dent, within, stiffness, motions, moved
        )

    def _in_design(self, points: Array) -> Array:
        """Points (n, 3) with their heights over the gel's lower face [m]."""
        bottom = self.body.stack.levels[self.body.stack.gel]
        return np.asarray(points - np.array([0.0, 0.0, bottom]))

    def _result(
        self, x: Array, contacts: Sequence[HeldContact], touched: Sequence[HeldContact]
    ) -> Correction:
        """Correction by the unknowns, where of some contacts some points touch."""
        solid, lines = self.solid, self.body.lines
        gel = self.body.stack.sheets[self.body.stack.gel].law
        middles = [np.sort(np.append(line, 0.5 * (line[1:] + line[:-1]))) for line in lines]
        stress = solid.corner_mean_stress(x, self.body.laws.index(gel))
        of_gel = np.isfinite(stress)
        corners, nodes, shown = self.body.mesh.p.T, solid.nodes, np.arange(len(solid.nodes))
        if (plan := self.body.plan) is not None:
            corners = np.column_stack([np.tile(plan.places, (len(lines[2]), 1)), corners[:, 2]])
            grid = skfem.CellBasis(
                skfem.MeshHex(np.ascontiguousarray(corners.T), self.body.mesh.t), solid.basis.elem
            )
            nodes = grid.doflocs.T
            shown = np.unique(grid.element_dofs[:, plan.in_gel(self.body.mesh.t.shape[1])])
        pressures = on_grid(corners[of_gel], stress[of_gel, None], lines)[..., 0]
        moved = on_grid(nodes[shown], solid.displacement(x)[shown], middles)
        return Correction(
            displacement=QuadraticField(lines, moved),
            mean_stress=gel_interpolator(pressures, lines),
            bottom=self.body.stack.levels[self.body.stack.gel],
            sunk=x[solid.unknowns : solid.unknowns + len(contacts)].copy(),
            holding=np.array(
                [
                    [*now.force_and_peak(x), now.face.weights.sum() / whole.face.weights.sum()]
                    for now, whole in zip(touched, contacts, strict=True)
                ]
            ),
            unknowns=x,
            fit=None if plan is None else plan.shift,
        )


def require_on_stack(outline: PlaneOutline | Surface, x: float, y: float, least: float) -> None:
    """Raise ConfigurationError for a press nearer to the edge of the gel than `least` [m]."""
    if float(outline.nearest(np.array([x, y]))[1]) < least - _LEVEL:
        raise ConfigurationError(
            f"a touch must keep {1e3 * max(least, 0.0):.1f} mm from the edge of the gel, so that "
            f"its contact stays on the stack, got ({x:g}, {y:g}) m; press farther in"
        )
