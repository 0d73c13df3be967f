"""Choice of a sensor's map model by the predictive density of presses that are left out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from eitskin.training.adaptation.channel_maps import ChannelMaps, Presses
from eitskin.training.adaptation.place_kernel import DesignSpan, PlaceKernel
from eitskin.training.adaptation.press_strength import unit_scale
from eitskin.training.adaptation.sectors import Sectors

Array = NDArray[np.float64]

LENGTHS = (1.0, 1.5, 2.2)  # of the presses' standard deviation along an axis
SHARES = (0.0, 0.5, 0.9)
COPIES = (0.0, 1 / 64, 1 / 256)
AVERAGED_COPIES = (1 / 64, 1 / 16)
NOISES = (0.01, 0.1)
MOST_AVERAGED_BY = 8  # presses
MOST_SHARED = 64  # presses; beyond that, own ones say more than those of other sectors
MOST_CHOSEN_BY = 200
FEW = 40  # presses; covariances and gains learned from fewer must not have seen those left out
FOLDS = 5


@dataclass(frozen=True, slots=True)
class MapChoice:
    """How the maps of a sensor are modelled.

    Attributes:
        length: length scale over the presses' standard deviation along an axis.
        share: of the design's span in the prior variance; zero without a design.
        copies: weight of a press's copies in other sectors; zero for none.
        noise: prior guess of the noise variance, relative to the answers'.
    """

    length: float = 1.5
    share: float = 0.0
    copies: float = 0.0
    noise: float = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class SheetKnowledge:
    """Knowledge of a sheet beside its presses.

    Attributes:
        extent: standard deviation of the presses' places along an axis [m].
        span: of the sensor's design; None where it is not known.
        sectors: that are alike; None without any.
    """

    extent: float
    span: DesignSpan | None = None
    sectors: Sectors | None = None

    def kernel(self, choice: MapChoice) -> PlaceKernel:
        """Prior covariance over the sheet."""
        return PlaceKernel(choice.length * self.extent, self.span, choice.share)

    def gains(self, choice: MapChoice, presses: Presses) -> Array:
        """Gain of each channel (C,), by which answers become of order one."""
        if choice.copies == 0.0 or self.sectors is None:
            return unit_scale(presses)
        return self.sectors.gains(PlaceKernel(choice.length * self.extent), presses)

    def prepared(self, choice: MapChoice, presses: Presses, gains: Array) -> Presses:
        """Presses in units of the gains, with copies in other sectors where chosen."""
        scaled = replace(presses, answers=presses.answers / gains)
        if choice.copies == 0.0 or self.sectors is None:
            return scaled
        return self.sectors.shared(scaled, choice.copies)

    def choices(self, presses: Presses) -> Sequence[MapChoice]:
        """Choices over which places are averaged: the best one, or several where presses are few.

        A handful of presses tells none of them from the others, and the errors of each are its own.
        """
        if len(presses.owners) > MOST_AVERAGED_BY:
            return [self.choose(presses)]
        shares = SHARES[:2] if self.span is not None else (0.0,)
        copies = AVERAGED_COPIES if self.sectors is not None else (0.0,)
        return [MapChoice(*each) for each in product(LENGTHS[:2], shares, copies, NOISES[::-1])]

    def choose(self, presses: Presses) -> MapChoice:
        """Best choice, one attribute after the other, by a clear margin: its standard error.

        The score is the mean log predictive density of a press that is left out: in closed form,
        or, with few presses, with everything learned anew without it.
        """
        rows, count = len(presses.strength), len(presses.owners)
        some = presses.select(np.arange(0, rows, -(-rows // MOST_CHOSEN_BY)))
        shared = self.sectors is not None and count <= MOST_SHARED
        options: Sequence[tuple[str, Sequence[float]]] = (
            ("length", LENGTHS),
            ("share", SHARES if self.span is not None else ()),
            ("copies", COPIES if shared else ()),
            ("noise", NOISES),
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
        found = self._density_of_frames(choice, presses)
        _, number, frames = np.unique(presses.owner, return_inverse=True, return_counts=True)
        density: Array = np.bincount(number, found) / frames
        return density

    def _density_of_frames(self, choice: MapChoice, presses: Presses) -> Array:
        kernel, owners = self.kernel(choice), presses.owners
        count = len(owners)
        if count > FEW:
            gains = self.gains(choice, presses)
            prepared = self.prepared(choice, presses, gains)
            maps = ChannelMaps.fit(kernel, prepared, choice.noise)
            return maps.left_out_density(prepared) - float(np.sum(np.log(np.abs(gains))))
        found, folds = np.zeros(len(presses.owner)), min(FOLDS, count)
        for fold in range(folds):
            tested = np.isin(presses.owner, owners[fold::folds])
            learned, other = presses.select(~tested), presses.select(tested)
            gains = self.gains(choice, learned)
            maps = ChannelMaps.fit(kernel, self.prepared(choice, learned, gains), choice.noise)
            density = maps.density_of(replace(other, answers=other.answers / gains))
            found[tested] = density - float(np.sum(np.log(np.abs(gains))))
        return found
