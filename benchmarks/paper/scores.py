"""The paper's experiments: datasets, scores of a pipeline, and their bounds."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import Progress
from eitskin.datasets import Dataset, Recipe, State, generate, open_dataset
from eitskin.datasets.recipe.episode import Episodes, ScriptedEpisode
from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Specimen, Specimens
from eitskin.geometry import Bend, ConfigurationError, SensorDesign
from eitskin.simulator import Scene, Simulator, Touch
from eitskin.training import Estimate, Pipeline
from eitskin.training.evaluation.cramer_rao import SceneDerivatives, scene_derivatives
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.scores import (
    TouchScore,
    determination,
    root_mean_square,
)

Array = NDArray[np.float64]
Figures = dict[str, float]
"""By name, as `paper_table.LINES` has them; what a pipeline does not give is left out."""
SPECIMENS = {"indentation": 8, "touch": 40, "states": 40, "bending": 10, "demo": 1}
"""Experiments, and how many unseen sensors each is made with."""
CALIBRATED_SETS = ("bending", "touch")
"""Experiments whose unseen sensors are calibrated."""
KNOWN_DEG = (-20.0, 15.0, 30.0, 42.5, 50.0)
"""Angles that a sensor is calibrated with, next to the flat one."""
REFERENCE_FRAMES = 8
QUICK = 10  # times fewer frames
OWN = 500  # added to seeds: other scenes and other noise on the sensor that was trained on


@dataclass(frozen=True, slots=True, eq=False)
class Sets:
    """Datasets of one seed.

    Attributes:
        training: training of one sensor, for the paper's pipeline.
        own: the experiments on that sensor, by name.
        unseen: the same on sensors that no pipeline was trained with.
        calibration: the unseen sensors of two experiments, flat and bent by `KNOWN_DEG`.
        recipe: recipe of the unseen touches, which has the instrument and the spread of all.
    """

    training: Dataset
    own: dict[str, Dataset]
    unseen: dict[str, Dataset]
    calibration: dict[str, Dataset]
    recipe: Recipe


def make(folder: Path, seed: int, quick: bool, workers: int, progress: Progress) -> Sets:
    """Generate the datasets that `folder` does not have yet, and read all of them.

    Raises ConfigurationError where `folder` holds frames of other recipes.
    """
    all_recipes = dict(recipes(seed, quick))
    datasets = {
        name: generate_missing(
            recipe, folder / name, workers, progress, f"frames, seed {seed}: {name}"
        )
        for name, recipe in all_recipes.items()
    }
    # A pipeline knows the nominal sensor; what is special about this one nobody knows.
    training = dataclasses.replace(datasets["training"], design=SensorDesign.reference())
    own, unseen = (
        {name: datasets[f"{kind}-{name}"] for name in SPECIMENS} for kind in ("own", "unseen")
    )
    calibration = {name: datasets[f"calibration-{name}"] for name in CALIBRATED_SETS}
    return Sets(training, own, unseen, calibration, all_recipes["unseen-touch"])


def generate_missing(
    recipe: Recipe, folder: Path, workers: int, progress: Progress, part: str
) -> Dataset:
    """Generate the frames of a recipe that `folder` does not have yet, and open all.

    Progress is of a `part`. Raises ConfigurationError where `folder` holds another recipe's.
    """
    resume = (folder / "recipe.toml").is_file()
    generate(recipe, folder, workers, partial(progress, part), resume=resume)
    return open_dataset(folder)


def recipes(seed: int, quick: bool) -> Iterator[tuple[str, Recipe]]:
    """Recipes of `Sets`, named "training", "own-...", "unseen-..." and "calibration-...".

    Instrument and spread of the sensors are those of the recipe "training"; none is chosen here.
    """
    if seed < 0:
        raise ConfigurationError(f"a seed must not be negative, got {seed}")
    unseen = {name: _experiment(name, seed, quick) for name in SPECIMENS}
    single_sensor = _only_sensor(unseen["bending"])
    yield "training", single_sensor(_training(unseen))
    for name, recipe in unseen.items():
        yield f"own-{name}", dataclasses.replace(single_sensor(recipe), seed=recipe.seed + OWN)
        yield f"unseen-{name}", recipe
    for name in CALIBRATED_SETS:
        yield f"calibration-{name}", _calibration(unseen[name])


def in_episode(data: Dataset) -> NDArray[np.bool_]:
    """Mask (n,) of the frames that are followed or preceded by others in time."""
    return np.asarray(np.bincount(data.episode)[data.episode] > 1)


def episodes(data: Dataset) -> list[Dataset]:
    """Frame numbers of each episode of more than one frame."""
    numbers = np.unique(data.episode[in_episode(data)])
    return [data.select(data.episode == number) for number in numbers]


def _experiment(name: str, seed: int, quick: bool) -> Recipe:
    """Recipe of the paper on a finer mesh, with the sensors and the instrument of "training"."""
    recipe, training = Recipe.from_shipped(f"paper_{name}"), Recipe.from_shipped("training")
    count = max(1, SPECIMENS[name] // (QUICK if quick else 1))
    return dataclasses.replace(
        recipe,
        seed=recipe.seed + 1000 * (1 + seed),
        resolution="standard",
        instrument=training.instrument,
        specimens=dataclasses.replace(training.specimens, count=count),
        reference_frames=REFERENCE_FRAMES,
        scenes=tuple(_fewer(scene) if quick else scene for scene in recipe.scenes),
        episodes=tuple(_cycle_every_sensor(episode, count) for episode in recipe.episodes),
    )


def _fewer(group: SceneGroup) -> SceneGroup:
    if group.positions:
        return dataclasses.replace(group, repeats=1)
    return dataclasses.replace(group, count=-(-group.count // QUICK))


def _cycle_every_sensor(episode: Episodes, sensors: int) -> Episodes:
    """Recipe with one cycle of its sequence for each sensor, so that sensors count, not cycles."""
    if isinstance(episode, ScriptedEpisode):
        episode = dataclasses.replace(episode, repeats=1)
    return dataclasses.replace(episode, count=sensors)


def _only_sensor(recipe: Recipe) -> Callable[[Recipe], Recipe]:
    """Function that replaces the sensors of a recipe by one, drawn like those of `recipe`."""
    drawn: Specimen = specimen(dataclasses.replace(recipe, seed=recipe.seed + OWN), 0)

    def replace_sensor(other: Recipe) -> Recipe:
        return dataclasses.replace(
            other,
            sensor=drawn.design,
            fixture=drawn.fixture,
            mechanics=drawn.mechanics,
            grid=drawn.grid,
            specimens=Specimens(),
            episodes=tuple(dataclasses.replace(episode, count=1) for episode in other.episodes),
        )

    return replace_sensor


def _training(experiments: dict[str, Recipe]) -> Recipe:
    """Recipe of the paper's training: states, bends and touches on the bent sensor."""
    scenes = (experiments[name].scenes for name in ("states", "bending", "touch"))
    first = experiments["states"]
    return dataclasses.replace(
        first,
        name="paper_training",
        description="States, bends, and touches on the bent sensor, of one sensor.",
        seed=first.seed + OWN // 2,
        resolution="fast",
        scenes=tuple(group for part in scenes for group in part),
    )


