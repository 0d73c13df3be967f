"""From a recipe and the number of a frame to what that frame shows.

Frame i depends only on (recipe, seed, i): everything random has a generator of its own, so frames
may be made in any order, anywhere, and come out the same.
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.episode import PERIOD, Episodes, Timeline
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.specimen import Specimen, draw_specimen
from eitskin.datasets.store.state import State
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.viscoelasticity import Prony, mixture
from eitskin.simulator.scene.scene import Scene

Integers = NDArray[np.int64]

# Of what a press takes, the part that the gel carries: benchmarks/studies/creep.py, at 5 N.
_GEL_SHARE = 0.43


class Stream(IntEnum):
    """What a random generator is for; no two uses share one."""

    SCENE = 0
    NOISE = 1
    SPECIMEN = 2
    ORDER = 3
    BEND = 4
    SESSION = 5
    EPISODE = 6


@dataclass(frozen=True, slots=True)
class Sample:
    """What frame `index` shows.

    Attributes:
        index: of the frame.
        specimen: number of the sensor.
        state: label.
        scene: when the frame begins.
        after: the scene when the next frame of the episode begins; None where nothing moves.
        episode: number of the episode; a snapshot is one by itself.
        time: since the episode began [s].
        period: until the next frame [s].
        session_time: since the specimen was first measured [s].
    """

    index: int
    specimen: int
    state: State
    scene: Scene
    after: Scene | None
    episode: int
    time: float
    period: float
    session_time: float


def generator(recipe: Recipe, stream: Stream, index: int) -> np.random.Generator:
    """The random generator of `stream` for frame, specimen, block or episode `index`."""
    sequence = np.random.SeedSequence(recipe.seed, spawn_key=(int(stream), index))
    return np.random.default_rng(sequence)


def sample(recipe: Recipe, index: int) -> Sample:
    """What frame `index` of the recipe shows."""
    if index < recipe.snapshots:
        return _snapshot(recipe, index)
    return _episode_frame(recipe, index)


@lru_cache(maxsize=256)
def specimen(recipe: Recipe, number: int) -> Specimen:
    """Specimen `number` of the recipe."""
    nominal = Specimen(recipe.sensor, recipe.hinge, recipe.mechanics)
    return draw_specimen(recipe.specimens, nominal, generator(recipe, Stream.SPECIMEN, number))


def _snapshot(recipe: Recipe, index: int) -> Sample:
    order = _order(recipe)
    block = int(np.searchsorted(order.starts, index, side="right")) - 1
    group = recipe.scenes[order.groups[block]]
    number = int(order.numbers[block]) * group.per_bend + index - int(order.starts[block])
    bend = group.draw_bend(generator(recipe, Stream.BEND, block))
    rng = generator(recipe, Stream.SCENE, index)
    scene = group.draw(number, bend, recipe.outline, rng)
    count, blocks = recipe.specimens.count, len(order.groups)
    made = block * count // blocks
    first = int(order.starts[-(-made * blocks // count)])
    return Sample(
        index=index,
        specimen=made,
        state=group.label,
        scene=scene,
        after=None,
        episode=index,
        time=0.0,
        period=PERIOD,
        session_time=(index - first) * PERIOD,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Order:
    """Blocks of frames that share specimen and bend, in the order of the dataset, (blocks,).

    Attributes:
        groups: which group of scenes each is of.
        numbers: of the blocks within their groups.
        starts: number of the first frame.
    """

    groups: Integers
    numbers: Integers
    starts: Integers


@lru_cache(maxsize=4)
def _order(recipe: Recipe) -> _Order:
    """For each block its group and its number within the group.

    Block j of a group of n gets a random place in ((j, j + 1) / n): all groups run through the
    whole dataset at their own density, so that any part of it, and so each specimen, has a
    balanced mix, and no rhythm ties groups to specimens.
    """
    rng = generator(recipe, Stream.ORDER, 0)
    sizes = [group.blocks for group in recipe.scenes]
    groups = np.repeat(np.arange(len(sizes)), sizes)
    numbers = np.concatenate([np.arange(size) for size in sizes])
    places = (numbers + rng.uniform(size=len(numbers))) / np.repeat(sizes, sizes)
    order = np.argsort(places, kind="stable")
    groups, numbers = groups[order], numbers[order]
    full = np.array([group.per_bend for group in recipe.scenes])[groups]
    frames = np.array([group.frames for group in recipe.scenes])[groups]
    lengths = np.minimum(full, frames - numbers * full)
    return _Order(groups, numbers, np.cumsum(lengths) - lengths)


def _episode_frame(recipe: Recipe, index: int) -> Sample:
    all_episodes = _episodes(recipe)
    episode = int(np.searchsorted(all_episodes.starts, index, side="right")) - 1
    kind = recipe.episodes[all_episodes.kinds[episode]]
    timeline = _timeline(recipe, kind, episode)
    memory = _memory(recipe.mechanics) if kind.relaxation else None
    frame = index - int(all_episodes.starts[episode])
    time = frame * kind.period
    scene, after = (timeline.scene(t, memory) for t in (time, (frame + 1) * kind.period))
    touched = any(not touch.released for touch in scene.touches)
    untouched = State.BEND if scene.bend.angle_deg else State.IDLE
    return Sample(
        index=index,
        specimen=int(all_episodes.specimens[episode]),
        state=State.TOUCH if touched else untouched,
        scene=scene,
        after=None if after == scene else after,
        episode=recipe.snapshots + episode,
        time=time,
        period=kind.period,
        session_time=float(all_episodes.session_starts[episode]) + time,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Episodes:
    """Episodes in the order of the dataset, (episodes,).

    Attributes:
        kinds: which of the recipe's each is of.
        starts: number of the first frame.
        specimens: that they are of.
        session_starts: when they begin in the specimen's session, one after the other [s].
    """

    kinds: Integers
    starts: Integers
    specimens: Integers
    session_starts: NDArray[np.float64]


@lru_cache(maxsize=4)
def _episodes(recipe: Recipe) -> _Episodes:
    kinds = np.repeat(np.arange(len(recipe.episodes)), [each.count for each in recipe.episodes])
    frames = np.array([each.frames for each in recipe.episodes])[kinds]
    lasts = np.array([each.frames * each.period for each in recipe.episodes])[kinds]
    specimens = np.arange(len(kinds)) * recipe.specimens.count // len(kinds)
    begun = np.cumsum(lasts) - lasts
    first = np.searchsorted(specimens, specimens)
    starts = recipe.snapshots + np.cumsum(frames) - frames
    return _Episodes(kinds, starts, specimens, begun - begun[first])


@lru_cache(maxsize=16)
def _memory(mechanics: Mechanics) -> Prony:
    """By which a press is forgotten; how it creeps is for the simulator to say."""
    materials = (mechanics.gel_relaxation, mechanics.encapsulation_relaxation)
    return mixture(materials, (_GEL_SHARE, 1.0 - _GEL_SHARE))


@lru_cache(maxsize=256)
def _timeline(recipe: Recipe, kind: Episodes, episode: int) -> Timeline:
    return kind.draw(recipe.outline, generator(recipe, Stream.EPISODE, episode))
