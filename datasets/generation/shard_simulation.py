"""Simulation of one shard: a function of the recipe and the shard's number alone."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.frame_sampling import (
    Sample,
    Stream,
    generator,
    instrument,
    sample,
    specimen,
)
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.specimen import Specimen
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import CLAMP_FIELDS
from eitskin.datasets.store.writer import touch_columns
from eitskin.geometry.deformation.fixtures import Clamp
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.simulator.bends.bend_table import on_support
from eitskin.simulator.deformation.corrections import is_tabulable
from eitskin.simulator.deformation.touches import TouchModel
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.instrument.session import Session
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator

Impedance = NDArray[np.complex128]
Solved = Mapping[tuple[int, Scene], Impedance]


def simulate_shard(recipe: Recipe, shard: int) -> Dataset:
    """Frames of `shard`."""
    return simulate_frames(recipe, recipe.shard_range(shard))


def simulate_frames(recipe: Recipe, indices: Iterable[int]) -> Dataset:
    """Frames of a recipe with the numbers `indices`, at least one.

    A frame does not depend on the others. Only the specimens of these frames are solved, and are in
    the result.
    """
    samples = [sample(recipe, index) for index in indices]
    protocol = recipe.measured_protocol
    offsets = recipe.instrument.offsets(protocol)
    solved = _solve(recipe, samples, bool(offsets.any()))
    numbers = sorted({each.specimen for each in samples})
    boards = {n: _board(recipe, protocol, n, solved[n, Scene()]) for n in numbers}

    def clean(each: Sample, changed: Callable[[Scene], Scene]) -> Impedance:
        impedance = solved[each.specimen, changed(each.scene)]
        if offsets.any() and each.after is not None:
            moved = solved[each.specimen, changed(each.after)] - impedance
            impedance = impedance + offsets / each.period * moved
        return impedance

    def measure(each: Sample) -> tuple[Impedance, NDArray[np.uint8]]:
        """Frame, and mean of its untouched reference frames, with the status of both."""
        count = recipe.reference_frames
        untouched = clean(each, without_touches)
        free = np.broadcast_to(untouched, (count, *untouched.shape))
        both = np.concatenate([clean(each, _unchanged)[None], free])
        rng = generator(recipe, Stream.NOISE, each.index)
        times = np.full(1 + count, each.session_time)
        measured, status = boards[each.specimen].session.measure(both, times, rng)
        return np.stack([measured[0], measured[1:].mean(axis=0)]), status[:2]

    impedance, status = (np.array(part) for part in zip(*map(measure, samples), strict=True))
    touches = [touch_columns(_held_touches(each.scene)) for each in samples]
    return Dataset.from_arrays(
        impedance[:, 0],
        np.array([board.reference for board in boards.values()]),
        specimen_number=np.array(numbers),
        touch_reference=impedance[:, 1],
        status=status[:, 0],
        specimen=np.searchsorted(numbers, [each.specimen for each in samples]),
        state=np.array([each.state for each in samples]),
        bend_angle_deg=np.array([each.scene.bend.angle_deg for each in samples]),
        **{name: np.array([row[name] for row in touches]) for name in touches[0]},
        **_clamps(recipe, samples),
        time=np.array([each.time for each in samples]),
        episode=np.array([each.episode for each in samples]),
        number=np.array([each.index for each in samples]),
        protocol=protocol,
        source="simulated",
        quantity="magnitude" if recipe.instrument.reads == "magnitude" else "impedance",
        recipe=recipe.to_toml(),
        seed=recipe.seed,
        design=recipe.sensor,
    )


def _clamps(recipe: Recipe, samples: Sequence[Sample]) -> dict[str, NDArray[np.float64]]:
    """Columns (n,) of what the bends of clamped sensors depend on; NaN for other fixtures."""
    rows = [_clamp(each.scene, specimen(recipe, each.specimen)) for each in samples]
    return dict(zip(CLAMP_FIELDS, np.array(rows).T, strict=True))


def _clamp(scene: Scene, made: Specimen) -> tuple[float, float, float, float]:
    if not isinstance(made.fixture, Clamp):
        return (np.nan,) * 4
    clamp = on_support(made.fixture, scene.support or made.design.support)
    laws = made.mechanics
    stiffness = laws.encapsulation.shear_modulus / laws.gel.shear_modulus
    return clamp.span, clamp.offset, 1.0 if clamp.faces == "bottom" else 2.0, stiffness


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
        session: of the instrument.
        reference: flat, untouched sensor at the session's start, noise-free [ohm].
    """

    session: Session
    reference: Impedance