def _calibration(experiment: Recipe) -> Recipe:
    """Recipe with every sensor flat and at each known angle, in the session of its other frames.

    The groups are as long as there are sensors, so that each sensor has one frame of each.
    """
    count = experiment.specimens.count
    bends = (SceneGroup("bend", count=count, angle_deg=(angle, angle)) for angle in KNOWN_DEG)
    return dataclasses.replace(
        experiment,
        name="paper_calibration",
        description="Sensors flat and at five known angles.",
        scenes=(SceneGroup("idle", count=count), *bends),
        episodes=(),
    )


def scores(pipeline: Pipeline, sets: Mapping[str, Dataset]) -> Figures:
    """All figures of the experiments, without the calibrated ones."""
    figures = touch_scores(pipeline, sets["touch"])
    single = Evaluation.from_dataset(pipeline, sets["indentation"]).report.touches.get("1")
    figures |= {} if single is None else _touches("indentation", single)
    accuracy = Evaluation.from_dataset(pipeline, sets["states"]).report.states.accuracy
    for name, share in accuracy.items():
        figures |= _optional_figure(f"state.{name}", share)
    figures |= bend_scores(pipeline, sets["bending"])
    figures |= demo_scores(pipeline, sets["demo"])
    return figures


def touch_scores(pipeline: Pipeline, data: Dataset) -> Figures:
    """Scores of one touch at many bends, of several at some, of all together, and frame times."""
    report = Evaluation.from_dataset(pipeline, data).report
    figures: Figures = {}
    for group in ("1", "2", "3", "4", "several"):
        if group in report.touches:
            figures |= _touches(f"touch.{group}", report.touches[group])
    groups = [report.touches[group] for group in ("1", "2", "3", "4") if group in report.touches]
    figures |= _optional_figure("touch.state", report.states.bent_touch_accuracy)
    figures |= _optional_figure("touch.angle_deg", report.bend.touched_rmse_deg)
    errors = [(s.mean_error_mm, s.frames) for s in groups if s.mean_error_mm is not None]
    if errors:
        values, weights = zip(*errors, strict=True)
        figures["touch.error_mm"] = float(np.average(values, weights=weights))
    p50, p99 = np.percentile(frame_times(pipeline, data, range(len(data))), [50, 99]).tolist()
    return figures | {"time.p50_ms": 1e3 * p50, "time.p99_ms": 1e3 * p99}


