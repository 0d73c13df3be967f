"""Kinematics: deformation map, composition, pull-back of conductivity, area ratio."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError

Points = NDArray[np.float64]
Gradients = NDArray[np.float64]

# Entries xx, yy, zz, xy, xz, yz of a symmetric tensor, and where each of its 3 x 3 is among these.
TENSOR_ROWS = np.array([0, 1, 2, 0, 0, 1])
TENSOR_COLUMNS = np.array([0, 1, 2, 1, 2, 2])
WHOLE_TENSOR = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])


class Deformation(ABC):
    """Map from points of the flat sensor to their deformed positions."""

    __slots__ = ()

    @abstractmethod
    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Deformed positions x [m], (..., 3), and gradients F = dx/dX, (..., 3, 3).

        At flat points X [m], (..., 3).
        """

    def map_deformed(self, places: Points, gradients: Gradients) -> tuple[Points, Gradients]:
        """Positions and gradients of points that another deformation moved to places (..., 3) [m].

        By the chain rule F = F_own(places) F, from gradients F (..., 3, 3) so far.
        """
        positions, outer = self.map_points(places)
        outer, inner = _entries(outer), _entries(gradients)
        F = np.asarray(sum(outer[:, j, None] * inner[j] for j in range(3)))
        return positions, np.moveaxis(F, (0, 1), (-2, -1))

    def positions(self, points: Points) -> Points:
        """Deformed positions [m], (..., 3), of flat points [m], (..., 3)."""
        return self.map_points(points)[0]

    def gradient(self, points: Points) -> Gradients:
        """Deformation gradient F = dx/dX, (..., 3, 3), at flat points [m], (..., 3)."""
        return self.map_points(points)[1]


@dataclass(frozen=True, slots=True)
class Composition(Deformation):
    """Composition of two deformations; F = F_second(x_first) F_first."""

    first: Deformation
    second: Deformation

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and gradient by the chain rule."""
        return self.second.map_deformed(*self.first.map_points(points))


@dataclass(frozen=True, slots=True)
class Displaced(Deformation):
    """Deformation by a displacement field, given as a function of the flat points.

    Attributes:
        displacement: u(x) [m], (..., 3), of flat points (..., 3) [m].
        derivative: du/dx, (..., 3, 3); central differences of `displacement` when omitted.
        step: step of those differences [m]; they are exact to about (step / size)^2.
    """

    displacement: Callable[[Points], Points]
    derivative: Callable[[Points], Gradients] | None = None
    step: float = 1e-6

    def map_points(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and gradient; raises ConfigurationError where the body is inside out."""
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
        return points + self.displacement(points), F


def largest_strain(deformation: Deformation | None, points: Points) -> NDArray[np.float64]:
    """Largest principal logarithmic strain at `points` (n, 3) [m] of the flat sensor, (n,).

    The logarithm of the largest principal stretch (Hencky 1928) is positive wherever an
    incompressible body deforms, because at least one fibre is stretched.
    """
    if deformation is None:
        return np.zeros(len(points))
    F = deformation.gradient(points)
    squares = np.linalg.eigvalsh(np.swapaxes(F, -1, -2) @ F)
    return np.asarray(0.5 * np.log(squares[:, -1]))


def pulled_back_entries(gradients: Gradients) -> NDArray[np.float64]:
    """Pull-back J F^-1 F^-T of a unit conductivity to the flat body, (..., 6).

    Entries xx, yy, zz, xy, xz and yz, computed as adj(C) / J with C = F^T F, without an inverse.
    Source: Kohn et al. 2008 (change of variables in the conductivity equation).

    Raises ConfigurationError where det F is not positive.
    """
    F, n = _entries(gradients), _cofactors(gradients)
    J = F[0, 0] * n[0, 0] + F[1, 0] * n[1, 0] + F[2, 0] * n[2, 0]
    negative = int((~(J > 0.0)).sum())
    if negative:
        raise ConfigurationError(
            "the deformation turns the body inside out or is not a number at "
            f"{negative} of {J.size} points; press or bend less, or presses further from the edge "
            "and from each other"
        )
    # The columns of the cofactors are the rows of J F^-1; their Gram matrix is adj(C).
    S, inverse = np.empty((6, *J.shape)), 1.0 / J
    for entry, (i, j) in enumerate(zip(TENSOR_ROWS, TENSOR_COLUMNS, strict=True)):
        S[entry] = (n[0, i] * n[0, j] + n[1, i] * n[1, j] + n[2, i] * n[2, j]) * inverse
    return np.moveaxis(S, 0, -1)


def area_ratio(gradients: Gradients, normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Area ratio |J F^-T N|, deformed over flat, of a surface with unit normals N (..., 3), (...).

    Source: Nanson's formula.
    """
    turned = np.einsum("ij...,...j->i...", _cofactors(gradients), normals)
    return np.asarray(np.sqrt(np.einsum("i...,i...->...", turned, turned)))


def _entries(gradients: Gradients) -> Gradients:
    """F with its indices first, (3, 3, ...)."""
    return np.ascontiguousarray(np.moveaxis(gradients, (-2, -1), (0, 1)))


def _cofactors(gradients: Gradients) -> Gradients:
    """J F^-T with its indices first, (3, 3, ...)."""
    F = _entries(gradients)
    cofactors = np.empty_like(F)
    for i in range(3):
        for j in range(3):
            k, m, p, q = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            cofactors[i, j] = F[k, p] * F[m, q] - F[k, q] * F[m, p]
    return cofactors
