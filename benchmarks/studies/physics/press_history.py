"""Viscoelastic memory of presses whose force changes in time: whole histories, frame by frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_banded

from eitskin.errors import ConfigurationError
from eitskin.simulator.mechanics.viscoelasticity import Prony, check_not_negative, mean_decay

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class ForceHistory:
    """A force that changes linearly between given times: none before, the last one for ever.

    Attributes:
        times: never falling, (n,) [s]; the force jumps where two are equal.
        forces: (n,) [N].
    """

    times: Array
    forces: Array

    def __post_init__(self) -> None:
        _check_samples(self.times, self.forces)

    def elastic_force(self, prony: Prony, t: ArrayLike) -> Array:
        """The force [N] that would make at once the dent there is at each t [s], after jumps.

        Exact up to rounding, in time proportional to len(times) + len(t).
        """
        j, retardation = (np.array(part) for part in prony.dual)
        at = _moments(t)
        delayed = _delayed(retardation, self.times, self.forces, at)
        return np.asarray(_now(self.times, self.forces, at) + np.tensordot(j, delayed, axes=1))


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """Memory of a viscoelastic body for the forces that acted on it, updated frame by frame.

    Attributes:
        prony: how it relaxes.
        force: that acts now [N].
        delayed: the force as each retardation time lets the body feel it, (terms,) [N].
    """

    prony: Prony
    force: float
    delayed: Array

    @classmethod
    def none(cls, prony: Prony) -> "Memory":
        """Memory of a body that was never touched."""
        return cls(prony, 0.0, np.zeros(len(prony.dual[1])))

    def after(self, seconds: float, force: float) -> "Memory":
        """The memory after the force went to `force` [N] linearly; in 0 seconds, by a jump."""
        check_not_negative(seconds=seconds, force=force)
        x = seconds / np.array(self.prony.dual[1])
        return Memory(self.prony, force, _followed(self.delayed, x, self.force, force))

    @property
    def elastic_force(self) -> float:
        """The force that would make at once the dent there is [N]."""
        return self.force + float(np.array(self.prony.dual[0]) @ self.delayed)


def _followed(delayed: Array, x: Array, before: Array | float, after: Array | float) -> Array:
    """q after a time of x tau, over which the load changes linearly: tau q' = load - q."""
    followed: Array = delayed * np.exp(-x) - before * np.expm1(-x)
    followed += (after - before) * (1.0 - mean_decay(x))
    return followed


def _delayed(tau: Array, times: Array, loads: Array, t: Array) -> Array:
    """The load as felt with delays tau, q at each t from rest, (terms, *t.shape)."""
    x = np.diff(times) / tau[:, None]
    gains = _followed(np.zeros_like(x), x, loads[:-1], loads[1:])
    q = np.zeros((len(tau), len(times)))
    for felt, decay, gain in zip(q[:, 1:], np.exp(-x), gains, strict=True):
        if len(gain):  # q_(i+1) - decay q_i = gain, from the first to the last
            felt[:] = solve_banded((1, 0), [np.ones_like(gain), np.append(-decay[1:], 0.0)], gain)
    i, elapsed = _piece(times, t)
    x = np.multiply.outer(1.0 / tau, elapsed)
    return np.where(t < times[0], 0.0, _followed(q[:, i], x, loads[i], _now(times, loads, t)))


def _piece(times: Array, t: Array) -> tuple[NDArray[np.int64], Array]:
    """The last sample not after each t, or the first, and the time since."""
    i = np.maximum(np.searchsorted(times, t, side="right") - 1, 0)
    return i, np.maximum(t - times[i], 0.0)


def _now(times: Array, values: Array, t: Array) -> Array:
    """Linear interpolation; after jumps, and 0 before the first sample."""
    i, elapsed = _piece(times, t)
    after = np.minimum(i + 1, len(times) - 1)
    span = times[after] - times[i]
    part = np.divide(elapsed, span, out=np.zeros_like(elapsed), where=span > 0.0)
    return np.where(t < times[0], 0.0, values[i] + part * (values[after] - values[i]))


def _moments(t: ArrayLike) -> Array:
    at = np.asarray(t, dtype=np.float64)
    if not np.all(np.isfinite(at)):
        raise ConfigurationError("times must be finite numbers of s")
    return at


def _check_samples(times: Array, forces: Array) -> None:
    if np.ndim(times) != 1 or np.shape(times) != np.shape(forces) or len(times) == 0:
        raise ConfigurationError(
            "a history needs as many forces in N as times, one or more, got shapes "
            f"{np.shape(forces)} and {np.shape(times)}"
        )
    if not (np.all(np.isfinite(times)) and np.all(np.diff(times) >= 0.0)):
        raise ConfigurationError("the times of a history must be finite, in s, and never fall")
    if not np.all(np.isfinite(forces) & (np.asarray(forces) >= 0.0)):
        raise ConfigurationError("a history needs forces in N that are finite and not negative")