def frame_times(
    pipeline: Pipeline,
    data: Dataset,
    rows: Sequence[int],
    clock: Callable[[], float] = time.perf_counter,
) -> NDArray[np.float64]:
    """Time [s] of `process` for each of the frames in `rows`, after its two references."""
    seconds, template = np.zeros(len(rows)), data.frame(0)
    for number, row in enumerate(rows):
        pipeline.reset()
        flat, free = data.reference[data.specimen[row]], data.touch_reference[row]
        for n, values in enumerate((flat, free, data.impedance[row])):
            impedance = values.astype(np.complex128)
            frame = dataclasses.replace(template, impedance=impedance, time=0.3 * n, number=n)
            start = clock()
            pipeline.process(frame)
            seconds[number] = clock() - start
    pipeline.reset()
    return seconds


def bend_scores(pipeline: Pipeline, data: Dataset) -> Figures:
    """Scores of the bend angle, of single frames and of a sequence in its order."""
    if not pipeline.targets.angle:
        return {}
    alone = data.select(~in_episode(data) & (data.state == State.BEND))
    angle = alone.bend_angle_deg.astype(float)
    estimated = pipeline.perceive(alone).bend_angle_deg
    figures = {"bend.angle_deg": root_mean_square(estimated - angle)}
    figures |= _optional_figure("bend.r2", determination(angle, estimated))
    errors = [
        estimate.bend_angle_deg - angle
        for sequence in episodes(data)
        for estimate, angle in zip(replay(pipeline, sequence), sequence.bend_angle_deg, strict=True)
    ]
    return figures | {"sequence.angle_deg": root_mean_square(errors)}


def demo_scores(pipeline: Pipeline, data: Dataset) -> Figures:
    """Scores of the demonstration: states and angles."""
    estimates = list(replay(pipeline, data))
    right = np.array([estimate.state for estimate in estimates]) == data.state
    figures: Figures = {"demo.state": float(right.mean())} if pipeline.targets.states else {}
    if pipeline.targets.angle:
        estimated = np.array([estimate.bend_angle_deg for estimate in estimates], dtype=float)
        figures["demo.angle_deg"] = root_mean_square(estimated - data.bend_angle_deg)
    return figures


def calibrated_scores(
    pipeline: Pipeline, sets: Mapping[str, Dataset], known_sets: Mapping[str, Dataset]
) -> Figures:
    """Scores of the angle once the pipeline is calibrated to each sensor by frames in `known_sets`.

    None for a method that cannot be calibrated.
    """
    if not (pipeline.targets.angle and pipeline.method.adapts):
        return {}
    bending, touch = sets["bending"], sets["touch"]
    alone = bending.select(~in_episode(bending) & (bending.state == State.BEND))
    free = _calibrated_angles(pipeline, alone, known_sets["bending"])
    touched = _calibrated_angles(pipeline, touch, known_sets["touch"])
    found = {"calibrated.angle_deg": root_mean_square(free - alone.bend_angle_deg)}
    found |= _optional_figure(
        "calibrated.r2", determination(alone.bend_angle_deg.astype(float), free)
    )
    return found | {"calibrated.touched_deg": root_mean_square(touched - touch.bend_angle_deg)}


