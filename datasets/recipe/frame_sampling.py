"""Frame sampling: scene, specimen and time of a frame, from a recipe and the frame's number.

Frame i depends only on (recipe, seed, i): every random quantity has its own generator, so frames
may be simulated in any order, anywhere, with the same result.
"""

import dataclasses
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Any

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

# Share of the gel in the work of a press at 5 N.
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
        scene: scene at the frame's start.
        after: scene at the start of the episode's next frame; None without a change.
        episode: number of the episode; a snapshot is an episode of one frame.
        time: since the episode's start [s].
        period: time until the next frame [s].
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
    numbers: set[int] = set()
    spans = (_blocks, 0, recipe.snapshots), (_episodes, recipe.snapshots, recipe.frames)
    for pieces, start, stop in spans:
        inside = range(max(frames.start, start), min(frames.stop, stop))
        if inside:
            first, last = (pieces(recipe).number(frame) for frame in (inside[0], inside[-1]))
            numbers.update(pieces(recipe).specimens[first : last + 1].tolist())
    return sorted(numbers)


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """Blocks of frames with one bend, or episodes, in the order of the dataset, (pieces,).

    Attributes:
        kinds: number of each piece's group of scenes, or entry of episodes, in the recipe.
        numbers: numbers of the pieces within their kinds.
        starts: number of each piece's first frame.
        specimens: number of each piece's specimen: equal shares, one after the other.
        begun: duration of the specimen's pieces before, which follow each other.
    """

    kinds: Integers
    numbers: Integers
    starts: Integers
    specimens: Integers
    begun: NDArray[Any]

    @classmethod
    def from_lengths(
        cls,
        recipe: Recipe,
        which: tuple[Integers, Integers],
        lengths: Integers,
        lasts: NDArray[Any],
    ) -> "_Pieces":
        """Pieces of given lengths [frames] from frame 0 on; `which` are `kinds` and `numbers`."""
        count = len(lengths)
        specimens = np.arange(count) * recipe.specimens.count // count
        before = np.cumsum(lasts) - lasts
        begun = before - before[np.searchsorted(specimens, specimens)]
        return cls(*which, np.cumsum(lengths) - lengths, specimens, begun)

    def number(self, frame: int) -> int:
        """Number of the piece that holds a frame."""
        return int(np.searchsorted(self.starts, frame, side="right")) - 1


@lru_cache(maxsize=4)
def _blocks(recipe: Recipe) -> _Pieces:
    """Blocks of all groups in a random order; they last as many periods as they have frames.

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
    return _Pieces.from_lengths(recipe, (groups, numbers), lengths, lengths)


@lru_cache(maxsize=4)
def _episodes(recipe: Recipe) -> _Pieces:
    """Episodes, entry after entry of the recipe; they last as many seconds."""
    kinds = np.repeat(np.arange(len(recipe.episodes)), [each.count for each in recipe.episodes])
    frames = np.array([episode.frames for episode in recipe.episodes])[kinds]
    lasts = np.array([episode.frames * episode.period for episode in recipe.episodes])[kinds]
    dealt = _Pieces.from_lengths(recipe, (kinds, np.arange(len(kinds))), frames, lasts)
    return dataclasses.replace(dealt, starts=recipe.snapshots + dealt.starts)


def _snapshot(recipe: Recipe, index: int) -> Sample:
    blocks = _blocks(recipe)
    block = blocks.number(index)
    group, specimen_number = recipe.scenes[blocks.kinds[block]], int(blocks.specimens[block])
    frame = index - int(blocks.starts[block])
    untouched = group.draw_untouched(generator(recipe, Stream.BEND, block))
    rng = generator(recipe, Stream.SCENE, index)
    number = int(blocks.numbers[block]) * group.per_bend + frame
    scene = group.draw(number, untouched, recipe.outline, rng)
    if scene.support is not None:
        nominal = recipe.nominal(specimen_number).fixture
        widened = free_length(specimen(recipe, specimen_number).fixture) - free_length(nominal)
        scene = dataclasses.replace(scene, support=with_wider_gap(scene.support, widened))
    return Sample(
        index=index,
        specimen=specimen_number,
        state=group.label,
        scene=scene,
        after=None,
        episode=index,
        time=0.0,
        period=PERIOD,
        session_time=(int(blocks.begun[block]) + frame) * PERIOD,
    )


def _episode_frame(recipe: Recipe, index: int) -> Sample:
    episodes = _episodes(recipe)
    episode = episodes.number(index)
    kind = recipe.episodes[episodes.kinds[episode]]
    timeline = _timeline(recipe, kind, episode)
    relaxation = _relaxation(recipe.mechanics) if kind.relaxation else None
    frame = index - int(episodes.starts[episode])
    time = frame * kind.period
    scene, after = (timeline.scene(t, relaxation) for t in (time, (frame + 1) * kind.period))
    touched = any(not touch.released for touch in scene.touches)
    untouched = State.BEND if scene.bend.angle_deg else State.IDLE
    return Sample(
        index=index,
        specimen=int(episodes.specimens[episode]),
        state=State.TOUCH if touched else untouched,
        scene=scene,
        after=None if after == scene else after,
        episode=recipe.snapshots + episode,
        time=time,
        period=kind.period,
        session_time=float(episodes.begun[episode]) + time,
    )


@lru_cache(maxsize=16)
def _relaxation(mechanics: Mechanics) -> Prony:
    """Relaxation of a press in gel and encapsulation, for dropping released touches."""
    materials = (mechanics.gel_relaxation, mechanics.encapsulation_relaxation)
    return mixture(materials, (_GEL_SHARE, 1.0 - _GEL_SHARE))


@lru_cache(maxsize=256)
def _timeline(recipe: Recipe, kind: Episodes, episode: int) -> Timeline:
    return kind.draw(recipe.outline, generator(recipe, Stream.EPISODE, episode))
