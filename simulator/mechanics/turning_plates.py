"""Solid between the plates of a clamp, which turn about one axis."""

import math
from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import barycentric_interpolate
from scipy.spatial.transform import Rotation

from eitskin.simulator.mechanics.load_stepping import (
    MIN_STEP,
    ForceTerm,
    LinearSprings,
    Load,
    SolidError,
    follow,
    newton,
)
from eitskin.simulator.mechanics.mixed_solid import Solid

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_NEIGHBOURS = 4  # solved angles that give the first guess of another
_TOLERANCE = 5e-4  # of Newton's last correction; errors of its square are far below the mesh's
_MIN_STEP_DEG = 1.0  # of load stepping, which ends at an angle where the sensor buckles


class TurningPlates:
    """Solid that plates hold and turn by +-theta/2 about an axis along y; other faces are free.

    Equilibria at angles theta are found from those solved before.
    """

    def __init__(
        self,
        solid: Solid,
        plates: Mapping[float, Indices],
        axis: Array,
        fixed: Indices,
        bond: LinearSprings | None = None,
        longest_step_deg: float = math.inf,
    ) -> None:
        """Hold a solid.

        Args:
            solid: the body.
            plates: nodes that move with each plate, by the sign of its turn: 1 for that at large
                x, which positive angles turn downwards, -1 for the other.
            axis: point on the axis, (3,) [m].
            fixed: numbers of all prescribed unknowns.
            bond: springs between the plates and faces that are not prescribed.
            longest_step_deg: step by which load stepping begins [deg].
        """
        self._solid, self._plates, self._axis = solid, plates, axis
        self._fixed, self._bond, self._longest = fixed, bond, longest_step_deg
        self._terms: tuple[ForceTerm, ...] = (solid, bond) if bond else (solid,)
        # Without strain, Newton's relative tolerance has no scale: flat is not solved.
        self._solved = {0.0: np.zeros(solid.unknowns)}

    def equilibrium(self, angle_deg: float) -> Array:
        """Unknowns (n,) of the solid between plates at an angle [deg].

        Raises SolidError, naming the angle reached, where no stable equilibrium is found.
        """
        if angle_deg not in self._solved:
            self._solved[angle_deg] = self._solve_from_neighbours(angle_deg)
        return self._solved[angle_deg]

    def energy(self, angle_deg: float) -> float:
        """Energy stored in solid and bond [J]."""
        x = self.equilibrium(angle_deg)
        bonded = self._bond.energy(self._plate_displacements(angle_deg) - x) if self._bond else 0.0
        return self._solid.energy(x) + bonded

    def moment(self, angle_deg: float) -> float:
        """Derivative of the energy by the angle in radians [N m]."""
        solid, moved = self._solid, self._plate_displacements(angle_deg)
        f = solid.displacement(solid.forces(self.equilibrium(angle_deg)))
        arm = solid.nodes + solid.displacement(moved) - self._axis
        turning = arm[:, 2] * f[:, 0] - arm[:, 0] * f[:, 2]
        return 0.5 * sum(way * float(turning[held].sum()) for way, held in self._plates.items())

    def _solve_from_neighbours(self, angle: float) -> Array:
        """Equilibrium from the polynomial through solved neighbours, or by load stepping."""
        solve = partial(newton, tolerance=_TOLERANCE, chords=True, contraction=1.0)
        near = sorted(self._solved, key=lambda solved: abs(solved - angle))[:_NEIGHBOURS]
        if len(near) > 1:
            guess = barycentric_interpolate(near, [self._solved[one] for one in near], angle)
            if self._solid.admissible(guess):
                try:
                    return solve(self._terms, guess, self._load(angle))
                except SolidError:
                    pass  # load stepping may find a way where the polynomial does not
        before = near[0]
        step = min(1.0, self._longest / abs(angle - before))
        least = max(_MIN_STEP_DEG / abs(angle - before), MIN_STEP)
        path = partial(self._interpolate_load, before, angle)
        try:
            return follow(self._terms, self._solved[before], path, step, solve, min_step=least)[0]
        except SolidError as error:
            reached = before + error.reached * (angle - before)
            raise SolidError(
                f"the clamped sensor was bent to {reached:.1f} deg of {angle:g} deg: {error}",
                error.reached,
            ) from error

    def _interpolate_load(self, before: float, after: float, t: float) -> Load:
        return self._load(before + t * (after - before))

    def _load(self, angle: float) -> Load:
        moved = self._plate_displacements(angle)
        forces = self._bond.forces(moved) if self._bond else np.zeros_like(moved)
        return Load(self._fixed, moved[self._fixed], forces)

    def _plate_displacements(self, angle: float) -> Array:
        """Displacements (unknowns,) by the plates, at the nodes that move with them."""
        moved = np.zeros(self._solid.unknowns)
        displacement = self._solid.displacement(moved)
        for way, held in self._plates.items():
            X = self._solid.nodes[held]
            turn = Rotation.from_rotvec([0.0, 0.5 * way * math.radians(angle), 0.0])
            displacement[held] = turn.apply(X - self._axis) + self._axis - X
        return moved
