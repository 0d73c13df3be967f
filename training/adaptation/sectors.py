"""Rotations that map a sensor and its measurements onto themselves: presses shared by sectors."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from eitskin.geometry.design.outline import Disc, Rectangle
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.training.adaptation.channel_maps import Presses
from eitskin.training.adaptation.place_kernel import PlaceKernel
from eitskin.training.adaptation.press_strength import unit_scale

Array = NDArray[np.float64]

TOLERANCE = 5e-4  # m: how far an electrode may stand from its place by symmetry
GAIN_SPREAD = 0.3  # of the logarithms of the gains of channels alike
FEW = 64  # presses from which the gains are learned; more share nothing with other sectors
NOISE = 0.05  # variance of what symmetry leaves unexplained, relative to the answers'
STARTS = 8  # combinations of signs that are tried in full


@dataclass(frozen=True, slots=True, eq=False)
class Sectors:
    """Group of rotations by 360/n degrees under which electrodes and measurements are alike.

    Attributes:
        centre: of the rotation (2,) [m].
        turned: channel that channel c becomes after r rotations, (n, C).
    """

    centre: Array
    turned: NDArray[np.int64]

    @classmethod
    def of(cls, design: SensorDesign | None, protocol: Protocol | None) -> "Sectors | None":
        """Largest such group; None where there is none, or design or protocol are not known.

        Measurements are alike only with each electrode in the same role: an instrument may tell
        source from sink, and one sense lead from the other.
        """
        if design is None or protocol is None or not isinstance(design.outline, Disc | Rectangle):
            return None
        centre = np.array(design.centre[:2])
        places = np.array([[e.x, e.y] for e in design.electrodes]) - centre
        square = math.isclose(design.outline.length, design.outline.width)
        turns = (
            range(len(places), 1, -1) if isinstance(design.outline, Disc) else (4, 2)[not square :]
        )
        for n in turns:
            step = _permutation(places, n)
            moved = [] if step is None else _moved(protocol, step)
            if moved and min(moved) >= 0:
                turned = [np.arange(len(protocol))]
                for _ in range(n - 1):
                    turned.append(np.array(moved)[turned[-1]])
                return cls(centre, np.array(turned))
        return None

    def rotated(self, places: Array, steps: int) -> Array:
        """Places (n, 2) [m] after some rotations."""
        angle = 2.0 * np.pi * steps / len(self.turned)
        c, s = math.cos(angle), math.sin(angle)
        rotated: Array = (places - self.centre) @ np.array([[c, s], [-s, c]]) + self.centre
        return rotated

    def shared(self, presses: Presses, weight: float) -> Presses:
        """Presses, and after them their copies in all other sectors, of smaller weight.

        Args:
            presses: recorded ones, their answers in units of the channels' gains.
            weight: of a copy, between 0 and 1.
        """
        copies = [presses]
        for steps in range(1, len(self.turned)):
            answers = np.empty_like(presses.answers)
            answers[:, self.turned[steps]] = presses.answers
            copies.append(
                Presses(
                    self.rotated(presses.places, steps),
                    presses.strength,
                    answers,
                    weight * presses.weight,
                    presses.owner,
                )
            )
        names = ("places", "strength", "answers", "weight", "owner")
        return Presses(
            *(np.concatenate([getattr(each, name) for each in copies]) for name in names)
        )

    def gains(self, kernel: PlaceKernel, presses: Presses) -> Array:
        """Signed gain of each channel, by which its map is that of the channels alike (C,).

        Channels of one orbit share a map h in their own sector, y_c = a_c s h(rotated p). The gains
        maximise the marginal likelihood of h, their logarithms normally distributed about that of
        the orbit; magnitudes hide the sign of a voltage, so combinations of signs are tried.
        """
        gains = unit_scale(presses)
        few = presses.select(np.arange(min(FEW, len(presses.strength))))
        n, done = len(few.strength), np.zeros(len(gains), dtype=bool)
        back = np.concatenate([self.rotated(few.places, -r) for r in range(len(self.turned))])
        strength = np.tile(few.strength, len(self.turned))
        covariance = kernel(back, back) * np.outer(strength, strength)
        covariance += NOISE * float(np.mean(few.strength**2)) * np.eye(len(back))
        factor = cho_factor(covariance)
        for channel in range(len(gains)):
            orbit = self.turned[:, channel]
            if done[channel] or len(set(orbit.tolist())) < len(orbit):
                continue
            blocks = np.zeros((len(back), len(orbit)))
            for r, each in enumerate(orbit):
                blocks[r * n : (r + 1) * n, r] = few.answers[:, each]
            gains[orbit] = _gains(blocks.T @ cho_solve(factor, blocks), n)
            done[orbit] = True
        return gains


def _permutation(places: Array, n: int) -> NDArray[np.int64] | None:
    """Electrode at the place of each after a rotation by 1/n; None where there is none."""
    angle = 2.0 * np.pi / n
    c, s = math.cos(angle), math.sin(angle)
    away = np.linalg.norm((places @ np.array([[c, s], [-s, c]]))[:, None] - places, axis=2)
    found = away.argmin(axis=1)
    alike = away.min(axis=1).max() < TOLERANCE and len(set(found.tolist())) == len(places)
    return found if alike else None


def _moved(protocol: Protocol, step: NDArray[np.int64]) -> list[int]:
    """Channel that each becomes when electrode e becomes step[e]; -1 where there is none.

    With source and sink, and both sense leads, swapped at once, a measurement is the same.
    """
    rows = {row: at for at, row in enumerate(protocol.table)}
    found = []
    for row in protocol.table:
        a, b, c, d = (int(step[electrode]) for electrode in row)
        found.append(rows.get((a, b, c, d), rows.get((b, a, d, c), -1)))
    return found


def _gains(quadratic: Array, presses: int) -> Array:
    """Gains of an orbit from the quadratic form (r, r) of its answers in the inverse covariance."""
    size = len(quadratic)
    signs = np.ones((1, size))
    for at in range(1, size):  # the best combinations of the first channels, extended by one
        both = np.concatenate([signs, signs * np.where(np.arange(size) == at, -1.0, 1.0)])
        head = both[:, : at + 1]
        cost = np.einsum("ia,ab,ib->i", head, quadratic[: at + 1, : at + 1], head)
        signs = both[np.argsort(cost, kind="stable")[: 1 << 7]]
    fits = [_positive_gains(quadratic * np.outer(each, each), presses) for each in signs[:STARTS]]
    best = int(np.argmin([cost for _, cost in fits]))
    gains: Array = signs[best] * fits[best][0]
    return gains


def _positive_gains(quadratic: Array, presses: int) -> tuple[Array, float]:
    """Positive gains and their cost, by Newton's method on the logarithms u of their inverses."""
    size = len(quadratic)
    spread = (np.eye(size) - 1.0 / size) / GAIN_SPREAD**2

    def cost(u: Array) -> float:
        b = np.exp(u)
        return float(0.5 * b @ quadratic @ b - presses * np.sum(u) + 0.5 * (u @ spread @ u))

    u = np.full(size, -0.5 * np.log(max(quadratic.sum() / (size * presses), 1e-300)))
    for _ in range(15):
        b = np.exp(u)
        pull = b * (quadratic @ b)
        gradient = pull - presses + spread @ u
        values, vectors = np.linalg.eigh(np.outer(b, b) * quadratic + np.diag(pull) + spread)
        step = -vectors @ ((vectors.T @ gradient) / np.maximum(np.abs(values), 1e-3))
        step = np.clip(step, -1.0, 1.0)
        while cost(u + step) > cost(u) and np.abs(step).max() > 1e-9:
            step = 0.5 * step
        u = u + step
        if np.abs(step).max() < 1e-6:
            break
    return np.exp(-u), cost(u)
