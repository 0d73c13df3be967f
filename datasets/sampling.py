"""From a recipe and the number of a frame to what that frame shows.

Frame i depends only on (recipe, seed, i): each has generators of its own, so frames may be made
in any order, anywhere, and come out the same.
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe import Recipe
from eitskin.datasets.specimen import Specimen, draw_specimen
from eitskin.datasets.state import State
from eitskin.simulator import Scene


class Stream(IntEnum):
    """What a random generator is for; no two uses share one."""

    SCENE = 0
    NOISE = 1
    REFERENCE_NOISE = 2
    SPECIMEN = 3
    ORDER = 4


@dataclass(frozen=True, slots=True)
class Sample:
    """What frame `index` shows: which specimen, in which scene, labelled how."""

    index: int
    specimen: int
    state: State
    scene: Scene


def generator(recipe: Recipe, stream: Stream, index: int) -> np.random.Generator:
    """The random generator of `stream` for frame, or specimen, `index`."""
    sequence = np.random.SeedSequence(recipe.seed, spawn_key=(int(stream), index))
    return np.random.default_rng(sequence)


def sample(recipe: Recipe, index: int) -> Sample:
    """What frame `index` of the recipe shows."""
    groups, numbers = _order(recipe)
    group = recipe.scenes[groups[index]]
    rng = generator(recipe, Stream.SCENE, index)
    scene = group.draw(int(numbers[index]), recipe.sensor.outline, rng)
    return Sample(index, index % recipe.specimens.count, group.label, scene)


def specimen(recipe: Recipe, number: int) -> Specimen:
    """Specimen `number` of the recipe."""
    rng = generator(recipe, Stream.SPECIMEN, number)
    return draw_specimen(recipe.specimens, recipe.sensor, recipe.hinge, rng)


@lru_cache(maxsize=4)
def _order(recipe: Recipe) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each frame its group and its number within the group.

    Frame j of a group of n gets a random place in ((j, j + 1) / n): all groups run through the
    whole dataset at their own density, so that any first part of it is a balanced mix, and no
    rhythm ties groups to specimens.
    """
    rng = generator(recipe, Stream.ORDER, 0)
    sizes = [group.frames for group in recipe.scenes]
    groups = np.repeat(np.arange(len(sizes)), sizes)
    numbers = np.concatenate([np.arange(size) for size in sizes])
    places = (numbers + rng.uniform(size=len(numbers))) / np.repeat(sizes, sizes)
    order = np.argsort(places, kind="stable")
    return groups[order], numbers[order]
