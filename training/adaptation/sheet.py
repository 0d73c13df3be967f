"""Knowledge of a sheet: sectors that are alike, and the choice of the model of its maps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from eitskin.geometry import Disc, PlaneOutline, Rectangle, SensorDesign
from eitskin.simulator import Protocol
from eitskin.training.adaptation.channel_maps import (
    ChannelMaps,
    DesignSpan,
    PlaceKernel,
    Presses,
    concatenate,
)
from eitskin.training.method.input_spec import measurement_images
from eitskin.training.reconstruction.pixel_grid import PixelGrid, linear_model

Array = NDArray[np.float64]

TOLERANCE = 5e-4  # m: how far an electrode may stand from its place by symmetry
GAIN_SPREAD = 0.3  # of the logarithms of the gains of channels alike
MAX_GAIN_PRESSES = 64  # presses that gains are learned from; more share nothing with sectors
NOISE = 0.05  # variance of what symmetry leaves unexplained, relative to the answers'
SPAN_PIXELS = 3600
STARTS = 8  # combinations of signs that are tried in full
LENGTHS = (1.0, 1.5, 2.2)  # of the presses' standard deviation along an axis
SHARES = (0.0, 0.5, 0.9)
COPIES = (0.0, 1 / 64, 1 / 256)
AVERAGED_COPIES = (1 / 64, 1 / 16)
NOISES = (0.01, 0.1, 1.0)
WEIGHTS = (1.0, 5.0)
MAX_AVERAGED_PRESSES = 8  # presses
MAX_SHARED_PRESSES = 64  # presses; beyond that, own ones say more than those of other sectors
MAX_CHOICE_PRESSES = 200
MAX_LEFT_OUT = 40  # presses, or two for each channel; fewer are left out of all that is learned
FOLDS = 5


def design_span(design: SensorDesign) -> DesignSpan:
    """Sensitivity maps of all pairs of electrodes, solved at coarse resolution.

    They are solved for currents e_j - e_0 between electrodes, and combined to those for
    e_j - mean(e), so that all electrodes count alike.
    """
    grid = PixelGrid.from_outline(design.outline, SPAN_PIXELS)
    n = len(design.electrodes)
    j, k = np.triu_indices(n - 1) + np.ones((2, 1), int)
    rows = [(drive, 0, sense, 0) for drive, sense in zip(j.tolist(), k.tolist(), strict=True)]
    model = linear_model(design, Protocol.from_rows(rows, n), grid.shape, resolution="coarse")
    gram = np.zeros((n, n, len(grid.inside.ravel())))
    gram[j, k] = gram[k, j] = np.real(model.sensitivity)
    centre = np.eye(n) - 1.0 / n
    gram = np.einsum("ab,cd,bdp->acp", centre, centre, gram, optimize=True)
    j, k = np.triu_indices(n)
    maps = gram[j, k] * np.where(j == k, 1.0, np.sqrt(2.0))[:, None]
    maps /= np.sqrt(np.sum(maps[:, grid.inside.ravel()] ** 2) / grid.inside.sum())
    size = np.array([design.outline.length, design.outline.width])
    return DesignSpan(maps.reshape(-1, *grid.shape), size)


@dataclass(frozen=True, slots=True, eq=False)
class Sectors:
    """Group of rotations by 360/n degrees under which electrodes and measurements are alike.

    Attributes:
        centre: centre of the rotation (2,) [m].
        turned: channel that channel c becomes after r rotations, (n, C).
    """

    centre: Array
    turned: NDArray[np.int64]

    @classmethod
    def from_design(
        cls, design: SensorDesign | None, protocol: Protocol | None
    ) -> "Sectors | None":
        """Largest such group; None where there is none, or design or protocol are not known.

        Measurements are alike only with each electrode in the same role: an instrument may show
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
            table = np.array(protocol.table)
            moved = None if step is None else measurement_images(table, step, polarity=True)
            if moved is not None:
                turned = [np.arange(len(protocol))]
                for _ in range(n - 1):
                    turned.append(moved[turned[-1]])
                return cls(centre, np.array(turned))
        return None

    def rotate(self, places: Array, steps: int) -> Array:
        """Places (n, 2) [m] after some rotations."""
        turn = _rotation(steps / len(self.turned))
        rotated: Array = (places - self.centre) @ turn + self.centre
        return rotated

    def copy_to_sectors(self, presses: Presses, weight: float) -> Presses:
        """Presses, and after them their copies in all other sectors, of smaller weight.

        Args:
            presses: recorded ones, their answers in units of the channels' gains.
            weight: weight of a copy, between 0 and 1.
        """
        copies = [presses]
        for steps in range(1, len(self.turned)):
            answers = np.empty_like(presses.answers)
            answers[:, self.turned[steps]] = presses.answers
            places = self.rotate(presses.places, steps)
            copies.append(
                replace(presses, places=places, answers=answers, weight=weight * presses.weight)
            )
        return concatenate(copies)

    def gains(self, kernel: PlaceKernel, presses: Presses) -> Array:
        """Signed gain of each channel, by which its map is that of the channels alike (C,).

        Channels of one orbit share a map h in their own sector, y_c = a_c s h(rotated p). The gains
        maximise the marginal likelihood of h, their logarithms normally distributed about that of
        the orbit; magnitudes hide the sign of a voltage, so combinations of signs are tried.
        """
        gains = presses.unit_scale
        few = presses.select(np.arange(min(MAX_GAIN_PRESSES, len(presses.strength))))
        n, done = len(few.strength), np.zeros(len(gains), dtype=bool)
        back = np.concatenate([self.rotate(few.places, -r) for r in range(len(self.turned))])
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


