"""Where presses are solved in 3D and what comes of it."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Gradients, Points
from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator.mechanics.penalty_contact import PenaltyContact
from eitskin.simulator.mechanics.quadratic_field import QuadraticField
from eitskin.simulator.scene.touch import Touch

Array = NDArray[np.float64]

_SAME = 1e-9  # [m]
_MOST = 4  # touches


@dataclass(frozen=True, slots=True)
class Window:
    """What of one horizontal axis is solved: all of it, or half of it if it mirrors the other.

    Attributes:
        low, high: ends [m].
        cut: whether the sensor goes on there, held, as far from the touches as it is.
        mirrored: whether the half above the middle is solved only.
    """

    low: float
    high: float
    cut: tuple[bool, bool]
    mirrored: bool

    @classmethod
    def around(
        cls, touches: Sequence[Touch], axis: int, ends: tuple[float, float], reach: float
    ) -> "Window":
        """What lies within `reach` of all touches; half of it where they mirror themselves."""
        places = np.array([(touch.x, touch.y) for touch in touches])
        along, across = places[:, axis], places[:, 1 - axis]
        low, high = max(ends[0], along.min() - reach), min(ends[1], along.max() + reach)
        cut = (bool(low > ends[0]), bool(high < ends[1]))
        rest = [(y, t.force, hash(t.indenter)) for y, t in zip(across, touches, strict=True)]
        from_middle = (along - 0.5 * (low + high)).round(9)
        one = sorted(zip(from_middle, rest, strict=True))
        other = sorted(zip(-from_middle, rest, strict=True))
        return cls(float(low), float(high), cut, cut[0] == cut[1] and one == other)

    @property
    def origin(self) -> float:
        """Where the solved part starts [m]."""
        return 0.5 * (self.low + self.high) if self.mirrored else self.low

    @property
    def extent(self) -> float:
        """Length of the solved part [m]."""
        return self.high - self.origin

    def local(self, x: Array) -> tuple[Array, Array]:
        """Places from the origin [m], and the signs by which they have been mirrored."""
        from_origin = x - self.origin
        side = np.where(self.mirrored & (from_origin < 0.0), -1.0, 1.0)
        return side * from_origin, side


def check_places(outline: Rectangle, touches: Sequence[Touch]) -> None:
    """Raise ConfigurationError unless one to four touches lie on the sensor, side by side."""
    if not 1 <= len(touches) <= _MOST:
        raise ConfigurationError(f"one to {_MOST} touches can be solved, got {len(touches)}")
    for touch in touches:
        if not outline.contains(np.array([touch.x, touch.y])):
            raise ConfigurationError(
                f"a touch must lie on the sensor of {outline.length:g} x {outline.width:g} m, got "
                f"({touch.x:g}, {touch.y:g}) m; are the units metres?"
            )
        if touch.depth is not None or touch.held is not None:
            raise ConfigurationError(
                "touches are solved for their force at their first moment, got depth="
                f"{touch.depth} m and held={touch.held} s; leave both out"
            )
    for a, b in itertools.combinations(touches, 2):
        apart, least = math.hypot(a.x - b.x, a.y - b.y), a.indenter.rims[1] + b.indenter.rims[1]
        if apart < least - _SAME:
            raise ConfigurationError(
                f"indenters must not overlap: touches {apart:g} m apart need at least {least:g} m"
            )


@dataclass(frozen=True, slots=True, eq=False)
class DentedStack:
    """An equilibrium of a pressed stack: a Deformation of the gel and what encapsulates it.

    Attributes:
        displacement: of the solved part, from the origin of its windows, at heights over the
            lower face of the gel [m].
        windows: what is solved along x and y; beyond, nothing moves.
        sensor: least and largest x, y and z of the encapsulated sensor, (2, 3) [m].
        forces: on each indenter [N].
        depths: of their lowest points under the undeformed top [m].
        contact_areas: of the deformed face [m2].
        peak_pressures: on the deformed face, at the quadrature points [Pa].
        thinnings: 1 - thickness over undeformed thickness of the gel on the axis of each.
        volume_ratio: deformed over undeformed volume of the gel that is solved.
        energy: stored in all, and in the springs that stand for the contacts [J].
        base_force: vertical, on the base and where the sensor goes on [N].
    """

    displacement: QuadraticField
    windows: tuple[Window, Window]
    sensor: Array
    forces: Array
    depths: Array
    contact_areas: Array
    peak_pressures: Array
    thinnings: Array
    volume_ratio: float
    energy: float
    base_force: float

    @property
    def mean_pressures(self) -> Array:
        """Force over area of contact [Pa]."""
        return self.forces / self.contact_areas

    def positions(self, points: Points) -> Points:
        """Deformed positions [m], (..., 3), of flat points [m], (..., 3)."""
        place, sides, solved = self._solved(points)
        moved = sides * self.displacement(place)
        return points + np.where(solved[..., None], moved, 0.0)

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3); it jumps between cells of the mesh, slightly."""
        place, sides, solved = self._solved(points)
        slope = sides[..., :, None] * self.displacement.derivative(place) * sides[..., None, :]
        F: Gradients = np.eye(3) + np.where(solved[..., None, None], slope, 0.0)
        return F

    def _solved(self, points: Points) -> tuple[Points, Array, NDArray[np.bool_]]:
        """Points in the solved part, the signs of mirroring, and which of them lie in it."""
        x = np.array(points, dtype=float)
        outside = np.any((x < self.sensor[0] - _SAME) | (x > self.sensor[1] + _SAME), axis=-1)
        if np.any(outside):
            raise ConfigurationError(
                f"{int(outside.sum())} of {outside.size} points lie outside the pressed sensor, "
                f"which reaches from {self.sensor[0]} to {self.sensor[1]} m"
            )
        sides, solved = np.ones_like(x), np.ones(x.shape[:-1], dtype=bool)
        for axis, window in enumerate(self.windows):
            solved &= (x[..., axis] >= window.low) & (x[..., axis] <= window.high)
            x[..., axis], sides[..., axis] = window.local(x[..., axis])
        return x, sides, solved


def touched(contact: PenaltyContact, x: Array) -> tuple[float, float]:
    """Deformed area of a face in contact [m2] and largest pressure on it [Pa]."""
    u = x[contact.numbers[:, :-1]].reshape(len(contact.numbers), -1, 3)
    F = np.eye(3) + np.einsum("fai,fqaJ->fqiJ", u, contact.slopes)
    area_ratio = np.linalg.norm(np.cross(F[..., 0], F[..., 1]), axis=-1)
    q = contact.nominal_pressure(x)
    area = np.sum((q > 0.0) * contact.weights * area_ratio)
    return float(area), float((q / area_ratio).max())
