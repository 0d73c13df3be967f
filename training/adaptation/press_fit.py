"""Learning of touch places from few labelled presses of one sensor."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.training.adaptation.channel_maps import ChannelMaps, Presses
from eitskin.training.adaptation.labelled_presses import LabelledPresses
from eitskin.training.adaptation.map_choice import MapChoice, SheetKnowledge
from eitskin.training.adaptation.map_grid import MapGrid, Places, mixture_places
from eitskin.training.adaptation.place_kernel import DesignSpan
from eitskin.training.adaptation.position_regressor import log_ratio
from eitskin.training.adaptation.press_locator import PressLocator
from eitskin.training.adaptation.press_strength import StrengthLaw, learned_strength, unit_scale
from eitskin.training.adaptation.sectors import Sectors

Array = NDArray[np.float64]

FEWEST = 5  # labelled presses
GRID_POINTS = 44  # along the longer side of the sheet
FOLDS = 5
MOST_TESTED = 20  # presses of a fold
MISFIT = 6.0  # standard deviations; a channel that departs further is left out of the frame
MISFIT_MARGIN = 2.0  # over the usual misfit of presses that were left out
PRIOR_TESTS = 10.0  # presses that the prior guess 1 of the standard errors' factor counts as
# Presses at which learned covariances double the error variance, without the design and with it.
COVARIANCE_PRESSES, WITH_DESIGN = 10.0, 4.0


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """Errors of places in presses that were left out, in blocks of neighbours in time.

    Attributes:
        presses: number that was tested.
        mean_error_mm: mean distance from the true place [mm].
        error_ratio: root mean square of error over standard error, before it is corrected by it.
    """

    presses: int
    mean_error_mm: float
    error_ratio: float


@dataclass(frozen=True, slots=True, eq=False)
class LearnedPlaces:
    """Locator of touches that presses taught, and how good it is.

    Attributes:
        locator: of touches.
        law: between strength and depth or force; None where neither was known.
        choice: how the maps are modelled; the first where several ways are averaged over.
        validated: errors in presses that were left out.
    """

    locator: PressLocator
    law: StrengthLaw | None
    choice: MapChoice
    validated: CrossValidation


def learn_places(labelled: LabelledPresses) -> LearnedPlaces:
    """Learn places from labelled presses.

    Frames in succession that see one held touch are one press: they tell the noise, and are left
    out together. With the sensor's design the span of its sensitivities is part of the prior, and
    with the protocol it tells which sectors are alike.

    Raises DataError for fewer than `FEWEST` presses, or presses all at one place.
    """
    logs, xy, design = log_ratio(labelled.ratios), labelled.places, labelled.design
    extent = float(np.sqrt(np.mean(xy.var(axis=0)))) if len(xy) else 0.0
    held = labelled.held
    first = np.unique(held, return_index=True)[1]
    count = len(first)
    if count < FEWEST or extent == 0.0:
        raise DataError(
            f"learning touch positions needs at least {FEWEST} presses of one touch, at different "
            f"positions, and an untouched reference, got {count}; record more"
        )
    known = SheetKnowledge(extent, *_of_design(design, labelled.protocol, logs.shape[1]))
    recorded = Presses.of(xy, np.ones(len(xy)), logs, held)
    presses, law = _with_strength(known, recorded, labelled.label)
    choices = known.choices(presses)
    region = _Region.of(xy[first], design)
    fitted = [_Fitted.of(known, each, presses) for each in choices]
    found, errors = _cross_validated(known, choices, presses, region)
    off = errors / found.deviation
    square = float(np.sum(np.minimum(off, 5.0) ** 2))
    variance = (PRIOR_TESTS + square) / (PRIOR_TESTS + len(off))
    few = COVARIANCE_PRESSES if known.span is None else WITH_DESIGN
    variance *= 1.0 + few / count
    usual = float(np.quantile(np.abs(found.misfit).max(axis=1), 0.95))
    locator = PressLocator(
        fitted[0].grid(region),
        fitted[0].gains,
        unit_scale(recorded),
        xy.mean(axis=0),
        float(np.sqrt(variance)),
        max(MISFIT, MISFIT_MARGIN * usual),
        tuple(each.grid(region, fitted[0].gains) for each in fitted[1:]),
    )
    validated = CrossValidation(
        len(off), float(errors.mean()) * 1e3, float(np.sqrt(np.mean(off**2)))
    )
    return LearnedPlaces(locator, law, choices[0], validated)


@dataclass(frozen=True, slots=True, eq=False)
class _Region:
    """Grid over the part of the sheet where touches can be.

    Attributes:
        low: first point (2,) [m].
        step: between points [m].
        shape: rows and columns.
        log_prior: (rows, columns), uniform within the region.
    """

    low: Array
    step: float
    shape: tuple[int, int]
    log_prior: Array

    @classmethod
    def of(cls, places: Array, design: SensorDesign | None) -> "_Region":
        """Region within reach of the presses' places (n, 2), and within the outline where known.

        Reach is 1.5 times the distance of neighbours, were the presses on a square grid over the
        sheet, which a few of them span in part: over their span only where its size is not known.
        """
        outline = None if design is None else design.outline
        span = np.ptp(places, axis=0)
        if isinstance(outline, PlaneOutline):
            span = np.array([outline.length, outline.width])
        reach = 1.5 * float(np.sqrt(max(span[0] * span[1], 0.01 * span.max() ** 2) / len(places)))
        low, high = places.min(axis=0) - reach, places.max(axis=0) + reach
        if isinstance(outline, PlaneOutline):
            low = np.maximum(low, 0.0)
            high = np.minimum(high, [outline.length, outline.width])
        step = float((high - low).max()) / (GRID_POINTS - 1)
        columns, rows = (int(n) for n in np.floor((high - low) / step + 1e-9).astype(int) + 1)
        x, y = np.meshgrid(low[0] + step * np.arange(columns), low[1] + step * np.arange(rows))
        points = np.stack([x.ravel(), y.ravel()], axis=1)
        near = np.min(np.linalg.norm(points[:, None] - places[:2000], axis=2), axis=1) <= reach
        if isinstance(outline, PlaneOutline):
            near &= outline.contains(points)
        log_prior = np.where(near, 0.0, -np.inf).reshape(rows, columns)
        return cls(low, step, (rows, columns), log_prior)

    @property
    def points(self) -> Array:
        """All grid points, row by row (n, 2) [m]."""
        rows, columns = self.shape
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        points: Array = self.low + self.step * np.stack([x.ravel(), y.ravel()], axis=1)
        return points


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """Maps of a choice, gains of the channels, and mean and deviation of the strength."""

    gains: Array
    maps: ChannelMaps
    strength: Array

    @classmethod
    def of(cls, known: SheetKnowledge, choice: MapChoice, presses: Presses) -> "_Fitted":
        gains = known.gains(choice, presses)
        maps = ChannelMaps.fit(
            known.kernel(choice), known.prepared(choice, presses, gains), choice.noise
        )
        s = presses.strength
        prior = np.array([s.mean(), s.std() + 0.15 * s.mean()])
        return cls(gains, maps, prior)

    def grid(self, region: _Region, gains: Array | None = None) -> MapGrid:
        """Maps on the grid of a region, for answers in units of other gains (C,) where given."""
        mean, variance = self.maps.at(region.points)
        shape = (*region.shape, mean.shape[1])
        made = MapGrid(
            region.low,
            region.step,
            mean.reshape(shape),
            variance.reshape(shape),
            region.log_prior,
            self.maps.covariance.whitening,
            self.strength,
        )
        return made if gains is None else made.of_units(gains / self.gains)


def _of_design(
    design: SensorDesign | None, protocol: Protocol | None, channels: int
) -> tuple[DesignSpan | None, Sectors | None]:
    """Span and sectors of a design; nothing where there is none, or it is no plane one."""
    if design is None or not isinstance(design.outline, PlaneOutline):
        return None, None
    fits = protocol is not None and len(protocol) == channels
    return DesignSpan.of(design), Sectors.of(design, protocol) if fits else None


def _with_strength(
    known: SheetKnowledge, presses: Presses, label: ArrayLike | None
) -> tuple[Presses, StrengthLaw | None]:
    """Presses with their strengths, by a law of depth or force where these are known."""
    kernel = known.kernel(MapChoice())
    values = np.full(len(presses.strength), np.nan) if label is None else np.asarray(label, float)
    if np.isfinite(values).all() and (values > 0).all():
        law = StrengthLaw.fit(lambda these: known.density(MapChoice(), these), presses, values)
        return replace(presses, strength=law.strength(values)), law
    return replace(presses, strength=learned_strength(kernel, presses)), None


def _cross_validated(
    known: SheetKnowledge, choices: Sequence[MapChoice], presses: Presses, region: _Region
) -> tuple[Places, Array]:
    """Places of presses that are left out by blocks in time, and their errors (k,) [m]."""
    owners, first = np.unique(presses.owner, return_index=True)
    blocks = np.array_split(np.arange(len(owners)), min(FOLDS, len(owners)))
    found, errors = [], []
    for block in blocks:
        tested = first[block[:: -(-len(block) // MOST_TESTED)]]
        rest = presses.select(~np.isin(presses.owner, owners[block]))
        fitted = [_Fitted.of(known, each, rest) for each in choices]
        answers = presses.answers[tested]
        place = mixture_places([each.grid(region).locate(answers / each.gains) for each in fitted])
        found.append(place)
        errors.append(np.linalg.norm(place.place - presses.places[tested], axis=1))
    names = ("place", "deviation", "strength", "misfit")
    joined = Places(*(np.concatenate([getattr(each, name) for each in found]) for name in names))
    return joined, np.concatenate(errors)
