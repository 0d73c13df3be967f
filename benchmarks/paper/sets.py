"""Datasets of `bench paper`: the paper's experiments on sensors that differ, and on one."""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.frames import generate_missing
from eitskin.benchmarks.results import Progress
from eitskin.datasets import Dataset, Recipe
from eitskin.datasets.recipe.episode import Episodes, ScriptedEpisode
from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Specimen, Specimens
from eitskin.geometry import ConfigurationError, SensorDesign

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
