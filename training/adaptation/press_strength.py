"""Relative strength of labelled presses: a power of depth or force, or learned where unknown."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.training.adaptation.channel_maps import ChannelMaps, Presses
from eitskin.training.adaptation.place_kernel import PlaceKernel

Array = NDArray[np.float64]

EXPONENTS = np.arange(0.0, 2.1, 0.4)
USUAL_EXPONENT, EXPONENT_SPREAD = 1.25, 0.4  # 1 of a force, 1.5 of a depth by Hertz's contact
NOISE = 0.05
ROUNDS = 4
SPREAD = 0.5  # prior standard deviation of the logarithm of an unknown strength
_MOST = 150  # presses that an exponent is learned from


@dataclass(frozen=True, slots=True)
class StrengthLaw:
    """Strength s = (label / middle)^exponent of a press of known depth or force.

    Attributes:
        middle: label of a press of strength one, in its own unit.
        exponent: dimensionless; zero where strength does not depend on the label.
    """

    middle: float
    exponent: float

    @classmethod
    def fit(
        cls, density: Callable[[Presses], Array], presses: Presses, label: ArrayLike
    ) -> "StrengthLaw":
        """Exponent of the largest posterior density.

        Args:
            density: log predictive density of each press when it is left out (n,).
            presses: of any strength.
            label: depth or force of each, positive (n,).
        """
        values = np.asarray(label, dtype=float)
        middle = float(np.median(values))
        if np.ptp(values) < 0.01 * middle:
            return cls(middle, 1.0)
        some = np.arange(0, len(values), -(-len(values) // _MOST))
        part = presses.select(some)
        found = []
        for exponent in EXPONENTS:
            strength = (values[some] / middle) ** exponent
            off = (exponent - USUAL_EXPONENT) / EXPONENT_SPREAD
            found.append(np.sum(density(replace(part, strength=strength))) - 0.5 * off**2)
        best = int(np.clip(np.argmax(found), 1, len(EXPONENTS) - 2))
        a, b, c = found[best - 1 : best + 2]
        bend = a - 2.0 * b + c
        shift = 0.5 * (a - c) / bend if bend < 0.0 else 0.0
        step = float(EXPONENTS[1] - EXPONENTS[0])
        return cls(middle, float(EXPONENTS[best]) + step * float(np.clip(shift, -1.0, 1.0)))

    def strength(self, label: ArrayLike) -> Array:
        """Strength (n,) of depths or forces (n,)."""
        strength: Array = (np.asarray(label, dtype=float) / self.middle) ** self.exponent
        return strength

    def label(self, strength: ArrayLike) -> Array:
        """Depths or forces (n,) of strengths (n,); NaN where the exponent tells nothing."""
        s = np.asarray(strength, dtype=float)
        if self.exponent < 0.25:
            return np.full(s.shape, np.nan)
        label: Array = self.middle * s ** (1.0 / self.exponent)
        return label


def learned_strength(kernel: PlaceKernel, presses: Presses) -> Array:
    """Strengths (n,) of presses of unknown depth and force, of geometric mean one.

    Each in turn is the factor by which the maps of the other presses explain its answers best.
    """
    strength = np.ones(len(presses.strength))
    for _ in range(ROUNDS):
        scaled, _ = _unit(replace(presses, strength=strength))
        maps = ChannelMaps.fit(kernel, scaled, NOISE)
        mean, variance = maps.left_out(scaled)
        seen = scaled.answers @ maps.covariance.whitening
        map_mean, weight = mean / strength[:, None], 1.0 / variance
        prior = 1.0 / SPREAD**2
        best = np.sum(weight * seen * map_mean, axis=1) + prior
        best /= np.sum(weight * map_mean**2, axis=1) + prior
        strength = np.clip(best, 0.05, 20.0)
        strength /= np.exp(np.mean(np.log(strength)))
    return strength


def unit_scale(presses: Presses) -> Array:
    """Root mean square answer of each channel at strength one (C,); one where it never answers."""
    scale = np.sqrt(np.mean((presses.answers / presses.strength[:, None]) ** 2, axis=0))
    return np.where(scale > 0.0, scale, 1.0)


def _unit(presses: Presses) -> tuple[Presses, float]:
    """Presses with answers of order one, and the sum of the logarithms of the scales."""
    scale = unit_scale(presses)
    return replace(presses, answers=presses.answers / scale), float(np.sum(np.log(scale)))
