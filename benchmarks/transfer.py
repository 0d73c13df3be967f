"""Run of `bench transfer`: every pipeline in every world, by the labelled frames.

A pipeline is scored as it is, and adapted to each sensor by labelled frames. Cramer-Rao bounds say
what the noise of one frame leaves of any method.
"""

import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.paper.scores import scene_of
from eitskin.benchmarks.paper.sets import KNOWN_DEG
from eitskin.benchmarks.results import Progress, Report, ReportTable, measured
from eitskin.benchmarks.transfer_worlds import FEW, World, make, recipes
from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.errors import DataError, EitskinError
from eitskin.training.evaluation.cramer_rao import scene_derivatives
from eitskin.training.evaluation.scores import match, root_mean_square
from eitskin.training.method.predictions import Predictions
from eitskin.training.pipeline.pipeline import Pipeline

Array = NDArray[np.float64]
Figures = dict[str, float]

BOUND = "Cramer-Rao bound"
_COLUMNS = {
    "states [%]": ("untouched states right", 100.0),
    "angle [deg]": ("angle, rms [deg]", 1.0),
    "/ SE": ("angle, error over standard error", 1.0),
    "false [%]": ("touches in untouched frames", 100.0),
    "found [%]": ("touches found", 100.0),
    "place [mm]": ("place, mean [mm]", 1.0),
    "place / SE": ("place, error over standard error", 1.0),
    "refused [%]": ("sensors refused", 100.0),
}
"""Figure of each column, and the factor to its unit."""


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


def judge(data: Dataset, said: Predictions) -> dict[str, Array]:
    """Judge predictions of one sensor's frames.

    Returns, of the n untouched frames, whether the state is "right", the error of the "angle"
    [deg], "angle_ratio", the same over its standard error, and how many touches are "false"; of the
    found touches the error of the "place" [m] and "place_ratio"; and "touches" of each frame.
    Ratios are NaN without a standard error.
    """
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
    return {
        "right": said.state[free] == data.state[free],
        "angle": angle,
        "angle_ratio": angle / said.bend_deviation_deg[free],
        "false": np.array([len(said.touches[row]) for row in np.flatnonzero(free)]),
        "place": np.concatenate(errors),
        "place_ratio": np.concatenate(ratios),
        "touches": data.touch_count[~free],
    }


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
        judged.append(judge(data, own.perceive(data)))
    return dict(_judged_figures(judged)) | {"sensors refused": refused / len(judged)}


def _judged_figures(judged: list[dict[str, Array]]) -> Iterator[tuple[str, float]]:
    of = {name: np.concatenate([each[name] for each in judged]) for name in judged[0]}
    yield "untouched states right", float(of["right"].mean())
    yield "angle, rms [deg]", root_mean_square(of["angle"])
    yield "angle, error over standard error", root_mean_square(of["angle_ratio"])
    yield "touches in untouched frames", float(of["false"].sum() / len(of["right"]))
    yield "touches found", float(len(of["place"]) / of["touches"].sum())
    if len(of["place"]):
        yield "place, mean [mm]", 1e3 * float(of["place"].mean())
        yield "place, error over standard error", root_mean_square(of["place_ratio"])


TOUCHED, BENT = 4, 4  # frames of each sensor, evenly among its frames


