"""Hyperelastic laws: isochoric energy, first Piola-Kirchhoff stress and tangent.

Deformation gradients F and first Piola-Kirchhoff stresses P = dW/dF are (..., 3, 3), tangents
dP/dF (..., 9, 9) between their entries by rows, or between some of these only. Volume changes are
left to a pressure (`mixed_solid`), so every energy here depends on J^(-1/3) F alone.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from eitskin.bounds import require_positive
from eitskin.errors import ConfigurationError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

ENTRIES = tuple(range(9))  # of a 3 x 3 matrix, by rows
_OTHERS = ((1, 2), (2, 0), (0, 1))


class Law(ABC):
    """Isotropic hyperelastic law W = 2 mu/alpha^2 (J^(-alpha/3) T - 3).

    T(F) is homogeneous of degree alpha in F.
    """

    __slots__ = ()

    if TYPE_CHECKING:  # fields or constants; a property here would be the default of a field

        @property
        def shear_modulus(self) -> float:
            """Shear modulus mu of the undeformed material [Pa]."""

        @property
        def alpha(self) -> float:
            """Degree of T."""

    @abstractmethod
    def invariant(self, F: Array) -> tuple[Array, Array]:
        """T, (...), and its slope dT/dF / alpha, (..., 3, 3)."""

    @abstractmethod
    def curvature(self, F: Array, entries: Indices) -> Array:
        """Derivative of the slope between the given entries, (..., entries, entries)."""

    def energy(self, F: Array) -> Array:
        """Energy per undeformed volume [J/m3], (...)."""
        scaled = determinant(F, cofactor(F)) ** (-self.alpha / 3) * self.invariant(F)[0]
        W: Array = 2.0 * self.shear_modulus / self.alpha**2 * (scaled - 3.0)
        return W

    def stress(self, F: Array) -> Array:
        """First Piola-Kirchhoff stress P = dW/dF [Pa], (..., 3, 3)."""
        T, slope = self.invariant(F)
        H = cofactor(F)
        J = determinant(F, H)
        hydrostatic = (T / (3.0 * J))[..., None, None] * H
        P: Array = self._factor(J)[..., None, None] * (slope - hydrostatic)
        return P

    def tangent(self, F: Array, entries: Sequence[int] = ENTRIES) -> Array:
        """Tangent dP/dF [Pa] between the given entries, (..., entries, entries)."""
        numbers = np.array(entries)
        i, j = np.divmod(numbers, 3)
        T, slope = self.invariant(F)
        H = cofactor(F)
        J = determinant(F, H)[..., None, None]
        H /= J  # F^-T
        third = T[..., None, None] / 3
        crossed = H[..., i[:, None], j]  # H_iL; H_kJ is its transpose
        h, slope = H[..., i, j], slope[..., i, j]
        deviator = slope - third[..., 0] * h
        outer = deviator[..., :, None] * h[..., None, :] + h[..., :, None] * slope[..., None, :]
        A: Array = third * crossed * crossed.swapaxes(-1, -2) + self.curvature(F, numbers)
        A -= (self.alpha / 3) * outer
        A *= self._factor(J)
        return A

    def _factor(self, J: Array) -> Array:
        factor: Array = 2.0 * self.shear_modulus / self.alpha * J ** (-self.alpha / 3)
        return factor


@dataclass(frozen=True, slots=True)
class NeoHookean(Law):
    """Neo-Hookean law W = mu/2 (J^(-2/3) tr C - 3) with C = F^T F.

    Attributes:
        shear_modulus: mu [Pa].
    """

    shear_modulus: float

    def __post_init__(self) -> None:
        require_positive("shear_modulus", self.shear_modulus, "Pa")

    @property
    def alpha(self) -> float:
        """Degree of the invariant."""
        return 2.0

    def invariant(self, F: Array) -> tuple[Array, Array]:
        return np.asarray(np.einsum("...ij,...ij->...", F, F)), F

    def curvature(self, F: Array, entries: Indices) -> Array:  # noqa: ARG002
        return np.eye(len(entries))


@dataclass(frozen=True, slots=True)
class Ogden(Law):
    """One-term Ogden law W = 2 mu/alpha^2 (sum_i lambda_i^alpha - 3).

    The lambda_i are the principal stretches of J^(-1/3) F.

    Attributes:
        shear_modulus: mu of the undeformed material [Pa]. A coefficient mu_1 of W = mu_1/alpha
            (sum_i lambda_i^alpha - 3), as often tabulated (Ogden 1972), is 2 mu/alpha.
        alpha: exponent, not zero; 2 is neo-Hookean.
    """

    shear_modulus: float
    alpha: float

    def __post_init__(self) -> None:
        """Check the modulus and the exponent."""
        require_positive("shear_modulus", self.shear_modulus, "Pa")
        if not math.isfinite(self.alpha) or self.alpha == 0.0:
            raise ConfigurationError(
                f"the Ogden exponent alpha must be finite and not zero, got {self.alpha}"
            )

    def invariant(self, F: Array) -> tuple[Array, Array]:
        squares, axes = _principal(F)
        powers = squares ** (self.alpha / 2 - 1.0)
        slope: Array = ((F @ axes) * powers[..., None, :]) @ np.swapaxes(axes, -1, -2)
        return np.asarray((powers * squares).sum(axis=-1)), slope

    def curvature(self, F: Array, entries: Indices) -> Array:
        squares, axes = _principal(F)
        beta = self.alpha / 2 - 1.0
        B = np.einsum("...La,...a,...Ja->...LJ", axes, squares**beta, axes)
        # The derivative of C^beta in principal axes (Daleckii and Krein 1965).
        f = F @ axes
        i, j = np.divmod(entries, 3)
        shape = (*F.shape[:-2], len(entries))
        across = f[..., i, :, None] * axes[..., j, None, :]  # (..., entries, a, b)
        left_factor = across * _divided_difference(squares, beta)[..., None, :, :]
        right = across + across.swapaxes(-1, -2)
        tensor = left_factor.reshape(*shape, 9) @ right.reshape(*shape, 9).swapaxes(-1, -2)
        tensor += np.equal.outer(i, i) * B[..., j[:, None], j]
        curvature: Array = tensor
        return curvature


def cofactor(F: Array) -> Array:
    """Cofactor dJ/dF = J F^-T, (..., 3, 3)."""
    H = np.empty_like(F)
    for i, (k, m) in enumerate(_OTHERS):
        for j, (n, o) in enumerate(_OTHERS):
            H[..., i, j] = F[..., k, n] * F[..., m, o] - F[..., k, o] * F[..., m, n]
    return H


def determinant(F: Array, H: Array) -> Array:
    """Determinant J = det F from F and its cofactor H, (...)."""
    J: Array = np.einsum("...J,...J->...", F[..., 0, :], H[..., 0, :])
    return J


def _principal(F: Array) -> tuple[Array, Array]:
    """Squared stretches (..., 3) and principal axes in columns (..., 3, 3)."""
    squares, axes = np.linalg.eigh(np.swapaxes(F, -1, -2) @ F)
    return np.asarray(squares), np.asarray(axes)


def _divided_difference(x: Array, power: float) -> Array:
    """Divided difference (x_a^p - x_b^p) / (x_a - x_b), or its limit, (..., 3, 3)."""
    a, b = x[..., :, None], x[..., None, :]
    log_ratio = np.log1p((a - b) / b)
    equal = log_ratio == 0.0
    safe = np.where(equal, 1.0, log_ratio)
    quotient = np.where(equal, power, np.expm1(power * safe) / np.expm1(safe))
    difference: Array = b ** (power - 1.0) * quotient
    return difference
