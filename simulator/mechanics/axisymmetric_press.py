"""Axisymmetric press: an indenter on a stack of layers on a rigid base."""

import itertools
import math
from collections.abc import Callable
from typing import cast

import numpy as np
import skfem
from numpy.typing import NDArray

from eitskin.geometry.meshing.grading import Grading, graded_lines
from eitskin.simulator.mechanics.face import PenaltyContact
from eitskin.simulator.mechanics.layer_stack import Indentation, Stack
from eitskin.simulator.mechanics.load_stepping import Load, SolidError, follow
from eitskin.simulator.mechanics.mixed_solid import Solid
from eitskin.simulator.scene.indenters import Indenter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Pressure over entry into the indenter, relative to shear modulus over radius of contact.
_CONTACT_STIFFNESS = 5e3
# First step of the depth over the thickness: Newton's method misses contact with larger steps.
_FIRST_STEP = 0.008
# Longest step, likewise: a rough indenter sticks to newly touched points only after each step.
_MAX_STEP = 0.04
_STEP_TO_FORCE = 0.5  # step over the longest, on the way to a force
# Radius of the wall around the stack over its thickness or the contact radius. Dents halve within
# 0.9 thicknesses; with a wall at eight a thin sensor, whose ends are farther, came 3.7 % off.
_REACH = 14.0
_ATTRACTORS = 24  # most radii of refinement over the band where contact may end


