"""Accuracy of pipelines trained for electrode layouts, beside the layouts' Cramer-Rao bounds.

Each layout gets frames of the same scenes, by recipes that differ in the electrodes alone, and a
pipeline that is trained on them in the same way. It is tested on sensors that it was not trained
with, which the bounds know nothing of: they are those of one sensor whose every property is known.
"""

import dataclasses
import hashlib
import time
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.layouts.bound import FORCE, Sampling, SheetBound
from eitskin.benchmarks.layouts.candidates import Layout
from eitskin.benchmarks.layouts.store import Watch, working
from eitskin.datasets.generation.generate import generate
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import open_dataset
from eitskin.files import write_file
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.method.settings import JointSettings, NetworkSettings, TrainingSettings
from eitskin.training.pipeline.pipeline import Pipeline

_VERSION = 3  # of what a result means; raised when the calculation changes
_ANGLES_DEG = (-20.0, 50.0)
_FORCES = (5.0, 12.0)  # trained with [N]
_MARGIN = Sampling().margin  # as the bounds have it [m]
_PLACE = 0.0004  # of electrodes at most: where a layout has them near corners, more cannot be [m]
_TEST_SEEDS = 1000  # added to the seed of training for other scenes, sensors and noise


@dataclass(frozen=True, slots=True)
class Lesson:
    """Amount of frames that each pipeline is trained on and tested with.

    Attributes:
        sensors: that are trained with; as many idle frames are.
        bends: untouched frames at angles of the operating window.
        touches: single presses of the flat sensor, and as many of bent ones.
        per_bend: presses of a bent sensor at one angle.
        test_sensors: others, and idle frames.
        test_bends, test_touches: bent frames, and presses of 10 N of the flat sensor.
        settings: how the networks of the joint method are trained.
        resolution: of the frames.
        seed: of scenes, sensors, noise and networks.
    """

    sensors: int = 80
    bends: int = 240
    touches: int = 800
    per_bend: int = 10
    test_sensors: int = 24
    test_bends: int = 96
    test_touches: int = 288
    settings: JointSettings = JointSettings(  # noqa: RUF009 - frozen
        proposals=NetworkSettings(2e-3, epochs=10, batch=256)
    )
    resolution: Resolution = "coarse"
    seed: int = 0

    def training(self, design: SensorDesign) -> Recipe:
        """Recipe of frames of sensors that differ as in the recipe `training`."""
        return self._recipe(
            design,
            self.seed,
            self.sensors,
            SceneGroup("bend", self.bends, _ANGLES_DEG),
            SceneGroup("touch", self.touches, force=_FORCES, margin=_MARGIN),
            SceneGroup(
                "touch", self.touches, _ANGLES_DEG, force=_FORCES, margin=_MARGIN,
                per_bend=self.per_bend,
            ),
        )  # fmt: skip

    def testing(self, design: SensorDesign) -> Recipe:
        """Recipe of frames of other sensors: bent ones, and flat ones pressed as for the bounds."""
        return self._recipe(
            design,
            self.seed + _TEST_SEEDS,
            self.test_sensors,
            SceneGroup("bend", self.test_bends, _ANGLES_DEG),
            SceneGroup("touch", self.test_touches, force=(FORCE, FORCE), margin=_MARGIN),
        )

    def _recipe(self, design: SensorDesign, seed: int, sensors: int, *scenes: SceneGroup) -> Recipe:
        spread = Recipe.shipped("training").specimens
        place = min(spread.electrode_place, _PLACE)
        return Recipe(
            name="layout",
            scenes=(SceneGroup("idle", sensors), *scenes),
            seed=seed,
            frames_per_shard=150,
            resolution=self.resolution,
            sensor=design,
            instrument=Instrument(),
            specimens=dataclasses.replace(spread, count=sensors, electrode_place=place),
        )


