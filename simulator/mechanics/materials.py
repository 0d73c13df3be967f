"""Hyperelastic laws: isochoric energy, first Piola-Kirchhoff stress and tangent.

Deformation gradients F and first Piola-Kirchhoff stresses P = dW/dF are (..., 3, 3), tangents
dP/dF (..., 9, 9) between their entries by rows, or between some of these only. Volume changes are
left to a pressure (`mixed_solid`), so every energy here depends on J^(-1/3) F alone.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError

Array = NDArray[np.float64]

ENTRIES = tuple(range(9))  # of a 3 x 3 matrix, by rows
_OTHERS = ((1, 2), (2, 0), (0, 1))


class Law(Protocol):
    """Isotropic hyperelastic law."""

    @property
    def shear_modulus(self) -> float:
        """Shear modulus mu of the undeformed material [Pa]."""
        ...

    def energy(self, F: Array) -> Array:
        """Energy per undeformed volume [J/m3], (...)."""
        ...

    def stress(self, F: Array) -> Array:
        """First Piola-Kirchhoff stress P = dW/dF [Pa], (..., 3, 3)."""
        ...

    def tangent(self, F: Array, entries: Sequence[int] = ENTRIES) -> Array:
        """Tangent dP/dF [Pa] between the given entries, (..., entries, entries)."""
        ...


@dataclass(frozen=True, slots=True)
class NeoHookean:
    """Neo-Hookean law W = mu/2 (J^(-2/3) tr C - 3) with C = F^T F.

    Attributes:
        shear_modulus: mu [Pa].
    """

    shear_modulus: float

    def __post_init__(self) -> None:
        _check_modulus(self.shear_modulus)

    def energy(self, F: Array) -> Array:
        """Energy per undeformed volume [J/m3], (...)."""
        return _energy(self.shear_modulus, 2.0, F, _trace(F))

    def stress(self, F: Array) -> Array:
        """First Piola-Kirchhoff stress P = dW/dF [Pa], (..., 3, 3)."""
        return _stress(self.shear_modulus, 2.0, F, _trace(F), F)

    def tangent(self, F: Array, entries: Sequence[int] = ENTRIES) -> Array:
        """Tangent dP/dF [Pa] between the given entries, (..., entries, entries)."""
        identity = np.eye(len(entries))
        return _tangent(self.shear_modulus, 2.0, F, _trace(F), F, identity, entries)


@dataclass(frozen=True, slots=True)
class Ogden:
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
        _check_modulus(self.shear_modulus)
        if not math.isfinite(self.alpha) or self.alpha == 0.0:
            raise ConfigurationError(
                f"the Ogden exponent alpha must be finite and not zero, got {self.alpha}"
            )

    def energy(self, F: Array) -> Array:
        """Energy per undeformed volume [J/m3], (...)."""
        squares, _ = _principal(F)
        power = np.asarray((squares ** (self.alpha / 2)).sum(axis=-1))
        return _energy(self.shear_modulus, self.alpha, F, power)

    def stress(self, F: Array) -> Array:
        """First Piola-Kirchhoff stress P = dW/dF [Pa], (..., 3, 3)."""
        squares, axes = _principal(F)
        power = np.asarray((squares ** (self.alpha / 2)).sum(axis=-1))
        return _stress(self.shear_modulus, self.alpha, F, power, self._slope(F, squares, axes))

    def tangent(self, F: Array, entries: Sequence[int] = ENTRIES) -> Array:
        """Tangent dP/dF [Pa] between the given entries, (..., entries, entries)."""
        squares, axes = _principal(F)
        beta = self.alpha / 2 - 1.0
        power = np.asarray((squares ** (self.alpha / 2)).sum(axis=-1))
        B = np.einsum("...La,...a,...Ja->...LJ", axes, squares**beta, axes)
        # The derivative of C^beta in principal axes (Daleckii and Krein 1965).
        f = F @ axes
        i, j = np.divmod(entries, 3)
        shape = (*F.shape[:-2], len(entries))
        across = f[..., i, :, None] * axes[..., j, None, :]  # (..., entries, a, b)
        left = across * _divided_difference(squares, beta)[..., None, :, :]
        right = across + across.swapaxes(-1, -2)
        curvature = left.reshape(*shape, 9) @ right.reshape(*shape, 9).swapaxes(-1, -2)
        curvature += np.equal.outer(i, i) * B[..., j[:, None], j]
        slope = self._slope(F, squares, axes)
        return _tangent(self.shear_modulus, self.alpha, F, power, slope, curvature, entries)

    def _slope(self, F: Array, squares: Array, axes: Array) -> Array:
        """Slope F C^(alpha/2 - 1), (..., 3, 3)."""
        M: Array = ((F @ axes) * squares[..., None, :] ** (self.alpha / 2 - 1.0)) @ np.swapaxes(
            axes, -1, -2
        )
        return M


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


def _check_modulus(mu: float) -> None:
    if not (math.isfinite(mu) and mu > 0):
        raise ConfigurationError(f"shear_modulus must be a positive number of Pa, got {mu}")


def _trace(F: Array) -> Array:
    trace: Array = np.einsum("...ij,...ij->...", F, F)
    return trace


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


# All laws here are W = 2 mu/alpha^2 (J^(-alpha/3) T - 3) with T(F) homogeneous of degree alpha;
# `slope` is dT/dF / alpha and `curvature` its derivative, H = F^-T.


def _energy(mu: float, alpha: float, F: Array, T: Array) -> Array:
    scaled = determinant(F, cofactor(F)) ** (-alpha / 3) * T
    W: Array = 2.0 * mu / alpha**2 * (scaled - 3.0)
    return W


def _stress(mu: float, alpha: float, F: Array, T: Array, slope: Array) -> Array:
    H = cofactor(F)
    J = determinant(F, H)
    hydrostatic = (T / (3.0 * J))[..., None, None] * H
    P: Array = (2.0 * mu / alpha * J ** (-alpha / 3))[..., None, None] * (slope - hydrostatic)
    return P


def _tangent(
    mu: float,
    alpha: float,
    F: Array,
    T: Array,
    slope: Array,
    curvature: Array,
    entries: Sequence[int],
) -> Array:
    i, j = np.divmod(entries, 3)
    H = cofactor(F)
    J = determinant(F, H)[..., None, None]
    H /= J
    third = T[..., None, None] / 3
    crossed = H[..., i[:, None], j]  # H_iL; H_kJ is its transpose
    h, slope = H[..., i, j], slope[..., i, j]
    deviator = slope - third[..., 0] * h
    outer = deviator[..., :, None] * h[..., None, :] + h[..., :, None] * slope[..., None, :]
    A: Array = third * crossed * crossed.swapaxes(-1, -2) + curvature - (alpha / 3) * outer
    A *= 2.0 * mu / alpha * J ** (-alpha / 3)
    return A