class AxisymmetricPress:
    """Indenter on a stack; each press starts from the last equilibrium.

    Attributes:
        stack: the layers.
        indenter: rigid body that presses.
        solid: the meshed stack.
        contact: contact of the upper face with the indenter.
        unknowns: unknowns of the solid, then the depth [m], at the last equilibrium.
    """

    def __init__(
        self,
        stack: Stack,
        indenter: Indenter,
        finest: float | None = None,
        band: tuple[float, float] | None = None,
        reach: float | None = None,
    ) -> None:
        """Mesh the stack, refined where contact may end.

        Args:
            stack: the layers.
            indenter: rigid body that presses.
            finest: cell size where contact may end; 1/30 of the largest contact radius when omitted
                [m].
            band: undeformed radii between which contact may end; from 0.7 of the smallest to the
                largest that the indenter allows when omitted [m].
            reach: radius of a frictionless wall around the stack; fourteen largest contact radii or
                thicknesses, whichever is more, when omitted [m].
        """
        self.stack, self.indenter = stack, indenter
        thickness = stack.levels[-1]
        band = band or (0.7 * indenter.rims[0], indenter.rims[1])
        radius = band[1]
        finest = radius / 30.0 if finest is None else finest
        reach = _REACH * max(radius, thickness) if reach is None else reach
        grading = Grading(finest, max(finest, thickness / 4.0), 0.3)
        mesh = _mesh(stack.levels, band, reach, grading)
        heights = mesh.p[1, mesh.t].mean(axis=0)
        law_of_cell = np.searchsorted(stack.levels[1:-1], heights)
        laws = [sheet.law for sheet in stack.sheets]
        self.solid = Solid(mesh, laws, law_of_cell, "axisymmetric", stack.bulk_ratio)
        top = mesh.facets_satisfying(lambda p: np.isclose(p[1], thickness), boundaries_only=True)
        mu = laws[-1].shear_modulus
        self.contact = PenaltyContact.from_facets(
            self.solid, top, indenter, _CONTACT_STIFFNESS * mu / radius, np.zeros(1)
        )
        r, z = self.solid.nodes.T
        self._lines = tuple(_with_middles(np.unique(mesh.p[k])) for k in range(2))
        self._node_numbers, self._corners = (
            tuple(
                np.searchsorted(0.5 * (line[1:] + line[:-1]), at)
                for line, at in zip(self._lines, points, strict=True)
            )
            for points in ((r, z), mesh.p)
        )
        walls = np.flatnonzero((r < 1e-12) | (r > reach - 1e-9))
        base = np.flatnonzero(z < 1e-12)
        self._held: Indices = np.union1d(2 * walls, np.concatenate([2 * base, 2 * base + 1]))
        self._longest = _MAX_STEP * thickness
        self.unknowns: Array = np.zeros(self.solid.unknowns + 1)

    def to_force(self, force: float) -> Indentation:
        """Equilibrium under a force [N]; raises SolidError with the fraction reached otherwise.

        A rising force is followed in steps of depth: where a rough indenter sticks depends on the
        way to the force, and one step leaves 0.7 to 1 % of the depth.
        """
        if not self.contact.force(self.unknowns):
            self.to_depth(self._touching_depth(force))
        self._approach(force)
        start = self.contact.force(self.unknowns)
        held, values = self._held, np.zeros(len(self._held))

        def path(t: float) -> Load:
            forces = np.zeros(len(self.unknowns))
            forces[-1] = start + t * (force - start)
            return Load(held, values, forces)

        return self._settle(path)

    def to_depth(self, depth: float) -> Indentation:
        """Equilibrium at a depth [m]; raises SolidError with the fraction reached otherwise."""
        start = self.unknowns[-1]
        count = max(1, math.ceil(abs(depth - start) / self._longest))
        steps = np.linspace(start, depth, 1 + count)
        for before, after in itertools.pairwise(steps):
            try:
                result = self._load_along_line(before, after)
            except SolidError as error:
                reached = before + error.reached * (after - before)
                raise SolidError(
                    f"the indenter came {reached:.3g} m deep of {depth:g} m: {error}",
                    reached / depth,
                ) from error
        return result

    def _load_along_line(self, before: float, after: float) -> Indentation:
        fixed, none = np.append(self._held, len(self.unknowns) - 1), np.zeros(len(self.unknowns))

        def path(t: float) -> Load:
            values = np.append(np.zeros(len(self._held)), before + t * (after - before))
            return Load(fixed, values, none)

        first = _FIRST_STEP * self.stack.levels[-1] / max(abs(after - before), 1e-12)
        return self._settle(path, 1.0 if before else min(1.0, first))

    def _approach(self, force: float) -> None:
        """Press deeper in steps as long as the force stays below `force` [N]."""
        while self.contact.force(self.unknowns) < force:
            before = self.unknowns, self.contact
            try:
                self.to_depth(float(self.unknowns[-1]) + _STEP_TO_FORCE * self._longest)
            except SolidError:
                reached = math.inf
            else:
                reached = self.contact.force(self.unknowns)
            if reached >= force:
                self.unknowns, self.contact = before
                return

    def _touching_depth(self, force: float) -> float:
        """Depth at which less than `force` acts, estimated as on a half-space [m]."""
        mu = min(sheet.law.shear_modulus for sheet in self.stack.sheets)
        depth = 0.02 * self.stack.levels[-1]
        r = np.linspace(0.0, self.indenter.rims[1], 1001)
        height = self.indenter.profile(r)[0]
        for _ in range(60):
            touched = r[np.flatnonzero(height <= depth)[-1]]
            if 8.0 * mu * touched * depth <= 0.5 * force:
                break
            depth *= 0.7
        return depth

    def _settle(self, path: Callable[[float], Load], first_step: float = 1.0) -> Indentation:
        """Equilibrium at the end of a load path."""
        self.unknowns, (_, contact) = follow(
            (self.solid, self.contact), self.unknowns, path, first_step
        )
        self.contact = cast("PenaltyContact", contact)
        return self._result()

    def _result(self) -> Indentation:
        x, solid = self.unknowns, self.solid
        radii, pressure = self.contact.pressure(x)
        r, z = self._lines
        grid = np.empty((len(r), len(z), 2))
        grid[self._node_numbers] = solid.displacement(x)
        layers = range(len(self.stack.sheets))
        corners = np.full((len(layers), len(r), len(z)), np.nan)
        corners[(slice(None), *self._corners)] = [solid.corner_mean_stress(x, k) for k in layers]
        J = solid.volume_ratio(x) * solid.weights
        return Indentation(
            stack=self.stack,
            force=self.contact.force(x),
            depth=float(x[-1]),
            contact_radius=_contact_radius(radii, pressure),
            radii=radii,
            pressure=pressure,
            r=r,
            z=z,
            displacement=grid,
            mean_stress=corners[:, ::2, ::2],
            energies=solid.shape_energies(x),
            volume_ratios=tuple(
                float(J[cells].sum() / solid.weights[cells].sum()) for cells in solid.cells_of_law
            ),
        )


def _mesh(
    levels: tuple[float, ...], band: tuple[float, float], reach: float, grading: Grading
) -> skfem.MeshQuad:
    count = min(_ATTRACTORS, 2 + int((band[1] - band[0]) / grading.finest))
    r = graded_lines(reach, np.linspace(*band, count), (), grading)
    z = graded_lines(levels[-1], levels[-1:], levels[1:-1], grading)
    return skfem.MeshQuad.init_tensor(r, z)


def _with_middles(lines: Array) -> Array:
    return np.sort(np.concatenate([lines, 0.5 * (lines[1:] + lines[:-1])]))


def _contact_radius(radii: Array, pressure: Array) -> float:
    """Contact radius: between the last point with pressure and the next [m]."""
    last = np.flatnonzero(pressure > 0.0)[-1:]
    return float(radii[last[0] : last[0] + 2].mean()) if len(last) else 0.0
