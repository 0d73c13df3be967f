"""How points of the flat sensor move: what every deformation offers, and composition."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

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


def pulled_back(gradients: Gradients) -> Gradients:
    """J F^-1 F^-T, (..., 3, 3): unit conductivity of the deformed body, seen in the flat one.

    Written as adj(C) / J with C = F^T F, which needs no inverse. Source: Kohn et al. 2008
    (change of variables in the conductivity equation).
    """
    F = np.moveaxis(gradients, -1, 0)  # F[i] is column i, (..., 3)
    normals = np.stack([np.cross(F[1], F[2]), np.cross(F[2], F[0]), np.cross(F[0], F[1])])
    J = np.einsum("...i,...i->...", F[0], normals[0])
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
