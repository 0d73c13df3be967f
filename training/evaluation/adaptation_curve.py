"""Errors of an adapted pipeline against the number of labelled frames, cross-validated in time.

The frames are split into blocks of neighbours in time. Each block is tested with what was learned
from some frames of the others: neighbours in time are too similar to learn from and to test on.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import UNKNOWN_STATE, State
from eitskin.errors import DataError
from eitskin.extras import require
from eitskin.training.adaptation.labelled_presses import LabelledPresses, places_of
from eitskin.training.adaptation.press_fit import FEWEST, learn_places
from eitskin.training.evaluation.matching import localisation
from eitskin.training.method.known_frames import FLAT_DEG
from eitskin.training.method.observations import Observations
from eitskin.training.pipeline.pipeline import Pipeline

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Progress = Callable[[int, int], None]

BLOCKS = 3
MOST_TESTED = 100  # frames of a block
COUNTS = (5, 20, 50, 200, 1000)
TREES = 100
ADAPTED, TRAINED, FORESTS = "adapted", "as trained", "ExtraTrees"
ALONE = "without the design"


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """Errors of one method after a number of labelled frames, over all blocks.

    Attributes:
        method: name.
        frames: number of labelled frames that were learned from; 0 for the pipeline as trained.
        angle_deg: root mean square error of untouched frames [deg]; None where there are none.
        place_mm: mean error of single touches that were found [mm]; None where there are none.
        found: share of the single touches that were found, within 15 mm by a pipeline of states
            and anywhere by the others; None where there are none.
    """

    method: str
    frames: int
    angle_deg: float | None = None
    place_mm: float | None = None
    found: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return asdict(self)


@dataclass(slots=True)
class _Errors:
    """Errors gathered over the blocks: of angles [deg] and places [m], and touches in all."""

    angles: list[float]
    places: list[float]
    touches: int = 0

    def point(self, method: str, frames: int) -> CurvePoint:
        angle = float(np.sqrt(np.mean(np.square(self.angles)))) if self.angles else None
        place = 1e3 * float(np.mean(self.places)) if self.places else None
        found = len(self.places) / self.touches if self.touches else None
        return CurvePoint(method, frames, angle, place, found)


def press_curve(
    presses: LabelledPresses, progress: Progress = lambda _done, _total: None
) -> tuple[CurvePoint, ...]:
    """Errors of learned touch positions, beside those without the design and of ExtraTrees.

    Args:
        presses: labelled presses of one sensor, in the order of time.
        progress: called with the numbers of steps done and in all.

    Raises DataError for fewer presses than can be learned from in each block.
    """
    blocks = list(_blocks(np.arange(len(presses)), FEWEST))
    counts = _counts(min(len(rest) for rest, _ in blocks), FEWEST)
    named = {ADAPTED: presses}
    if presses.design is not None:
        named[ALONE] = replace(presses, design=None)
    found: dict[tuple[str, int], _Errors] = {}
    steps = len(blocks) * len(counts)
    for at, (rest, tested) in enumerate(blocks):
        for step, count in enumerate(counts):
            progress(at * len(counts) + step, steps)
            chosen = _spaced(rest, count)
            truth = presses.places[tested]
            for name, known in named.items():
                learned = learn_places(known.select(chosen))
                place = learned.locator.apply(presses.ratios[tested])
                _note(found, name, count, places=np.linalg.norm(place - truth, axis=1))
            logs = np.log(np.where(presses.ratios > 0, presses.ratios, 1.0))
            place = _forest(logs[chosen], presses.places[chosen], logs[tested])
            _note(found, FORESTS, count, places=np.linalg.norm(place - truth, axis=1))
    progress(steps, steps)
    return _points(found)


def pipeline_curve(
    pipeline: Pipeline, data: Dataset, progress: Progress = lambda _done, _total: None
) -> tuple[CurvePoint, ...]:
    """Errors of an adapted pipeline of states, beside those as it was trained and of ExtraTrees.

    Args:
        pipeline: as trained.
        data: labelled frames of one specimen.
        progress: called with the numbers of steps done and in all.

    Raises DataError for fewer labelled frames than there are blocks.
    """
    order = np.lexsort((np.arange(len(data)), data.time, data.episode))
    bent, touched = _bent(data), data.touch_count == 1
    labelled = order[(bent | touched)[order]]
    blocks = list(_blocks(labelled, 1))
    counts = _counts(min(len(rest) for rest, _ in blocks), 1)
    found: dict[tuple[str, int], _Errors] = {}
    steps = len(blocks) * len(counts)
    for at, (rest, tested) in enumerate(blocks):
        part = data.select(tested)
        _judge(found, TRAINED, 0, pipeline, part)
        for step, count in enumerate(counts):
            progress(at * len(counts) + step, steps)
            shown = data.select(_spaced(rest, count))
            mine = replace(pipeline)
            try:
                mine.adapt(shown)
            except DataError:  # few frames may contradict their angles; more may not
                continue
            _judge(found, ADAPTED, count, mine, part)
            _judge_forests(found, count, shown, part)
    progress(steps, steps)
    return _points(found)


def _judge(
    found: dict[tuple[str, int], _Errors], name: str, count: int, pipeline: Pipeline, data: Dataset
) -> None:
    said = pipeline.perceive(data)
    angles: Array = np.zeros(0)
    if pipeline.targets.angle and (bent := _bent(data)).any():
        angles = said.bend_angle_deg[bent] - data.bend_angle_deg[bent]
    places, touches = np.zeros(0), 0
    if pipeline.targets.touches and (touched := np.flatnonzero(data.touch_count == 1)).size:
        truth = places_of(data, touched)
        pairs = [(truth[[k]], said.touches[row].place[:1]) for k, row in enumerate(touched)]
        matched = localisation(pairs)
        places, touches = np.array(matched.errors), matched.true
    _note(found, name, count, angles, places, touches)


def _judge_forests(
    found: dict[tuple[str, int], _Errors], count: int, shown: Dataset, data: Dataset
) -> None:
    """Regressions of angles on changes from the flat sensor, of places on those by touches."""
    learned, tested = (_changes(each) for each in (shown, data))
    angles, places, touches = np.zeros(0), np.zeros(0), 0
    if (known := _bent(shown)).any() and (bent := _bent(data)).any():
        angle = _forest(
            learned[0][known], shown.bend_angle_deg[known].astype(float), tested[0][bent]
        )
        angles = angle - data.bend_angle_deg[bent]
    known, touched = shown.touch_count == 1, data.touch_count == 1
    if known.any() and touched.any():
        place = _forest(
            learned[1][known], places_of(shown, np.flatnonzero(known)), tested[1][touched]
        )
        truth = places_of(data, np.flatnonzero(touched))
        places, touches = np.linalg.norm(place - truth, axis=1), len(truth)
    _note(found, FORESTS, count, angles, places, touches)


def _forest(features: Array, truth: Array, asked: Array) -> Array:
    """Predictions (m, K) of extremely randomised trees for features (m, F)."""
    ensemble = require("sklearn.ensemble", "training")
    forest = ensemble.ExtraTreesRegressor(TREES, random_state=0).fit(features, truth)
    predicted: Array = forest.predict(asked)
    return predicted


def _note(
    found: dict[tuple[str, int], _Errors],
    name: str,
    count: int,
    angles: Array | Sequence[float] = (),
    places: Array | Sequence[float] = (),
    touches: int | None = None,
) -> None:
    errors = found.setdefault((name, count), _Errors([], []))
    errors.angles += [float(each) for each in angles if np.isfinite(each)]
    errors.places += [float(each) for each in places]
    errors.touches += len(places) if touches is None else touches


def _points(found: dict[tuple[str, int], _Errors]) -> tuple[CurvePoint, ...]:
    return tuple(errors.point(name, count) for (name, count), errors in found.items())


def _bent(data: Dataset) -> NDArray[np.bool_]:
    """Whether each frame (n,) is untouched and bent by a known angle."""
    untouched = (data.state != State.TOUCH) & (data.state != UNKNOWN_STATE)
    angle = np.nan_to_num(data.bend_angle_deg)
    return np.asarray(untouched & (data.touch_count == 0) & (np.abs(angle) > FLAT_DEG))


def _changes(data: Dataset) -> tuple[Array, Array]:
    """Changes (n, C) from the flat and from the untouched sensor; 0 for bad channels."""
    seen = Observations.of(data)
    return np.nan_to_num(seen.static).astype(float), np.nan_to_num(seen.dynamic).astype(float)


def _blocks(rows: Rows, fewest: int) -> Iterator[tuple[Rows, Rows]]:
    """Rows outside and, at most `MOST_TESTED`, inside of each block of neighbours in time.

    Raises DataError where a block leaves too few rows to learn from.
    """
    parts = np.array_split(rows, BLOCKS)
    if len(rows) < BLOCKS or len(rows) - max(map(len, parts)) < fewest:
        needed = max(BLOCKS, -(-fewest * BLOCKS // (BLOCKS - 1)))
        raise DataError(
            f"expected {needed} labelled frames or more to tell errors by, got {len(rows)}; label "
            "or record more"
        )
    for part in parts:
        yield np.setdiff1d(rows, part, assume_unique=True), _spaced(part, MOST_TESTED)


def _counts(most: int, fewest: int) -> list[int]:
    """Numbers of frames to learn from, up to `most`."""
    return sorted({each for each in COUNTS if fewest <= each < most} | {most})


def _spaced(rows: Rows, count: int) -> Rows:
    """At most so many of the rows, evenly spaced."""
    if len(rows) <= count:
        return rows
    spaced: Rows = rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]
    return spaced
