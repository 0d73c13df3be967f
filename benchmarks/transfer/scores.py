"""Scores of a pipeline in one world, as it is and adapted by labelled frames."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.paper.sets import KNOWN_DEG
from eitskin.benchmarks.transfer.worlds import World
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.errors import DataError, EitskinError
from eitskin.training.evaluation.matching import match
from eitskin.training.evaluation.scores import root_mean_square
from eitskin.training.method.predictions import Predictions
from eitskin.training.pipeline.pipeline import Pipeline

Array = NDArray[np.float64]
Figures = dict[str, float]


@dataclass(frozen=True, slots=True)
class Labelled:
    """Numbers of labelled frames that a sensor is adapted by, beside one of the flat sensor."""

    angles: int
    presses: int

    def __str__(self) -> str:
        """Name in rows of the results."""
        return f"{self.angles} angles" + f", {self.presses} presses" * bool(self.presses)

    def rows(self, mine: Dataset) -> list[int]:
        """Rows of the flat frame, of bent ones and of presses among the known frames of a sensor.

        The fixed angles come first, the largest of them before the others. All presses are taken
        where there are fewer.

        Raises DataError where there are too few angles.
        """
        flat = np.flatnonzero(mine.state == State.IDLE)
        bent = np.flatnonzero(mine.state == State.BEND)
        if len(bent) < self.angles or not len(flat):
            raise DataError(
                f"expected {self.angles} known angles and a flat frame, got {len(bent)} angles"
            )
        angles = mine.bend_angle_deg[bent]
        order = bent[np.lexsort((-np.abs(angles), ~np.isin(angles, KNOWN_DEG)))]
        presses = np.flatnonzero(mine.state == State.TOUCH)[: self.presses]
        return [int(flat[0]), *order[: self.angles].tolist(), *presses.tolist()]


@dataclass(frozen=True, slots=True, eq=False)
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


def scores(pipeline: Pipeline, world: World, labelled: Labelled) -> Figures:
    """Figures of a pipeline in a world, adapted to each sensor by some of its known frames.

    A sensor that is refused is judged with the pipeline as trained, and counted.

    Args:
        pipeline: as trained.
        world: the sensors.
        labelled: numbers of the frames to adapt by; of none, the pipeline stays as trained.
    """
    judged, refused = [], 0
    for number in np.unique(world.frames.specimen):
        own = dataclasses.replace(pipeline)
        if labelled.angles or labelled.presses:
            mine = world.known.select(world.known.specimen == number)
            try:
                own.adapt(mine.select(labelled.rows(mine)))
            except EitskinError:
                refused += 1
        data = world.frames.select(world.frames.specimen == number)
        judged.append(Judged.of(data, own.perceive(data)))
    return dict(_figures(judged)) | {"sensors refused": refused / len(judged)}


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
