"""Scores of a pipeline in one world, as it is and calibrated by known angles."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.transfer.worlds import World
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.state import State
from eitskin.errors import DataError, EitskinError
from eitskin.training.evaluation.matching import match
from eitskin.training.evaluation.metrics import root_mean_square
from eitskin.training.method.predictions import Predictions
from eitskin.training.pipeline.pipeline import Pipeline

Array = NDArray[np.float64]
Figures = dict[str, float]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Predictions of one sensor's frames beside the truth.

    Attributes:
        right: whether the state of each untouched frame (n,) is right.
        angle: error of the angle of each untouched frame (n,) [deg].
        angle_ratio: the same over its standard error (n,); NaN without one.
        false: touches found in untouched frames.
        place: errors of found touches (t,) [m].
        place_ratio: the same over their standard errors (t,); NaN without one.
        touches: number of true touches.
    """

    right: NDArray[np.bool_]
    angle: Array
    angle_ratio: Array
    false: int
    place: Array
    place_ratio: Array
    touches: int

    @classmethod
    def of(cls, data: Dataset, said: Predictions) -> "Judged":
        """Judge predictions for the frames of a dataset."""
        free = data.state != State.TOUCH
        angle = said.bend_angle_deg[free] - data.bend_angle_deg[free]
        errors, ratios = [], []
        for row in np.flatnonzero(~free):
            true = np.stack([data.touch_x[row], data.touch_y[row]], axis=1)
            true = true[np.isfinite(true[:, 0])]
            rows, columns = match(true, said.touches[row].place)
            distance = np.linalg.norm(true[rows] - said.touches[row].place[columns], axis=1)
            errors.append(distance)
            ratios.append(distance / said.touches[row].deviation[columns])
        return cls(
            said.state[free] == data.state[free],
            angle,
            angle / said.bend_deviation_deg[free],
            sum(len(said.touches[row]) for row in np.flatnonzero(free)),
            np.concatenate(errors),
            np.concatenate(ratios),
            int(data.touch_count[~free].sum()),
        )


def scores(pipeline: Pipeline, world: World, angles: int) -> Figures:
    """Figures of a pipeline in a world, each sensor calibrated by some of its known angles.

    A sensor that the calibration refuses is judged uncalibrated, and counted.

    Args:
        pipeline: as trained.
        world: the sensors.
        angles: number of known angles to calibrate with; 0 for none.
    """
    judged, refused = [], 0
    for number in np.unique(world.frames.specimen):
        own = dataclasses.replace(pipeline)
        if angles:
            mine = world.known.select(world.known.specimen == number)
            rows = _spread_angles(mine, angles)
            try:
                own.calibrate([mine.frame(row) for row in rows], mine.bend_angle_deg[rows])
            except EitskinError:
                refused += 1
        data = world.frames.select(world.frames.specimen == number)
        judged.append(Judged.of(data, own.perceive(data)))
    return dict(_figures(judged)) | {"sensors refused": refused / len(judged)}


def _spread_angles(mine: Dataset, count: int) -> list[int]:
    """Rows of the flat frame and of `count` bent ones, the largest angles first.

    Raises DataError where there are too few.
    """
    flat = np.flatnonzero(mine.state == State.IDLE)
    bent = np.flatnonzero(mine.state == State.BEND)
    if len(bent) < count or not len(flat):
        raise DataError(f"expected {count} known angles and a flat frame, got {len(bent)}")
    order = bent[np.argsort(-np.abs(mine.bend_angle_deg[bent]), kind="stable")]
    return [*flat.tolist(), *order[:count].tolist()]


def _figures(judged: list[Judged]) -> Iterator[tuple[str, float]]:
    def joined(name: str) -> Array:
        return np.concatenate([getattr(each, name) for each in judged])

    place, ratio = joined("place"), joined("place_ratio")
    free = joined("right")
    yield "untouched states right", float(free.mean())
    yield "angle, rms [deg]", root_mean_square(joined("angle"))
    yield "angle, error over standard error", root_mean_square(joined("angle_ratio"))
    yield "touches in untouched frames", sum(each.false for each in judged) / len(free)
    yield "touches found", len(place) / sum(each.touches for each in judged)
    if len(place):
        yield "place, mean [mm]", 1e3 * float(place.mean())
        yield "place, error over standard error", root_mean_square(ratio)
