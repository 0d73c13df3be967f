"""Learning of touch places from few labelled presses of one sensor."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.datasets import Dataset
from eitskin.geometry import DataError, PlaneOutline, SensorDesign
from eitskin.simulator import Protocol
from eitskin.training.adaptation.channel_maps import (
    ChannelMaps,
    PlaceKernel,
    Presses,
    concatenate,
)
from eitskin.training.adaptation.locator import (
    UNKNOWN_SCALE,
    MapGrid,
    Places,
    PressLocator,
    log_ratio,
    mixture_places,
)
from eitskin.training.adaptation.sheet import MapChoice, SheetKnowledge
from eitskin.training.method.known_frames import held_numbers
from eitskin.training.method.sensor_health import ReadingRange, electrode_members, follow_recording
from eitskin.training.method.settings import single_touches

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
MIN_PRESSES = 5  # labelled presses
GRID_POINTS, FEW_POINTS = 44, 28  # along the longer side; fewer, where few presses show little
FOLDS = 5
MAX_FOLD_PRESSES = 20  # presses of a fold
MISFIT = 6.0  # standard deviations; a channel that departs further is left out of the frame
MISFIT_MARGIN = 2.0  # over the usual misfit of presses that were left out
FEW_MARGIN = 20.0  # more, over the number of these: few do not show the usual misfit
PRIOR_TESTS = 10.0  # presses that the prior guess 1 of the standard errors' factor counts as
# Presses at which learned covariances double the error variance, without the design and with it.
COVARIANCE_PRESSES, WITH_DESIGN = 10.0, 4.0
EXPONENTS = np.arange(0.0, 2.1, 0.4)
USUAL_EXPONENT, EXPONENT_SPREAD = 1.25, 0.4  # 1 of a force, 1.5 of a depth by Hertz's contact
NOISE = 0.05
ROUNDS = 4
SPREAD = 0.5  # prior standard deviation of the logarithm of an unknown strength
_MAX_EXPONENT_PRESSES = 150  # presses that an exponent is learned from


@dataclass(frozen=True, slots=True, eq=False)
class LabelledPresses:
    """n frames of presses of one sensor, in the order of time, and what is known of the sensor.

    Attributes:
        ratios: |V / ref| (n, C), ref being untouched; NaN where a channel is bad.
        places: places of the touches (n, 2) [m].
        label: depth [m] or else force [N] of each (n,); None where not all are known.
        design: design of the sensor; None where unknown.
        protocol: protocol of the channels; None where unknown.
    """

    ratios: Array
    places: Array
    label: Array | None = None
    design: SensorDesign | None = None
    protocol: Protocol | None = None

    @classmethod
    def from_dataset(
        cls, dataset: Dataset, frames: Rows | None = None, usual: ReadingRange | None = None
    ) -> "LabelledPresses":
        """Presses of a dataset: all of them, or those of `frames` (n,), of one touch each.

        The reference is flat where the untouched sensor was not recorded. Electrodes that failed
        are left out, by the range of `usual` readings, or of the recording's first.
        """
        dataset = follow_recording(dataset, usual)[0]
        rows = single_touches(dataset) if frames is None else frames
        free = dataset.touch_reference[rows]
        finite = np.isfinite(free).all(axis=1, keepdims=True)
        reference = np.where(finite, free, dataset.reference[dataset.specimen[rows]])
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = np.abs(dataset.impedance[rows] / reference).astype(float)
        ratios[dataset.status[rows] != 0] = np.nan
        return cls(
            ratios,
            touch_places(dataset, rows),
            _label(dataset, rows),
            dataset.design,
            dataset.protocol,
        )

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.ratios)

    @property
    def press_numbers(self) -> Rows:
        """Number of the press of each frame (n,): frames in succession may see one held touch."""
        label_columns = [self.places] if self.label is None else [self.places, self.label]
        return held_numbers(np.column_stack(label_columns))

    def select(self, rows: Rows) -> "LabelledPresses":
        """Presses at `rows` (k,)."""
        label = None if self.label is None else self.label[rows]
        return replace(self, ratios=self.ratios[rows], places=self.places[rows], label=label)


def touch_places(dataset: Dataset, frames: Rows | slice = slice(None)) -> Array:
    """Positions (k, 2) [m] of the one touch in each of `frames` (k,)."""
    x, y = (np.nansum(values[frames], axis=1) for values in (dataset.touch_x, dataset.touch_y))
    return np.stack([x, y], axis=1).astype(float)


def _label(dataset: Dataset, frames: Rows) -> Array | None:
    """Depth [m] or else force [N] of the one touch in each of `frames` (k,); None where unknown."""
    touched = np.isfinite(dataset.touch_x[frames])
    for values in (dataset.touch_depth, dataset.touch_force):
        label: Array = np.where(touched, values[frames], 0.0).sum(axis=1, dtype=float)
        if len(label) and np.isfinite(label).all() and (label > 0).all():
            return label
    return None


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
            presses: presses of any strength.
            label: depth or force of each, positive (n,).
        """
        values = np.asarray(label, dtype=float)
        middle = float(np.median(values))
        if np.ptp(values) < 0.01 * middle:
            return cls(middle, 1.0)
        some = np.arange(0, len(values), -(-len(values) // _MAX_EXPONENT_PRESSES))
        part = presses.select(some)
        fits = []
        for exponent in EXPONENTS:
            strength = (values[some] / middle) ** exponent
            off = (exponent - USUAL_EXPONENT) / EXPONENT_SPREAD
            fits.append(np.sum(density(replace(part, strength=strength))) - 0.5 * off**2)
        best = int(np.clip(np.argmax(fits), 1, len(EXPONENTS) - 2))
        a, b, c = fits[best - 1 : best + 2]
        bend = a - 2.0 * b + c
        shift = 0.5 * (a - c) / bend if bend < 0.0 else 0.0
        step = float(EXPONENTS[1] - EXPONENTS[0])
        return cls(middle, float(EXPONENTS[best]) + step * float(np.clip(shift, -1.0, 1.0)))

    def strength(self, label: ArrayLike) -> Array:
        """Strength (n,) of depths or forces (n,)."""
        strength: Array = (np.asarray(label, dtype=float) / self.middle) ** self.exponent
        return strength


def learned_strength(kernel: PlaceKernel, presses: Presses) -> Array:
    """Strengths (n,) of presses of unknown depth and force, of geometric mean one.

    Each in turn is the factor by which the maps of the other presses explain its answers best.
    """
    strength = np.ones(len(presses.strength))
    for _ in range(ROUNDS):
        scaled = replace(presses, strength=strength)
        scaled = replace(scaled, answers=scaled.answers / scaled.unit_scale)
        maps = ChannelMaps.fit(kernel, scaled, NOISE)
        mean, variance = maps.left_out(scaled)
        whitened = scaled.answers @ maps.whitening
        map_mean, weight = mean / strength[:, None], 1.0 / variance
        prior = 1.0 / SPREAD**2
        best = np.sum(weight * whitened * map_mean, axis=1) + prior
        best /= np.sum(weight * map_mean**2, axis=1) + prior
        strength = np.clip(best, 0.05, 20.0)
        strength /= np.exp(np.mean(np.log(strength)))
    return strength


@dataclass(frozen=True, slots=True, eq=False)
class LearnedPlaces:
    """Locator of touches that presses taught, and how good it is.

    Attributes:
        locator: locator of touches.
        law: law between strength and depth or force; None where neither was known.
        choice: model of the maps; the first where several ways are averaged over.
        validated: figures of presses that were left out, in blocks of neighbours in time: their
            number `presses`, the mean error `mean_error_mm` of places [mm], and the root mean
            square `error_ratio` of error over standard error, before it is corrected by it.
    """

    locator: PressLocator
    law: StrengthLaw | None
    choice: MapChoice
    validated: dict[str, float]


def learn_places(labelled: LabelledPresses) -> LearnedPlaces:
    """Learn places from labelled presses.

    Frames in succession that see one held touch are one press: they show the noise, and are left
    out together. With the sensor's design the span of its sensitivities is part of the prior, and
    with the protocol it shows which sectors are alike.

    Raises DataError for fewer than `MIN_PRESSES` presses, or presses all at one place.
    """
    dead = 4 * np.isnan(labelled.ratios).sum(axis=0) > len(labelled)
    whole = np.flatnonzero(np.isfinite(labelled.ratios[:, ~dead]).all(axis=1))
    if 2 * len(whole) >= max(len(labelled), 2 * MIN_PRESSES):  # few are spoilt, as by a late fault
        labelled = labelled.select(whole)
    logs, xy, design = log_ratio(labelled.ratios), labelled.places, labelled.design
    extent = float(np.sqrt(np.mean(xy.var(axis=0)))) if len(xy) else 0.0
    held = labelled.press_numbers
    first = np.unique(held, return_index=True)[1]
    count = len(first)
    if count < MIN_PRESSES or extent == 0.0:
        raise DataError(
            f"learning touch positions needs at least {MIN_PRESSES} frames of one touch, at "
            f"different positions, and an untouched reference, got {count}; record more"
        )
    knowledge = SheetKnowledge.from_design(extent, design, labelled.protocol, logs.shape[1])
    recorded = Presses.from_frames(xy, np.ones(len(xy)), logs, held)
    law, label = None, labelled.label
    if label is None:
        strength = learned_strength(knowledge.kernel(MapChoice()), recorded)
    else:
        law = StrengthLaw.fit(lambda these: knowledge.density(MapChoice(), these), recorded, label)
        strength = law.strength(label)
    presses = replace(recorded, strength=strength)
    choices = knowledge.choices(presses)
    region = _Region.from_places(
        xy[first], design, GRID_POINTS if len(choices) == 1 else FEW_POINTS
    )
    grids, gains = _map_grids(knowledge, choices, presses, region)
    members = electrode_members(labelled.protocol, logs.shape[1])
    located, true, lost = _cross_validated(knowledge, choices, presses, region, members)
    middle = grids[0].middle
    away = located.place - middle  # and the factor of it that comes closest to the true places
    trust = float(np.clip(np.sum(away * (true - middle)) / max(np.sum(away**2), 1e-12), 0.0, 1.0))
    located = located.shrink_towards(middle, trust, extent)
    errors = np.linalg.norm(located.place - true, axis=1)
    off = errors / located.deviation
    few = COVARIANCE_PRESSES if knowledge.span is None else WITH_DESIGN
    variance = _mean_square(off) * (1.0 + few / count)
    lost = lost.shrink_towards(middle, trust, extent)
    off_lost = np.linalg.norm(lost.place - true, axis=1) / lost.deviation
    usual = float(np.quantile(np.abs(located.misfit).max(axis=1), 0.95))
    locator = PressLocator(
        grids[0],
        np.where(dead, 0.0, gains),
        np.where(dead, UNKNOWN_SCALE, recorded.unit_scale),
        xy.mean(axis=0),
        float(np.sqrt(variance)),
        max(MISFIT, (MISFIT_MARGIN + FEW_MARGIN / len(off)) * usual),
        tuple(grids[1:]),
        trust,
        extent,
        max(1.0, float(np.sqrt(_mean_square(off_lost) / _mean_square(off)))),
    )
    validated = {
        "presses": len(off),
        "mean_error_mm": float(errors.mean()) * 1e3,
        "error_ratio": float(np.sqrt(np.mean(off**2))),
    }
    return LearnedPlaces(locator, law, choices[0], validated)


def _mean_square(deviations: Array) -> float:
    """Mean square of errors over standard errors, outliers cut, few of them drawn to one."""
    square = float(np.sum(np.minimum(deviations, 5.0) ** 2))
    return (PRIOR_TESTS + square) / (PRIOR_TESTS + len(deviations))


@dataclass(frozen=True, slots=True, eq=False)
class _Region:
    """Grid over the part of the sheet where touches can be.

    Attributes:
        low: first point (2,) [m].
        step: step between points [m].
        points: all of them, row by row (n, 2) [m].
        log_prior: (rows, columns), uniform within the region.
    """

    low: Array
    step: float
    points: Array
    log_prior: Array

    @classmethod
    def from_places(cls, places: Array, design: SensorDesign | None, longer: int) -> "_Region":
        """Region within reach of the presses' places (n, 2), and within the outline where known.

        Reach is 1.5 times the distance of neighbours, were the presses on a square grid over the
        sheet. Where its size is not known, n places leave a margin of a share 1 / (n - 1) of their
        span on each side, as evenly distributed ones do.
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
        else:
            margin = span / (len(places) - 1)
            low, high = (
                np.maximum(low, places.min(axis=0) - margin),
                np.minimum(high, places.max(axis=0) + margin),
            )
        step = float((high - low).max()) / (longer - 1)
        columns, rows = (int(n) for n in np.floor((high - low) / step + 1e-9).astype(int) + 1)
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        points = low + step * np.stack([x.ravel(), y.ravel()], axis=1)
        near = np.min(np.linalg.norm(points[:, None] - places[:2000], axis=2), axis=1) <= reach
        if isinstance(outline, PlaneOutline):
            near &= outline.contains(points)
        log_prior = np.where(near, 0.0, -np.inf).reshape(rows, columns)
        return cls(low, step, points, log_prior)


def _map_grids(
    knowledge: SheetKnowledge, choices: Sequence[MapChoice], presses: Presses, region: _Region
) -> tuple[list[MapGrid], Array]:
    """Grids of the maps by each choice, for answers in units of the gains (C,) of the first."""
    s, (low, step, prior) = presses.strength, (region.low, region.step, region.log_prior)
    strength = np.array([s.mean(), s.std() + 0.15 * s.mean()])
    fits = [knowledge.fit(choice, presses)[:2] for choice in choices]
    units = fits[0][1]
    grids = []
    for maps, gains in fits:
        mean, variance = (v.reshape(*prior.shape, -1) for v in maps.evaluate(region.points))
        whitening = (units / gains)[:, None] * maps.whitening
        grids.append(
            MapGrid(low, step, mean, variance, prior, whitening, strength).merge_weak_maps()
        )
    return grids, units


def _cross_validated(
    knowledge: SheetKnowledge,
    choices: Sequence[MapChoice],
    presses: Presses,
    region: _Region,
    members: NDArray[np.bool_],
) -> tuple[Places, Array, Places]:
    """Places of presses that are left out by blocks in time, and the true ones (k, 2) [m].

    At last the places by the first choice without an electrode, another one in each block; members
    are the channels of each (E, C).
    """
    owners, first = np.unique(presses.owner, return_index=True)
    blocks = np.array_split(np.arange(len(owners)), min(FOLDS, len(owners)))
    located, true, lost = [], [], []
    for number, block in enumerate(blocks):
        tested = first[block[:: -(-len(block) // MAX_FOLD_PRESSES)]]
        training_presses = presses.select(~np.isin(presses.owner, owners[block]))
        grids, gains = _map_grids(knowledge, choices, training_presses, region)
        answers = presses.answers[tested] / gains
        located.append(mixture_places([grid.locate(answers) for grid in grids]))
        true.append(presses.places[tested])
        out = np.zeros(answers.shape, dtype=bool)
        if len(members):
            out |= members[number * len(members) // len(blocks)]
        lost.append(grids[0].locate(answers, out))
    return concatenate(located), np.concatenate(true), concatenate(lost)
