"""Frame sampling: scene, specimen and time of a frame, from a recipe and the frame's number.

Frame i depends only on (recipe, seed, i): every random quantity has its own generator, so frames
may be simulated in any order, anywhere, with the same result.
"""

import dataclasses
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.episode import PERIOD, Episodes, Timeline
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.specimen import (
    Specimen,
    draw_meter,
    draw_specimen,
    free_length,
    with_wider_gap,
)
from eitskin.datasets.store.schema import State
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.viscoelasticity import Prony, mixture
from eitskin.simulator.scene.scene import Scene

Integers = NDArray[np.int64]

# Share of the gel in the work of a press at 5 N (docs/results/studies.md, creep).
_GEL_SHARE = 0.43


class Stream(IntEnum):
    """Purpose of a random generator; no two purposes share one."""

    SCENE = 0
    NOISE = 1
    SPECIMEN = 2
    ORDER = 3
    BEND = 4
    SESSION = 5
    EPISODE = 6
    BOARD = 7


@dataclass(frozen=True, slots=True)
class Sample:
    """Scene, specimen and time of one frame.

    Attributes:
        index: number of the frame.
        specimen: number of the specimen.
        state: label of the frame.
        scene: at the frame's start.
        after: scene at the start of the episode's next frame; None without a change.
        episode: number of the episode; a snapshot is an episode of one frame.
        time: since the episode's start [s].
        period: until the next frame [s].
        session_time: since the first measurement of the specimen [s].
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
    """Random generator of `stream` for frame, specimen, block or episode `index`."""
    sequence = np.random.SeedSequence(recipe.seed, spawn_key=(int(stream), index))
    return np.random.default_rng(sequence)


def sample(recipe: Recipe, index: int) -> Sample:
    """Sample of frame `index` of the recipe."""
    if index < recipe.snapshots:
        return _snapshot(recipe, index)
    return _episode_frame(recipe, index)


@lru_cache(maxsize=256)
def specimen(recipe: Recipe, number: int) -> Specimen:
    """Specimen `number` of the recipe."""
    rng = generator(recipe, Stream.SPECIMEN, number)
    return draw_specimen(recipe.specimens, recipe.nominal(number), rng)


@lru_cache(maxsize=256)
def instrument(recipe: Recipe, number: int) -> Instrument:
    """Instrument of specimen `number` of the recipe."""
    nominal, spread = recipe.instrument, recipe.specimens
    if nominal.meter is None or not spread.board_loads:
        return nominal
    rng = generator(recipe, Stream.BOARD, number)
    return dataclasses.replace(nominal, meter=draw_meter(spread, nominal.meter, rng))


def specimen_numbers(recipe: Recipe, frames: range) -> list[int]:
    """Numbers of the specimens that occur in `frames`, consecutive ones, rising."""
    first, stop = frames.start, frames.stop
    found: set[int] = set()
    if first < recipe.snapshots:
        order = _block_order(recipe)
        last = min(stop, recipe.snapshots) - 1
        edges = np.searchsorted(order.starts, (first, last), side="right")
        found.update(_dealt(recipe, np.arange(edges[0] - 1, edges[1]), len(order.starts)).tolist())
    if stop > recipe.snapshots:
        episodes = _episode_order(recipe)
        ends = (max(first, recipe.snapshots), stop - 1)
        edges = np.searchsorted(episodes.starts, ends, side="right")
        found.update(episodes.specimens[edges[0] - 1 : edges[1]].tolist())
    return sorted(found)


def _dealt(recipe: Recipe, pieces: Integers, count: int) -> Integers:
    """Specimens of blocks or episodes `pieces` of `count`: equal shares, one after the other."""
    return pieces * recipe.specimens.count // count


def _snapshot(recipe: Recipe, index: int) -> Sample:
    order = _block_order(recipe)
    block = int(np.searchsorted(order.starts, index, side="right")) - 1
    group = recipe.scenes[order.groups[block]]
    number = int(order.numbers[block]) * group.per_bend + index - int(order.starts[block])
    untouched = group.draw_untouched(generator(recipe, Stream.BEND, block))
    rng = generator(recipe, Stream.SCENE, index)
    scene = group.draw(number, untouched, recipe.outline, rng)
    count, blocks = recipe.specimens.count, len(order.groups)
    made = int(_dealt(recipe, np.array(block), blocks))
    first = int(order.starts[-(-made * blocks // count)])
    if scene.support is not None:
        nominal = recipe.nominal(made).fixture
        widened = free_length(specimen(recipe, made).fixture) - free_length(nominal)
        scene = dataclasses.replace(scene, support=with_wider_gap(scene.support, widened))
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
class _BlockOrder:
    """Blocks of frames with one specimen and one bend, in the order of the dataset, (blocks,).

    Attributes:
        groups: number of each block's group of scenes.
        numbers: of the blocks within their groups.
        starts: number of each block's first frame.
    """

    groups: Integers
    numbers: Integers
    starts: Integers


@lru_cache(maxsize=4)
def _block_order(recipe: Recipe) -> _BlockOrder:
    """Random order of the blocks of all groups.

    Block j of a group of n gets a random position in ((j, j + 1) / n): each group is spread over
    the whole dataset at its own density, so that any part of the dataset, and so each specimen, has
    a balanced mix, and no regular pattern ties groups to specimens.
    """
    rng = generator(recipe, Stream.ORDER, 0)
    sizes = [group.blocks for group in recipe.scenes]
    groups = np.repeat(np.arange(len(sizes)), sizes)
    numbers = np.concatenate([np.arange(size) for size in sizes])
    positions = (numbers + rng.uniform(size=len(numbers))) / np.repeat(sizes, sizes)
    order = np.argsort(positions, kind="stable")
    groups, numbers = groups[order], numbers[order]
    full = np.array([group.per_bend for group in recipe.scenes])[groups]
    frames = np.array([group.frames for group in recipe.scenes])[groups]
    lengths = np.minimum(full, frames - numbers * full)
    return _BlockOrder(groups, numbers, np.cumsum(lengths) - lengths)


def _episode_frame(recipe: Recipe, index: int) -> Sample:
    order = _episode_order(recipe)
    episode = int(np.searchsorted(order.starts, index, side="right")) - 1
    kind = recipe.episodes[order.kinds[episode]]
    timeline = _timeline(recipe, kind, episode)
    relaxation = _relaxation(recipe.mechanics) if kind.relaxation else None
    frame = index - int(order.starts[episode])
    time = frame * kind.period
    scene, after = (timeline.scene(t, relaxation) for t in (time, (frame + 1) * kind.period))
    touched = any(not touch.released for touch in scene.touches)
    untouched = State.BEND if scene.bend.angle_deg else State.IDLE
    return Sample(
        index=index,
        specimen=int(order.specimens[episode]),
        state=State.TOUCH if touched else untouched,
        scene=scene,
        after=None if after == scene else after,
        episode=recipe.snapshots + episode,
        time=time,
        period=kind.period,
        session_time=float(order.session_starts[episode]) + time,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _EpisodeOrder:
    """Episodes in the order of the dataset, (episodes,).

    Attributes:
        kinds: number of each episode's entry in the recipe.
        starts: number of each episode's first frame.
        specimens: number of each episode's specimen.
        session_starts: time of each episode's start in the specimen's session, back to back [s].
    """

    kinds: Integers
    starts: Integers
    specimens: Integers
    session_starts: NDArray[np.float64]


@lru_cache(maxsize=4)
def _episode_order(recipe: Recipe) -> _EpisodeOrder:
    kinds = np.repeat(np.arange(len(recipe.episodes)), [each.count for each in recipe.episodes])
    frames = np.array([each.frames for each in recipe.episodes])[kinds]
    lasts = np.array([each.frames * each.period for each in recipe.episodes])[kinds]
    specimens = _dealt(recipe, np.arange(len(kinds)), len(kinds))
    begun = np.cumsum(lasts) - lasts
    first = np.searchsorted(specimens, specimens)
    starts = recipe.snapshots + np.cumsum(frames) - frames
    return _EpisodeOrder(kinds, starts, specimens, begun - begun[first])


@lru_cache(maxsize=16)
def _relaxation(mechanics: Mechanics) -> Prony:
    """Relaxation of a press in gel and encapsulation, for dropping released touches."""
    materials = (mechanics.gel_relaxation, mechanics.encapsulation_relaxation)
    return mixture(materials, (_GEL_SHARE, 1.0 - _GEL_SHARE))


@lru_cache(maxsize=256)
def _timeline(recipe: Recipe, kind: Episodes, episode: int) -> Timeline:
    return kind.draw(recipe.outline, generator(recipe, Stream.EPISODE, episode))