def _rotation(turns: float) -> Array:
    """Matrix (2, 2) that rows of coordinates are multiplied by to rotate them."""
    c, s = math.cos(2.0 * np.pi * turns), math.sin(2.0 * np.pi * turns)
    return np.array([[c, s], [-s, c]])


def _permutation(places: Array, n: int) -> NDArray[np.int64] | None:
    """Electrode at the place of each after a rotation by 1/n; None where there is none."""
    away = np.linalg.norm((places @ _rotation(1.0 / n))[:, None] - places, axis=2)
    nearest = away.argmin(axis=1)
    alike = away.min(axis=1).max() < TOLERANCE and len(set(nearest.tolist())) == len(places)
    return nearest if alike else None


def _gains(quadratic: Array, presses: int) -> Array:
    """Gains of an orbit from the quadratic form (r, r) of its answers in the inverse covariance."""
    size = len(quadratic)
    signs = np.ones((1, size))
    for at in range(1, size):  # the best combinations of the first channels, extended by one
        sign_choices = np.concatenate([signs, signs * np.where(np.arange(size) == at, -1.0, 1.0)])
        head = sign_choices[:, : at + 1]
        cost = np.einsum("ia,ab,ib->i", head, quadratic[: at + 1, : at + 1], head)
        signs = sign_choices[np.argsort(cost, kind="stable")[: 1 << 7]]
    fits = [_positive_gains(quadratic * np.outer(sign, sign), presses) for sign in signs[:STARTS]]
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


