"""Errors of an adapted pipeline against the number of labelled frames, cross-validated in time.

The frames are split into blocks of neighbours in time. Each block is tested with what was learned
from some frames of the others: neighbours in time are too similar to learn from and to test on.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets import Dataset
from eitskin.extras import require
from eitskin.geometry import DataError
from eitskin.training.adaptation.press_fit import (
    MIN_PRESSES,
    LabelledPresses,
    learn_places,
    touch_places,
)
from eitskin.training.evaluation.scores import match_distances, root_mean_square
from eitskin.training.method.known_frames import FLAT_DEG
from eitskin.training.method.observations import Observations
from eitskin.training.method.settings import single_touches
from eitskin.training.method.targets import untouched_angles
from eitskin.training.pipeline.pipeline import Pipeline
from eitskin.training.twin.labelled_frames import evenly_spaced

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Progress = Callable[[int, int], None]

BLOCKS = 3
MAX_BLOCK_FRAMES = 100  # frames of a block
COUNTS = (5, 20, 50, 200, 1000)
TREES = 100
ADAPTED, TRAINED, FORESTS = "adapted", "as trained", "ExtraTrees"
ALONE = "without the design"
NOTHING = np.zeros(0)


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

    @property
    def missed_percentage(self) -> float | None:
        """Share of the single touches that were not found [%]; None where all were, or none is."""
        return None if self.found in (None, 1.0) else 100.0 * (1.0 - self.found)


Errors = tuple[Array, Array]
"""Errors of angles (n,) [deg], and of places (m,) [m]; NaN for touches that were not found."""
Gathered = defaultdict[tuple[str, int], list[Errors]]
"""Errors in each block, by method and number of labelled frames."""


def press_curve(
    presses: LabelledPresses, progress: Progress = lambda _done, _total: None
) -> tuple[CurvePoint, ...]:
    """Errors of positions learned from presses in the order of time, and of ExtraTrees.

    Where the design is known, also those without it. Raises DataError for fewer presses than can
    be learned from in each block.
    """
    gathered: Gathered = defaultdict(list)
    named = {ADAPTED: presses}
    if presses.design is not None:
        named[ALONE] = replace(presses, design=None)
    logs = np.log(np.where(presses.ratios > 0, presses.ratios, 1.0))
    for chosen, tested in _trials(np.arange(len(presses)), MIN_PRESSES, progress):
        places = {
            name: learn_places(distances.select(chosen)).locator.apply(presses.ratios[tested])
            for name, distances in named.items()
        }
        places[FORESTS] = _forest(logs[chosen], presses.places[chosen], logs[tested])
        for name, name_errors in places.items():
            errors = np.linalg.norm(name_errors - presses.places[tested], axis=1)
            gathered[name, len(chosen)].append((NOTHING, errors))
    return _points(gathered)


def pipeline_curve(
    pipeline: Pipeline, data: Dataset, progress: Progress = lambda _done, _total: None
) -> tuple[CurvePoint, ...]:
    """Errors of a pipeline of states, adapted to one specimen, as trained, and of ExtraTrees.

    Raises DataError for fewer labelled frames than there are blocks.
    """
    gathered: Gathered = defaultdict(list)
    order = np.lexsort((np.arange(len(data)), data.time, data.episode))
    labelled = order[(_is_bent(data) | (data.touch_count == 1))[order]]
    judged: Rows | None = None
    for chosen, tested in _trials(labelled, 1, progress):
        part, shown, mine = data.select(tested), data.select(chosen), replace(pipeline)
        if judged is not tested:
            gathered[TRAINED, 0].append(_pipeline_errors(pipeline, part))
            judged = tested
        try:
            mine.adapt(shown)
        except DataError:  # few frames may contradict their angles; more may not
            continue
        gathered[ADAPTED, len(chosen)].append(_pipeline_errors(mine, part))
        gathered[FORESTS, len(chosen)].append(_forest_errors(shown, part))
    return _points(gathered)


def _pipeline_errors(pipeline: Pipeline, data: Dataset) -> Errors:
    said, bent, touched = pipeline.perceive(data), _is_bent(data), single_touches(data)
    angles, distances = said.bend_angle_deg[bent] - data.bend_angle_deg[bent], [NOTHING]
    if pipeline.targets.touches:
        for place, row in zip(touch_places(data, touched), touched, strict=True):
            matched = match_distances(place, said.touches[row].place[:1])
            distances.append(np.array(matched or [np.nan]))
    return angles[np.isfinite(angles)], np.concatenate(distances)


def _forest_errors(shown: Dataset, data: Dataset) -> Errors:
    """Errors of regressions on changes, of angles from the flat sensor, of places by touches."""
    learned, tested = Observations.from_dataset(shown), Observations.from_dataset(data)
    angles = places = NOTHING
    learning_rows, test_rows = _is_bent(shown), _is_bent(data)
    if learning_rows.any() and test_rows.any():
        truth = shown.bend_angle_deg[learning_rows].astype(float)
        angles = _forest(learned.static[learning_rows], truth, tested.static[test_rows])
        angles = angles - data.bend_angle_deg[test_rows]
    learned_touches, tested_touches = single_touches(shown), single_touches(data)
    if len(learned_touches) and len(tested_touches):
        truth = touch_places(shown, learned_touches)
        estimates = _forest(learned.dynamic[learned_touches], truth, tested.dynamic[tested_touches])
        places = np.linalg.norm(estimates - touch_places(data, tested_touches), axis=1)
    return angles, places


def _forest(features: Array, truth: Array, asked: Array) -> Array:
    """Predictions (m, K) of extremely randomised trees for features (m, F); 0 for bad channels."""
    ensemble = require("sklearn.ensemble", "training")
    forest = ensemble.ExtraTreesRegressor(TREES, random_state=0)
    predicted: Array = forest.fit(np.nan_to_num(features), truth).predict(np.nan_to_num(asked))
    return predicted


def _points(gathered: Gathered) -> tuple[CurvePoint, ...]:
    points = []
    for (name, count), blocks in gathered.items():
        angles, places = (np.concatenate(errors) for errors in zip(*blocks, strict=True))
        detected = np.isfinite(places)
        points.append(
            CurvePoint(
                name,
                count,
                root_mean_square(angles) if angles.size else None,
                1e3 * float(places[detected].mean()) if detected.any() else None,
                float(detected.mean()) if detected.size else None,
            )
        )
    return tuple(points)


def _is_bent(data: Dataset) -> NDArray[np.bool_]:
    """Whether each frame (n,) is untouched and bent by a known angle."""
    return np.asarray(np.abs(untouched_angles(data)) > FLAT_DEG)


def _trials(rows: Rows, fewest: int, progress: Progress) -> Iterator[tuple[Rows, Rows]]:
    """Rows to learn from, ever more of them, and rows to test, of each block of neighbours in time.

    At least `fewest` rows are learned from, outside of the block, and at most `MAX_BLOCK_FRAMES`
    tested. Raises DataError where a block leaves too few rows to learn from.
    """
    parts = np.array_split(rows, BLOCKS)
    if len(rows) < BLOCKS or len(rows) - max(map(len, parts)) < fewest:
        needed = max(BLOCKS, -(-fewest * BLOCKS // (BLOCKS - 1)))
        raise DataError(
            f"expected {needed} labelled frames or more to estimate errors, got {len(rows)}; label "
            "or record more"
        )
    most = len(rows) - max(map(len, parts))
    counts = sorted({count for count in COUNTS if fewest <= count < most} | {most})
    for number, part in enumerate(parts):
        rest = np.setdiff1d(rows, part, assume_unique=True)
        tested = part[evenly_spaced(len(part), MAX_BLOCK_FRAMES)]
        for step, count in enumerate(counts):
            progress(number * len(counts) + step, BLOCKS * len(counts))
            yield rest[evenly_spaced(len(rest), count)], tested
    progress(BLOCKS * len(counts), BLOCKS * len(counts))
