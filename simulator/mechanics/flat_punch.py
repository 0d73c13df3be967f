"""Flat rigid punch of any footprint on a stack of bonded layers, for small depths.

The layers are incompressible and linear. Under tractions exp(i k x) on the upper face a layer moves
along k and upwards as

    w = (a + b k z) exp(k z) + (c + d k z) exp(-k z),   u = i w' / k,

with the pressure p = 2 mu k (b exp(k z) + d exp(-k z)), and across k as e exp(k z) + f exp(-k z).
Interfaces, base and upper face give the six factors of each layer, so that tractions on a periodic
plane and motion follow from each other by the fast Fourier transform. The tractions under a punch
are found by conjugate gradients on the pixels of its footprint (Stanley and Kato 1997).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from eitskin.simulator.mechanics.layer_stack import Stack

Array = NDArray[np.float64]

_WAVES, _LONGEST = 120, 0.02  # wave numbers that are solved, the least of them times the thickness
_TOLERANCE, _ITERATIONS = 1e-5, 400  # of the displacement under the punch
_RELEASES, _PULLED = 40, 0.02  # searches for the contact, and pull over the mean pressure
_RIM, _LEAST_COVERED = 0.12, 0.1
_U, _W, _V, _P = 0, 1, 2, 6  # rows of `_layer_functions`


class PunchTractions(NamedTuple):
    """Tractions under a punch that presses with 1 N, and its depth under the force.

    Attributes:
        tractions: tractions on the face along x, y and z, (3, n, n) [Pa/N].
        compliance: depth over force [m/N].
    """

    tractions: Array
    compliance: float


class LayeredFace:
    """Upper face of a stack on a periodic square of pixels, and the linear response of the stack.

    Attributes:
        x: middles of the pixels along both axes, (n,) [m].
        size: edge of a pixel [m].
    """

    def __init__(self, stack: Stack, half: float, size: float) -> None:
        """Solve the layers on a square from -half to half [m] of pixels of a size [m]."""
        count = 2 * int(np.ceil(half / size))
        self.size = size
        self.x: Array = size * (np.arange(count, dtype=np.float64) - 0.5 * (count - 1))
        kx = 2.0 * np.pi * np.fft.fftfreq(count, size)[:, None]
        ky = 2.0 * np.pi * np.fft.rfftfreq(count, size)[None, :]
        k = np.hypot(kx, ky)
        self._cos = np.divide(kx, k, out=np.ones_like(k), where=k > 0.0)
        self._sin = np.divide(ky, k, out=np.zeros_like(k), where=k > 0.0)
        self._waves = np.geomspace(_LONGEST / stack.levels[-1], k.max(), _WAVES)
        self._log_k = np.log(np.maximum(k, self._waves[0]))
        self._stack, self._factors = stack, _factors(stack, self._waves)
        self._top = self._response(stack.levels[-1])

    def motion(self, tractions: Array, height: float | None = None) -> Array:
        """Displacement [m] and mean stress [Pa], (4, n, n), by tractions (3, n, n) [Pa].

        At a height over the base [m]; at the upper face when omitted.
        """
        response = self._top if height is None else self._response(height)
        x, y, normal = np.fft.rfft2(tractions)
        c, s = self._cos, self._sin
        along, across = c * x + s * y, c * y - s * x
        u = response[..., _U, 0] * along + 1j * response[..., _U, 1] * normal
        w = -1j * response[..., _W, 0] * along + response[..., _W, 1] * normal
        v = response[..., _V, 2] * across
        p = 1j * response[..., 3, 0] * along - response[..., 3, 1] * normal
        moved = np.stack([c * u - s * v, s * u + c * v, w, p])
        return np.asarray(np.fft.irfft2(moved, s=tractions.shape[1:]))

    def solve_punch(self, coverage: Array, rough: bool) -> PunchTractions:
        """Tractions under a punch whose force acts at the origin.

        A force off the middle tilts the punch; pixels that would be pulled leave the contact.

        Args:
            coverage: part of each pixel that the footprint covers, (n, n).
            rough: whether the punch sticks to the face.
        """
        x, y = np.meshgrid(self.x, self.x, indexing="ij")
        modes = np.stack([np.ones_like(x), x, y])
        held = coverage * (coverage > _LEAST_COVERED)
        for _ in range(_RELEASES):
            solved = np.stack([self._mode_tractions(held, mode, rough) for mode in modes])
            # Force and moments about the origin by depth and tilts: only a force of 1 N acts.
            loads = -(self.size**2) * np.einsum("ixy,jxy->ij", modes, solved[:, 2])
            amounts = np.linalg.solve(loads, [1.0, 0.0, 0.0])
            tractions = np.tensordot(amounts, solved, axes=1)
            pull = tractions[2] > _PULLED / (self.size**2 * coverage.sum())
            if not pull.any():
                break
            held[pull] = 0.0
        return PunchTractions(tractions, float(amounts[0]))

    def _mode_tractions(self, held: Array, mode: Array, rough: bool) -> Array:
        """Tractions (3, n, n) [Pa] that displace the held pixels downwards by a mode (n, n) [m].

        Pixels at the rim, which the footprint covers in part, give way by their tractions.
        """
        inside = held > 0.0
        weights = np.stack([inside * rough, inside * rough, inside]).astype(np.float64)
        rim = np.divide(1.0 - held, held, out=np.zeros_like(held), where=inside)
        giving = _RIM * self.size / self._stack.sheets[-1].law.shear_modulus * rim

        def response(tractions: Array) -> Array:
            moved: Array = weights * (self.motion(tractions)[:3] + giving * tractions)
            return moved

        zero = np.zeros_like(mode)
        return _conjugate_gradients(response, -weights * np.stack([zero, zero, mode]))

    def _response(self, z: float) -> Array:
        """Rows u, w, v and p by tractions along k, upwards and across, (n, n / 2 + 1, 4, 3)."""
        stack, k = self._stack, self._waves
        layer = int(np.clip(np.searchsorted(stack.levels, z) - 1, 0, len(stack.sheets) - 1))
        functions = _layer_functions(stack, layer, k, z)[:, [_U, _W, _V, _P]]
        own = self._factors[:, 6 * layer : 6 * layer + 6]
        return np.asarray(CubicSpline(np.log(k), functions @ own)(self._log_k))


def _factors(stack: Stack, k: Array) -> Array:
    """Factors of the functions of all layers by tractions on the upper face, (k, 6 layers, 3)."""
    count, levels = len(stack.sheets), stack.levels
    A = np.zeros((len(k), 6 * count, 6 * count))
    A[:, :3, :6] = _layer_functions(stack, 0, k, 0.0)[:, :3]
    for layer in range(count):
        own, rows = slice(6 * layer, 6 * layer + 6), slice(6 * layer + 3, 6 * layer + 9)
        upper = _layer_functions(stack, layer, k, levels[layer + 1])
        if layer + 1 == count:
            A[:, -3:, own] = upper[:, 3:6]
            break
        A[:, rows, own] = upper[:, :6]
        A[:, rows, 6 * layer + 6 : 6 * layer + 12] = -_layer_functions(
            stack, layer + 1, k, levels[layer + 1]
        )[:, :6]
    given = np.zeros((6 * count, 3))
    given[-3:] = np.eye(3)
    return np.asarray(np.linalg.solve(A, np.broadcast_to(given, (len(k), *given.shape))))


def _layer_functions(stack: Stack, layer: int, k: Array, z: float) -> Array:
    """Functions of one layer at a height over the base [m], (k, 7, 6).

    Rows are displacements along k, upwards and across, tractions on a level plane likewise [Pa],
    and pressure [Pa]. Without factors i along k, the other rows are real.
    """
    mu = stack.sheets[layer].law.shear_modulus
    low, high = stack.levels[layer : layer + 2]
    s, r = k * (z - high), k * (z - low)
    up, down, none = np.exp(s), np.exp(-r), np.zeros_like(k)
    rows = [
        [up, (1.0 + s) * up, -down, (1.0 - r) * down, none, none],
        [up, s * up, down, r * down, none, none],
        [none, none, none, none, up, down],
        [2.0 * up, 2.0 * (1.0 + s) * up, 2.0 * down, 2.0 * (r - 1.0) * down, none, none],
        [2.0 * up, 2.0 * s * up, -2.0 * down, -2.0 * r * down, none, none],
        [none, none, none, none, up, -down],
        [none, 2.0 * up, none, 2.0 * down, none, none],
    ]
    functions = np.moveaxis(np.array(rows), -1, 0)
    functions[:, 3:] *= mu * k[:, None, None]
    return functions


def _conjugate_gradients(response: Callable[[Array], Array], wanted: Array) -> Array:
    """Solution of a symmetric, positive linear equation."""
    x = np.zeros_like(wanted)
    residual, direction = wanted.copy(), wanted.copy()
    square = first = float(np.sum(residual**2))
    for _ in range(_ITERATIONS):
        if square <= _TOLERANCE**2 * first:
            break
        changed = response(direction)
        step = square / float(np.sum(direction * changed))
        x, residual = x + step * direction, residual - step * changed
        before, square = square, float(np.sum(residual**2))
        direction = residual + square / before * direction
    return x