def _calibrated_angles(pipeline: Pipeline, data: Dataset, known_frames: Dataset) -> Array:
    angles = np.full(len(data), np.nan)
    for number in np.unique(data.specimen):
        mine = known_frames.select(known_frames.specimen == number)
        own = dataclasses.replace(pipeline)  # the one that was trained stays as it is
        own.calibrate([mine.frame(row) for row in range(len(mine))], mine.bend_angle_deg)
        rows = np.flatnonzero(data.specimen == number)
        angles[rows] = own.perceive(data.select(rows)).bend_angle_deg
    return angles


def replay(pipeline: Pipeline, data: Dataset) -> Iterator[Estimate]:
    """Estimates of an episode's frames in their order, the first as reference."""
    pipeline.reset()
    for row in range(len(data)):
        yield pipeline.process(data.frame(row))
    pipeline.reset()


def _touches(name: str, score: TouchScore) -> Figures:
    figures = {f"{name}.found": score.found, f"{name}.false": score.false_per_touch}
    figures |= _optional_figure(f"{name}.error_mm", score.mean_error_mm)
    figures |= _optional_figure(f"{name}.deviation_mm", score.deviation_mm)
    return figures | {f"{name}.ssim.{picture}": value for picture, value in score.ssim.items()}


def _optional_figure(name: str, value: float | None) -> Figures:
    return {} if value is None else {name: value}


def bounds(sets: Mapping[str, Dataset], recipe: Recipe, count: int, seed: int) -> dict[str, float]:
    """Cramer-Rao bounds of the figures of `scores`, by the same names, over some frames.

    For the nominal sensor, and the white noise of the recipe's instrument alone. Places: the mean
    distance [mm], against the mean of as many frames of the sensor at that bend as the recipe says,
    the angle unknown. Angles: root mean square [deg], of one frame against a flat reference
    without noise, touches unknown. `count` frames of each kind are drawn by `seed`.
    """
    simulator = Simulator(recipe.sensor, "fast", recipe.fixture, mechanics=recipe.mechanics)
    rng = np.random.default_rng(seed)
    touch, bending = sets["touch"], sets["bending"]
    kinds = {"indentation": sets["indentation"]}
    for number in np.unique(touch.touch_count).tolist():
        kinds[f"touch.{number}"] = touch.select(touch.touch_count == number)
    limits, angles = {}, []
    for name, data in kinds.items():
        placed = []
        for derivative in _derivatives(simulator, data, count, rng):
            noise = derivative.noise(recipe.instrument, simulator.full_scale)
            placed.append(derivative.bound(noise, recipe.reference_frames).distance)
            if name != "indentation":
                angles.append(derivative.bound(noise, np.inf).angle_deg)
        limits[f"{name}.error_mm"] = 1e3 * float(np.mean(np.concatenate(placed)))
    bent = [
        each.bound(each.noise(recipe.instrument, simulator.full_scale), np.inf).angle_deg
        for each in _derivatives(simulator, bending.select(bending.state == State.BEND), count, rng)
    ]
    limits["touch.angle_deg"] = limits["calibrated.touched_deg"] = root_mean_square(angles)
    limits["bend.angle_deg"] = limits["calibrated.angle_deg"] = root_mean_square(bent)
    return limits


def _derivatives(
    simulator: Simulator, data: Dataset, count: int, rng: np.random.Generator
) -> Iterator[SceneDerivatives]:
    """Derivatives of the scenes of some frames."""
    for row in rng.permutation(len(data))[:count].tolist():
        yield scene_derivatives(simulator, frame_scene(data, row))


def frame_scene(data: Dataset, row: int) -> Scene:
    """Scene of one frame with known touches."""
    places = zip(data.touch_x[row], data.touch_y[row], data.touch_force[row], strict=True)
    touches = (Touch(float(x), float(y), float(f)) for x, y, f in places if np.isfinite(x))
    return Scene(Bend(float(data.bend_angle_deg[row])), tuple(touches))