def _board(recipe: Recipe, protocol: Protocol, number: int, flat: Impedance) -> _Board:
    """Board of specimen `number`, whose flat and untouched impedances are `flat` [ohm]."""
    own = instrument(recipe, number)
    full_scale = float(np.abs(flat[0]).max())

    def session(terms: Instrument) -> Session:
        return terms.session(protocol, full_scale, generator(recipe, Stream.SESSION, number))

    still = session(dataclasses.replace(own, snr_db=0.0, floor=0.0))
    rng = generator(recipe, Stream.SESSION, number)  # not used: all noise is switched off
    (reference,), _ = still.measure(flat[None], np.zeros(1), rng)
    return _Board(session(own), reference)


def _solve(recipe: Recipe, samples: Sequence[Sample], skewed: bool) -> Solved:
    """Noise-free impedances of every different scene of every specimen, solved once.

    They are those of the instrument's terminals, (2, measurements) [ohm].
    """
    wanted: dict[int, dict[Scene, None]] = {}
    for each in samples:
        # The scene at a frame's end matters only for frames scanned during a movement.
        scenes = [each.scene, each.after] if skewed and each.after is not None else [each.scene]
        scenes += [without_touches(scene) for scene in scenes]
        wanted.setdefault(each.specimen, {}).update(dict.fromkeys(scenes))
    solved: dict[tuple[int, Scene], Impedance] = {}
    for number, distinct in wanted.items():
        made, board = specimen(recipe, number), instrument(recipe, number)
        solved[number, Scene()] = flat_impedance(made, recipe, board)
        scenes = [scene for scene in distinct if scene != Scene()]
        for tabulated, alike in _by_touch_model(made.design, scenes).items():
            simulator = _simulator(
                made, recipe.sensor, recipe.resolution, recipe.protocol, tabulated=tabulated
            )
            found = simulator.measure_all(alike, instrument=board)
            solved |= {(number, scene): row for scene, row in zip(alike, found, strict=True)}
    return solved


def _by_touch_model(design: SensorDesign, scenes: Sequence[Scene]) -> dict[bool, list[Scene]]:
    """Scenes grouped by whether presses on their support are tabulated."""
    groups: dict[bool, list[Scene]] = {}
    for scene in scenes:
        supported = dataclasses.replace(design, support=scene.support or design.support)
        groups.setdefault(is_tabulable(supported), []).append(scene)
    return groups


# Meshing takes as long as a few scenes, so simulators are cached, but only a few: each holds the
# matrices of its mesh. Specimens follow each other, so that shards next to each other share one.
@lru_cache(maxsize=4)
def _simulator(
    made: Specimen,
    nominal: SensorDesign,
    resolution: Resolution,
    protocol: Protocol | None,
    *,
    tabulated: bool,
) -> Simulator:
    """Simulator of a specimen, kept."""
    touch_model: TouchModel = "tabulated" if tabulated else "solved"
    return made.simulator(nominal, resolution, protocol, touch_model)


def flat_impedance(made: Specimen, recipe: Recipe, board: Instrument) -> Impedance:
    """Noise-free impedances of the flat, untouched specimen on its board.

    They are those of the instrument's terminals, (2, measurements) [ohm].
    """
    simulator = _simulator(made, recipe.sensor, recipe.resolution, recipe.protocol, tabulated=True)
    found: Impedance = simulator.measure_all([Scene()], instrument=board)[0]
    return found
