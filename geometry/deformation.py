"""How points of the flat sensor move: what every deformation offers, and composition."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.errors import ConfigurationError

Points = NDArray[np.float64]
Gradients = NDArray[np.float64]


class Deformation(Protocol):
    """A map from points of the flat sensor to their deformed places."""

    def positions(self, points: Points) -> Points:
        """Deformed places [m], (..., 3), of flat points [m], (..., 3)."""
        ...

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient F = dx/dX, (..., 3, 3), at flat points [m], (..., 3)."""
        ...


@dataclass(frozen=True, slots=True)
class Composed:
    """One deformation after another; F = F_second(x_first) F_first."""

    first: Deformation
    second: Deformation

    def positions(self, points: Points) -> Points:
        """Deformed places [m], (..., 3)."""
        return self.second.positions(self.first.positions(points))

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3), by the chain rule."""
        outer = self.second.gradient(self.first.positions(points))
        F: Gradients = np.matmul(outer, self.first.gradient(points))
        return F


@dataclass(frozen=True, slots=True)
class Displaced:
    """Any displacement given as a function of the flat points.

    Attributes:
        displacement: u(x) [m], (..., 3), of flat points (..., 3) [m].
        derivative: du/dx, (..., 3, 3); central differences of `displacement` when omitted.
        step: of those differences [m]; they are exact to about (step / size)^2.
    """

    displacement: Callable[[Points], Points]
    derivative: Callable[[Points], Gradients] | None = None
    step: float = 1e-6

    def positions(self, points: Points) -> Points:
        """Deformed places [m], (..., 3)."""
        return points + self.displacement(points)

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient, (..., 3, 3).

        Raises ConfigurationError where the displacement turns the body inside out.
        """
        if self.derivative is not None:
            slope = self.derivative(points)
        else:
            steps = self.step * np.eye(3)
            ends = [self.displacement(points + e) - self.displacement(points - e) for e in steps]
            slope = np.stack(ends, axis=-1) / (2.0 * self.step)
        F: Gradients = np.eye(3) + slope
        J = np.linalg.det(F)
        if not np.all(J > 0.0):
            raise ConfigurationError(
                "the displacement turns the body inside out or is not a number at "
                f"{int((~(J > 0.0)).sum())} of {J.size} points; make it smaller or smoother"
            )
        return F


def pulled_back(gradients: Gradients) -> Gradients:
    """J F^-1 F^-T, (..., 3, 3): unit conductivity of the deformed body, seen in the flat one.

    Written as adj(C) / J with C = F^T F, which needs no inverse. Source: Kohn et al. 2008
    (change of variables in the conductivity equation).

    Raises ConfigurationError where the body is inside out.
    """
    F = np.moveaxis(gradients, -1, 0)  # F[i] is column i, (..., 3)
    normals = np.stack([np.cross(F[1], F[2]), np.cross(F[2], F[0]), np.cross(F[0], F[1])])
    J = np.einsum("...i,...i->...", F[0], normals[0])
    if not np.all(J > 0.0):
        raise ConfigurationError(
            "the deformation turns the body inside out or is not a number at "
            f"{int((~(J > 0.0)).sum())} of {J.size} points; press or bend less, or presses further "
            "from the edge and from each other"
        )
    # The rows of J F^-1 are the cross products of the columns of F; their Gram matrix is adj(C).
    S: Gradients = np.einsum("i...k,j...k->...ij", normals, normals) / J[..., None, None]
    return S


def area_ratio(gradients: Gradients, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """|J F^-T N|, (...): deformed over flat area of a surface with unit normals N (..., 3).

    Source: Nanson's formula.
    """
    F = np.moveaxis(gradients, -1, 0)
    N = np.moveaxis(normals, -1, 0)[..., None]
    cofactor = np.cross(F[1], F[2]) * N[0]
    cofactor += np.cross(F[2], F[0]) * N[1] + np.cross(F[0], F[1]) * N[2]
    ratio: NDArray[np.float64] = np.linalg.norm(cofactor, axis=-1)
    return ratio