QUICK = Lesson(
    4, 130, 70, 35, 2, 8, 16,
    JointSettings(
        NetworkSettings(6e-3, epochs=2, batch=512), NetworkSettings(2e-3, epochs=1, batch=8)
    ),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Learned:
    """Scores of a pipeline on sensors that it was not trained with, and their standard errors.

    Standard errors are over sensors: `errors` has that of each score of the same name.

    Attributes:
        layout: its name.
        measurements: in a frame.
        bound_rms_mm, bound_90_mm: of the place, over the sheet, by its Cramer-Rao bound [mm].
        bound_angle_deg: of the untouched sheet's angle [deg].
        error_mm, error_rms_mm, error_90_mm: mean, root mean square and 90th percentile of the
            distance between true and found places that belong together [mm]; None where none do.
        found: share of the presses that were found no more than 15 mm off.
        false: found touches that are none, per press.
        angle_deg: root mean square of the error of the angle, bent and untouched [deg].
        errors: standard errors of "error_mm", "found", "false" and "angle_deg", by name.
        frames: trained on.
        seconds: processor time of the training [s].
    """

    layout: str
    measurements: int
    bound_rms_mm: float
    bound_90_mm: float
    bound_angle_deg: float
    error_mm: float | None
    error_rms_mm: float | None
    error_90_mm: float | None
    found: float
    false: float
    angle_deg: float | None
    errors: dict[str, float]
    frames: int
    seconds: float


def learn_all(
    layouts: Sequence[tuple[Layout, SheetBound]],
    folder: Path,
    *,
    lesson: Lesson,
    workers: int = 1,
    watch: Watch = lambda _: None,
) -> list[Learned]:
    """Train and test a pipeline for each layout; what is finished in `folder` is not done again.

    Args:
        layouts: with their bounds.
        folder: for frames and results.
        lesson: how much each is trained on.
        workers: layouts at a time, each in a process.
        watch: called with the name of each finished layout.

    Raises PartialError where files cannot be written or a process died; run again to go on.
    """
    paths = [_path(each, folder, lesson) for each in layouts]
    by_path = dict(zip(paths, layouts, strict=True))  # the same one may come twice
    missing = {path: each for path, each in by_path.items() if _read(path) is None}
    with working(workers) as pool:
        if pool is None:
            for path, each in missing.items():
                _learn(each, path, lesson)
                watch(each[0].name)
        else:
            futures = {
                pool.submit(_learn, each, path, lesson): each[0].name
                for path, each in missing.items()
            }
            for future in as_completed(futures):
                future.result()
                watch(futures[future])
    found = zip(layouts, map(_read, paths), strict=True)
    return [
        dataclasses.replace(learned, layout=layout.name)
        for (layout, _), learned in found
        if learned is not None
    ]


def _frames(folder: Path, recipe: Recipe) -> Dataset:
    """The dataset of a recipe, made where it is not there yet, by one more process."""
    place = folder / hashlib.sha256(recipe.to_toml().encode()).hexdigest()[:20]
    place.mkdir(parents=True, exist_ok=True)
    generate(recipe, place, workers=1, resume=True)
    return open_dataset(place)


def _path(judged: tuple[Layout, SheetBound], folder: Path, lesson: Lesson) -> Path:
    """Path named by a hash of all inputs of the result."""
    layout, bound = judged
    recipes = [each(layout.design).to_toml() for each in (lesson.training, lesson.testing)]
    asked = (_VERSION, *recipes, dataclasses.asdict(lesson), bound.place.tolist())
    return folder / f"{hashlib.sha256(msgspec.json.encode(asked)).hexdigest()[:20]}.json"


def _read(path: Path) -> Learned | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=Learned)
    except (OSError, msgspec.MsgspecError):
        return None


def _learn(judged: tuple[Layout, SheetBound], path: Path, lesson: Lesson) -> None:
    layout, bound = judged
    training, testing = (
        _frames(path.parent, recipe)
        for recipe in (lesson.training(layout.design), lesson.testing(layout.design))
    )
    settings = TrainingSettings(method="joint", joint=lesson.settings, seed=lesson.seed)
    start = time.process_time()
    pipeline = Pipeline.fit(training, settings)
    seconds = time.process_time() - start
    learned = scored(layout, bound, pipeline, testing, seconds)
    write_file(path, msgspec.json.encode(learned) + b"\n")


def scored(
    layout: Layout, bound: SheetBound, pipeline: Pipeline, testing: Dataset, seconds: float
) -> Learned:
    """Scores of a pipeline on test frames, beside the bound of its layout."""
    found = Evaluation.of(pipeline, testing)
    distance, place = 1e3 * found.matches.error, 1e3 * bound.place
    some = len(distance) > 0
    touches = found.report.touches["1"]
    return Learned(
        layout=layout.name,
        measurements=len(layout.protocol),
        bound_rms_mm=float(np.sqrt(np.mean(place**2))),
        bound_90_mm=float(np.percentile(place, 90)),
        bound_angle_deg=bound.untouched_deg,
        error_mm=float(distance.mean()) if some else None,
        error_rms_mm=float(np.sqrt(np.mean(distance**2))) if some else None,
        error_90_mm=float(np.percentile(distance, 90)) if some else None,
        found=touches.found,
        false=touches.false_per_touch,
        angle_deg=found.report.bend.rmse_deg,
        errors=_standard_errors(found),
        frames=pipeline.trained_on["frames"],
        seconds=seconds,
    )


def _standard_errors(found: Evaluation) -> dict[str, float]:
    """Standard errors over sensors of the scores of an evaluation; none where one has no frame."""
    frames, matches = found.dataset, found.matches
    sensor, pressed = frames.specimen, frames.touch_count > 0
    hits = np.bincount(matches.frame, minlength=len(frames))
    off = np.bincount(matches.frame, 1e3 * matches.error, len(frames))
    untouched = ~pressed & (frames.bend_angle_deg != 0.0)
    squares = (found.predictions.bend_angle_deg - frames.bend_angle_deg) ** 2
    errors = {
        "error_mm": ratio_error(off, hits, sensor),
        "found": ratio_error(hits[pressed], pressed[pressed], sensor[pressed]),
        "false": ratio_error(matches.false[pressed], pressed[pressed], sensor[pressed]),
        "angle_deg": ratio_error(squares[untouched], untouched[untouched], sensor[untouched])
        / (2.0 * np.sqrt(squares[untouched].mean())),
    }
    return {name: float(each) for name, each in errors.items() if np.isfinite(each)}


def ratio_error(above: NDArray[Any], below: NDArray[Any], sensor: NDArray[Any]) -> float:
    """Standard error of sum(above) / sum(below) over sensors, whose frames are taken together.

    Args:
        above, below: of each frame (n,).
        sensor: number of each frame's sensor (n,).
    """
    over, under = (np.bincount(sensor, each.astype(float)) for each in (above, below))
    many = len(over)
    if many < 2 or not under.any():
        return float("nan")
    ratio = over.sum() / under.sum()
    left = over - ratio * under
    return float(np.sqrt(many / (many - 1.0) * np.sum(left**2)) / under.sum())