def bounds(world: World, recipe: Recipe, progress: Progress) -> Figures:
    """Bounds of some frames of every sensor, each of the sensor as it truly is.

    The white noise of the recipe's instrument is all that they count: shape, contacts and bends of
    the sensor are known. Places: mean distance, against the mean of as many untouched frames as the
    recipe says, angle and force unknown. Angles: root mean square, of untouched frames against a
    flat reference without noise.

    Args:
        world: of the frames.
        recipe: that they were made from.
        progress: called after every sensor.
    """
    placed, angles = [], []
    numbers = world.frames.specimen_number
    for number in np.unique(world.frames.specimen).tolist():
        made = specimen(recipe, int(numbers[number]))
        simulator = made.simulator(recipe.sensor, recipe.resolution, recipe.protocol)
        full_scale = simulator.full_scale_on(recipe.instrument)
        for state, count in ((State.TOUCH, TOUCHED), (State.BEND, BENT)):
            for row in _rows(world, number, state, count):
                scene = scene_of(world.frames, row)
                found = scene_derivatives(simulator, scene, instrument=recipe.instrument)
                noise = found.noise(recipe.instrument, full_scale)
                if state == State.TOUCH:
                    placed.append(found.bound(noise, recipe.reference_frames).distance)
                else:
                    angles.append(found.bound(noise, np.inf).angle_deg)
        progress(f"bounds: {world.name}", number + 1, len(numbers))
    return {
        "place, mean [mm]": 1e3 * float(np.mean(np.concatenate(placed))),
        "angle, rms [deg]": root_mean_square(np.array(angles)),
    }


def _rows(world: World, number: int, state: State, count: int) -> Iterator[int]:
    """Some frames of a sensor in one state, evenly spaced among these."""
    data = world.frames
    rows = np.flatnonzero((data.specimen == number) & (data.state == state))
    yield from rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int)].tolist()


LABELLED = tuple(Labelled(*each) for each in ((0, 0), (1, 0), (5, 0), (5, 15), (20, 80)))
"""Labelled frames that a sensor is adapted by."""


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one pipeline in one world, adapted by some labelled frames."""

    pipeline: str
    world: str
    labelled: Labelled
    figures: Figures


def run(
    pipelines: Mapping[str, Path],
    folder: Path,
    seed: int,
    quick: bool,
    workers: int,
    progress: Progress,
) -> Report:
    """Measure pipelines, saved at the paths given, on sensors of every world.

    Raises ConfigurationError where `folder` holds frames of other recipes.
    """
    began = time.perf_counter()
    worlds = make(folder, seed, quick, workers, progress)
    limits = {
        world.name: bounds(world, recipes(world.name, seed, quick)[0], progress)
        for world in worlds
        if world.name not in FEW
    }
    rows = tuple(_scored(pipelines, worlds, progress))
    headings = ("pipeline", "world", "labelled", *_COLUMNS)
    cells = [(row.pipeline, row.world, str(row.labelled), *_cells(row.figures)) for row in rows]
    cells += [(BOUND, world, "", *_cells(figures)) for world, figures in limits.items()]
    return Report(
        results=measured("transfer", _figures(rows, limits), began=began, seed=seed, quick=quick),
        rows=[
            {"pipeline": row.pipeline, "world": row.world, "labelled": str(row.labelled)}
            | {name: row.figures.get(name) for name, _ in _COLUMNS.values()}
            for row in rows
        ],
        tables=[ReportTable(headings, cells, 3)],
    )


def _figures(rows: Sequence[Row], limits: Mapping[str, Figures]) -> Iterator[tuple[str, float]]:
    """All figures by name, bounds last."""
    for row in rows:
        for name, value in row.figures.items():
            yield f"{row.pipeline} / {row.world}, {row.labelled} / {name}", value
    for world, figures in limits.items():
        for name, value in figures.items():
            yield f"{BOUND} / {world} / {name}", value


def _cells(figures: Figures) -> Iterator[str]:
    for name, factor in _COLUMNS.values():
        yield f"{factor * figures[name]:.3g}" if name in figures else "-"


def _scored(
    pipelines: Mapping[str, Path], worlds: Sequence[World], progress: Progress
) -> Iterator[Row]:
    total = len(worlds) * len(pipelines)
    for number, (name, path) in enumerate(pipelines.items()):
        pipeline = Pipeline.load(path)
        for place, world in enumerate(worlds):
            progress("scores", number * len(worlds) + place, total)
            for labelled in LABELLED:
                if labelled.presses and world.name in FEW:
                    continue
                yield Row(name, world.name, labelled, scores(pipeline, world, labelled))
    progress("scores", total, total)