@dataclass(frozen=True, slots=True)
class MapChoice:
    """How the maps of a sensor are modelled.

    Attributes:
        length: length scale over the presses' standard deviation along an axis.
        share: share of the design's span in the prior variance; zero without a design.
        copies: weight of a press's copies in other sectors; zero for none.
        noise: prior guess of the noise variance, relative to the answers'.
        weight: weight of prior guesses of the channels' covariances, in presses per channel.
    """

    length: float = 1.5
    share: float = 0.0
    copies: float = 0.0
    noise: float = 0.1
    weight: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class SheetKnowledge:
    """Knowledge of a sheet next to its presses.

    Attributes:
        extent: standard deviation of the presses' places along an axis [m].
        span: span of the sensor's design; None where it is not known.
        sectors: sectors that are alike; None without any.
    """

    extent: float
    span: DesignSpan | None = None
    sectors: Sectors | None = None

    @classmethod
    def from_design(
        cls, extent: float, design: SensorDesign | None, protocol: Protocol | None, channels: int
    ) -> "SheetKnowledge":
        """Knowledge by a design; the extent alone where there is none, or it is no plane one."""
        if design is None or not isinstance(design.outline, PlaneOutline):
            return cls(extent)
        fits = protocol is not None and len(protocol) == channels
        return cls(
            extent, design_span(design), Sectors.from_design(design, protocol) if fits else None
        )

    def kernel(self, choice: MapChoice) -> PlaceKernel:
        """Prior covariance over the sheet."""
        return PlaceKernel(choice.length * self.extent, self.span, choice.share)

    def fit(self, choice: MapChoice, presses: Presses) -> tuple[ChannelMaps, Array, Presses]:
        """Maps, gains of the channels (C,), and the presses in units of these that were learned.

        Presses have copies in other sectors where that is chosen.
        """
        shared = self.sectors if choice.copies > 0.0 else None
        gains = presses.unit_scale
        if shared is not None:
            gains = shared.gains(PlaceKernel(choice.length * self.extent), presses)
        scaled = replace(presses, answers=presses.answers / gains)
        if shared is not None:
            scaled = shared.copy_to_sectors(scaled, choice.copies)
        return (
            ChannelMaps.fit(self.kernel(choice), scaled, choice.noise, choice.weight),
            gains,
            scaled,
        )

    def choices(self, presses: Presses) -> Sequence[MapChoice]:
        """Choices over which places are averaged: the best one, or several where presses are few.

        A handful of presses shows none of them from the others, and the errors of each are its own.
        """
        if len(presses.owners) > MAX_AVERAGED_PRESSES:
            return [self.choose(presses)]
        shares = SHARES[:2] if self.span is not None else (0.0,)
        copies = AVERAGED_COPIES if self.sectors is not None else (0.0,)
        return [MapChoice(*each) for each in product(LENGTHS[:2], shares, copies, NOISES[1::-1])]

    def choose(self, presses: Presses) -> MapChoice:
        """Best choice, one attribute after the other, by a clear margin: its standard error.

        The score is the mean log predictive density of a press that is left out: in closed form,
        or, with few presses, with everything learned again without it.
        """
        rows, count = len(presses.strength), len(presses.owners)
        some = presses.select(np.arange(0, rows, -(-rows // MAX_CHOICE_PRESSES)))
        shared = self.sectors is not None and count <= MAX_SHARED_PRESSES
        options: Sequence[tuple[str, Sequence[float]]] = (
            ("length", LENGTHS),
            ("share", SHARES if self.span is not None else ()),
            ("copies", COPIES if shared else ()),
            ("noise", NOISES),
            ("weight", WEIGHTS),
        )
        best = MapChoice(
            share=SHARES[1] if self.span is not None else 0.0, copies=COPIES[1] if shared else 0.0
        )
        scores = {best: self.density(best, some)}
        for name, values in options:
            now = scores[best]
            for value in values:
                other = replace(best, **{name: value})
                if other not in scores:
                    scores[other] = self.density(other, some)
            gains = {each: score - now for each, score in scores.items()}
            clear = {
                each: float(gain.mean())
                for each, gain in gains.items()
                if each == best or gain.mean() > gain.std() / np.sqrt(len(gain))
            }
            best = max(clear, key=lambda each: clear[each])
        return best

    def density(self, choice: MapChoice, presses: Presses) -> Array:
        """Log predictive density of each press, it left out, in the answers' own unit (n,).

        It is the mean of those of its frames, which share the errors of the maps.
        """
        owners, number, frames = np.unique(presses.owner, return_inverse=True, return_counts=True)
        log_density = np.zeros(len(number))
        if len(owners) > max(MAX_LEFT_OUT, 2 * presses.answers.shape[1]):
            maps, gains, scaled = self.fit(choice, presses)
            log_density[:] = maps.left_out_density(scaled) - np.sum(np.log(np.abs(gains)))
        else:
            for fold in range(folds := min(FOLDS, len(owners))):
                tested = np.isin(presses.owner, owners[fold::folds])
                other = presses.select(tested)
                maps, gains, _ = self.fit(choice, presses.select(~tested))
                density = maps.log_density(replace(other, answers=other.answers / gains))
                log_density[tested] = density - np.sum(np.log(np.abs(gains)))
        mean: Array = np.bincount(number, log_density) / frames
        return mean
