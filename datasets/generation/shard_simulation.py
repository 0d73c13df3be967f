"""Simulation of one shard: a function of the recipe and the shard's number alone."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.frame_sampling import Sample, Stream, generator, sample, specimen
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.specimen import Specimen
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.writer import touch_columns
from eitskin.geometry.deformation.fixtures import Clamp
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.support import Support
from eitskin.protocol import Protocol
from eitskin.simulator.bends import bend_store
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.instrument.session import Session
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.presses import correction_store, press_store
from eitskin.simulator.presses.correction_store import corrections, tabulable
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.simulator.simulator import Simulator

Impedance = NDArray[np.complex128]
Progress = Callable[[int, int], None]
Solved = Mapping[tuple[int, Scene], Impedance]


def missing_bend_tables(recipe: Recipe) -> set[Path]:
    """Paths of the bend tables that a recipe needs and that have not been solved yet."""
    found: set[Path] = set()
    for bent in _clamped(recipe):
        found |= bend_store.missing(*bent)
    return found


def missing_press_tables(recipe: Recipe) -> set[Path]:
    """Paths of the press tables that a recipe needs and that have not been solved yet."""
    if not recipe.largest_force:
        return set()
    found: set[Path] = set()
    for design, mechanics in _pressed(recipe):
        found |= press_store.missing(design, mechanics, Cylinder())
        found |= correction_store.missing(design, mechanics, Cylinder())
    return found


def solved_frames(recipe: Recipe) -> int:
    """Largest number of frames whose touches are solved in 3D, as no tables are made for them."""

    def is_solved(support: Support | None) -> bool:
        sensor = recipe.sensor
        return not tabulable(dataclasses.replace(sensor, support=support or sensor.support))

    touched = [group for group in recipe.scenes if group.state == "touch"]
    frames = sum(group.frames for group in touched if is_solved(group.support))
    episodes = [each for each in recipe.episodes if each.largest_force]
    if is_solved(None):
        frames += sum(each.count * each.frames for each in episodes)
    return frames


def prepare(recipe: Recipe, progress: Progress | None = None, workers: int = 1) -> None:
    """Solve the tables that all workers need, and check the recipe's forces and bends.

    Dents of presses are solved in a number of processes, `workers`.

    `progress` is called with the numbers of solved bends or presses and of all in the tables that
    are being solved.

    Raises ConfigurationError for forces or bends out of reach on some specimen.
    """
    for bent in _clamped(recipe):
        bend_store.prepare(*bent, progress)
        for angle in recipe.extreme_angles:
            bend_store.bend_table(*bent).check(angle)
    if recipe.largest_force:
        press_store.prepare(_pressed(recipe), Cylinder(), progress, workers)
        for design, mechanics in _pressed(recipe):
            table = press_store.press_table(design, mechanics, Cylinder())
            deepest = table.at_force(recipe.largest_force).depth
            if tabulable(design):
                correction_store.prepare(design, mechanics, Cylinder(), progress)
                corrections(design, mechanics, Cylinder()).check_depth(deepest)


def simulate_shard(
    recipe: Recipe, shard: int, before_solve: Callable[[], None] = lambda: None
) -> Dataset:
    """Frames of `shard`; `before_solve` is called before each solution and may raise."""
    return simulate_frames(recipe, recipe.shard_range(shard), before_solve)


def simulate_frames(
    recipe: Recipe, indices: Iterable[int], before_solve: Callable[[], None] = lambda: None
) -> Dataset:
    """Frames of a recipe with the numbers `indices`, at least one.

    A frame does not depend on the others.
    """
    samples = [sample(recipe, index) for index in indices]
    boards = [_board(recipe, number, before_solve) for number in range(recipe.specimens.count)]
    offsets = recipe.instrument.offsets(boards[0].protocol)
    solved = _solve(recipe, samples, bool(offsets.any()), before_solve)

    def clean(each: Sample, changed: Callable[[Scene], Scene]) -> Impedance:
        impedance = solved[each.specimen, changed(each.scene)]
        if offsets.any() and each.after is not None:
            moved = solved[each.specimen, changed(each.after)] - impedance
            impedance = impedance + offsets / each.period * moved
        return impedance

    def measure(each: Sample) -> tuple[Impedance, NDArray[np.uint8]]:
        """Frame, and mean of its untouched reference frames, with the status of both."""
        count = recipe.reference_frames
        free = np.broadcast_to(clean(each, without_touches), (count, len(offsets)))
        both = np.concatenate([clean(each, _unchanged)[None], free])
        rng = generator(recipe, Stream.NOISE, each.index)
        times = np.full(1 + count, each.session_time)
        measured, status = boards[each.specimen].session.measure(both, times, rng)
        return np.stack([measured[0], measured[1:].mean(axis=0)]), status[:2]

    impedance, status = (np.array(part) for part in zip(*map(measure, samples), strict=True))
    touches = [touch_columns(_held_touches(each.scene)) for each in samples]
    return Dataset.from_arrays(
        impedance[:, 0],
        np.array([board.reference for board in boards]),
        touch_reference=impedance[:, 1],
        status=status[:, 0],
        specimen=np.array([each.specimen for each in samples]),
        state=np.array([each.state for each in samples]),
        bend_angle_deg=np.array([each.scene.bend.angle_deg for each in samples]),
        **{name: np.array([row[name] for row in touches]) for name in touches[0]},
        time=np.array([each.time for each in samples]),
        episode=np.array([each.episode for each in samples]),
        number=np.array([each.index for each in samples]),
        protocol=boards[0].protocol,
        source="simulated",
        recipe=recipe.to_toml(),
        seed=recipe.seed,
        design=recipe.sensor,
    )


def without_touches(scene: Scene) -> Scene:
    """Scene without touches, held or released."""
    return dataclasses.replace(scene, touches=())


def _unchanged(scene: Scene) -> Scene:
    return scene


def _held_touches(scene: Scene) -> tuple[Touch, ...]:
    return tuple(touch for touch in scene.touches if not touch.released)


@dataclass(frozen=True, slots=True, eq=False)
class _Board:
    """Board of one specimen in its session.

    Attributes:
        protocol: drive and sense pairs.
        session: of the instrument.
        reference: flat, untouched sensor at the session's start, noise-free [ohm].
    """

    protocol: Protocol
    session: Session
    reference: Impedance


def _board(recipe: Recipe, number: int, before_solve: Callable[[], None]) -> _Board:
    before_solve()
    protocol, flat, full_scale = _flat(specimen(recipe, number), recipe.resolution)

    def session(instrument: Instrument) -> Session:
        return instrument.session(protocol, full_scale, generator(recipe, Stream.SESSION, number))

    still = session(dataclasses.replace(recipe.instrument, snr_db=0.0, floor=0.0))
    rng = generator(recipe, Stream.SESSION, number)  # not used: all noise is switched off
    (reference,), _ = still.measure(flat[None], np.zeros(1), rng)
    return _Board(protocol, session(recipe.instrument), reference)


def _solve(
    recipe: Recipe, samples: Sequence[Sample], skewed: bool, before_solve: Callable[[], None]
) -> Solved:
    """Noise-free impedance [ohm] of every different scene of every specimen, solved once."""
    wanted: dict[int, dict[Scene, None]] = {}
    for each in samples:
        # The scene at a frame's end matters only for frames scanned during a movement.
        scenes = [each.scene, each.after] if skewed and each.after is not None else [each.scene]
        scenes += [without_touches(scene) for scene in scenes]
        wanted.setdefault(each.specimen, {}).update(dict.fromkeys(scenes))
    solved: dict[tuple[int, Scene], Impedance] = {}
    for number, distinct in wanted.items():
        made = specimen(recipe, number)
        solved[number, Scene()] = _flat(made, recipe.resolution)[1]
        scenes = [scene for scene in distinct if scene != Scene()]
        for tabulated, alike in _by_touch_model(made.design, scenes).items():
            simulator = _simulator(made, recipe.resolution, tabulated)
            found = simulator.measure_all(alike, before_each=before_solve)
            solved |= {(number, scene): row for scene, row in zip(alike, found, strict=True)}
    return solved


def _by_touch_model(design: SensorDesign, scenes: Sequence[Scene]) -> dict[bool, list[Scene]]:
    """Scenes grouped by whether presses on their support are tabulated."""
    groups: dict[bool, list[Scene]] = {}
    for scene in scenes:
        supported = dataclasses.replace(design, support=scene.support or design.support)
        groups.setdefault(tabulable(supported), []).append(scene)
    return groups


def _clamped(recipe: Recipe) -> Iterator[tuple[SensorDesign, Clamp, Mechanics]]:
    """Designs, clamps and materials of all specimens on all supports on which clamps bend them."""
    given = [group.support for group in recipe.scenes if any(group.angle_deg)]
    given += [None for each in recipe.episodes if any(each.angles_deg)]
    for number in range(recipe.specimens.count if given else 0):
        made = specimen(recipe, number)
        for support in dict.fromkeys(each or made.design.support for each in given):
            if isinstance(made.fixture, Clamp):
                design = dataclasses.replace(made.design, support=support)
                yield design, made.fixture, made.mechanics


def _pressed(recipe: Recipe) -> Iterator[tuple[SensorDesign, Mechanics]]:
    """Designs and materials of all specimens on all supports on which they are pressed."""
    groups = [group.support for group in recipe.scenes if group.state == "touch"]
    given = [None] * bool(recipe.episodes) + groups
    for number in range(recipe.specimens.count):
        made = specimen(recipe, number)
        for support in dict.fromkeys(each or made.design.support for each in given):
            yield dataclasses.replace(made.design, support=support), made.mechanics


# Meshing takes as long as a few scenes, so simulators are cached, but only a few: each holds the
# matrices of its mesh. Flat frames are small, and every shard needs those of all specimens.
@lru_cache(maxsize=4)
def _simulator(made: Specimen, resolution: Resolution, tabulated: bool = True) -> Simulator:
    return Simulator(
        made.design,
        resolution=resolution,
        fixture=made.fixture,
        mechanics=made.mechanics,
        touch_model="tabulated" if tabulated else "solved",
    )


@lru_cache(maxsize=4096)
def _flat(made: Specimen, resolution: Resolution) -> tuple[Protocol, Impedance, float]:
    """Protocol, noise-free frame and full scale [ohm] of the flat, untouched specimen."""
    frame = _simulator(made, resolution).measure(Scene())
    return frame.protocol, frame.impedance, float(np.abs(frame.impedance).max())
