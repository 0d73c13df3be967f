"""Simulation of one shard: a function of the recipe and the shard's number alone."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
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
from eitskin.datasets.store.folder import touch_columns
from eitskin.datasets.store.schema import CLAMP_FIELDS
from eitskin.geometry.deformation.fixtures import Clamp
from eitskin.geometry.design.sensor import Plates, SensorDesign
from eitskin.protocol import Protocol
from eitskin.simulator.bends.bend_table import on_support
from eitskin.simulator.deformation.pressed_sensor import TouchModel
from eitskin.simulator.deformation.tabled_corrections import is_tabulable
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.electrical.sensor_impedances import without_touches
from eitskin.simulator.instrument.drift import Session
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator, measure_together

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

    def clean(frame_sample: Sample, scene: Scene, after: Scene | None) -> Impedance:
        impedance = solved[frame_sample.specimen, scene]
        if offsets.any() and after is not None:
            impedance = impedance + offsets / frame_sample.period * (
                solved[frame_sample.specimen, after] - impedance
            )
        return impedance

    def measure(frame_sample: Sample) -> tuple[Impedance, NDArray[np.uint8]]:
        """Frame, and mean of its untouched reference frames, with the status of both."""
        session, _ = boards[frame_sample.specimen]
        touched = clean(frame_sample, frame_sample.scene, frame_sample.after)
        later = None if frame_sample.after is None else without_touches(frame_sample.after)
        untouched = clean(frame_sample, without_touches(frame_sample.scene), later)
        rng = generator(recipe, Stream.NOISE, frame_sample.index)
        count = recipe.touch_frames if frame_sample.scene.touches else 1
        scenes = count * [touched] + recipe.reference_frames * [untouched]
        times = np.full(len(scenes), frame_sample.session_time)
        measured, status = session.measure(np.stack(scenes), times, rng)
        means = measured[:count].mean(axis=0), measured[count:].mean(axis=0)
        return np.stack(means), status[[0, count]]

    impedance, status = (np.array(part) for part in zip(*map(measure, samples), strict=True))
    held = ([touch for touch in each.scene.touches if not touch.released] for each in samples)
    touches = [touch_columns(each) for each in held]
    pairs = [(each.scene, specimen(recipe, each.specimen)) for each in samples]
    clamps = [_clamp(*pair) for pair in pairs]
    return Dataset.from_arrays(
        impedance[:, 0],
        np.array([reference for _, reference in boards.values()]),
        specimen_number=np.array(numbers),
        touch_reference=impedance[:, 1],
        status=status[:, 0],
        specimen=np.searchsorted(numbers, [each.specimen for each in samples]),
        state=np.array([each.state for each in samples]),
        bend_angle_deg=np.array([each.scene.bend.angle_deg for each in samples]),
        **{name: np.array([row[name] for row in touches]) for name in touches[0]},
        **dict(zip(CLAMP_FIELDS, np.array(clamps).T, strict=True)),
        support_gap=np.array([_gap(*pair) for pair in pairs]),
        time=np.array([each.time for each in samples]),
        episode=np.array([each.episode for each in samples]),
        number=np.array([each.index for each in samples]),
        protocol=protocol,
        source="simulated",
        quantity=recipe.quantity,
        frequency=recipe.excitation_frequency,
        recipe=recipe.to_toml(),
        seed=recipe.seed,
        design=recipe.sensor,
    )


def _clamp(scene: Scene, drawn_specimen: Specimen) -> tuple[float, float, float, float]:
    """Values of `CLAMP_FIELDS`, on which the bends of clamped sensors depend; else NaN."""
    if not isinstance(drawn_specimen.fixture, Clamp):
        return (np.nan,) * 4
    clamp = on_support(drawn_specimen.fixture, scene.support or drawn_specimen.design.support)
    laws = drawn_specimen.mechanics
    stiffness = laws.encapsulation.shear_modulus / laws.gel.shear_modulus
    return clamp.span, clamp.offset, 1.0 if clamp.faces == "bottom" else 2.0, stiffness


def _gap(scene: Scene, drawn_specimen: Specimen) -> float:
    """Gap [m] between the plates that carry the sensor of a scene; 0 on a base."""
    support = scene.support or drawn_specimen.design.support
    return support.span if isinstance(support, Plates) else 0.0


def _board(
    recipe: Recipe, protocol: Protocol, number: int, flat: Impedance
) -> tuple[Session, Impedance]:
    """Session of the board of specimen `number`, and what it reads of the flat sensor [ohm].

    The reading, at the session's start, is free of noise; `flat` are the impedances [ohm].
    """
    own = instrument(recipe, number)
    full_scale, frequency = float(np.abs(flat[0]).max()), recipe.excitation_frequency

    def session(terms: Instrument) -> Session:
        rng = generator(recipe, Stream.SESSION, number)
        return terms.session(protocol, full_scale, rng, frequency)

    still = session(replace(own, snr_db=0.0, floor=0.0))
    rng = generator(recipe, Stream.SESSION, number)  # not used: all noise is switched off
    (reference,), _ = still.measure(flat[None], np.zeros(1), rng)
    return session(own), reference


def _solve(recipe: Recipe, samples: Sequence[Sample], skewed: bool) -> Solved:
    """Noise-free impedances of every different scene of every specimen, solved once.

    They are those of the instrument's terminals, (2, measurements) [ohm].
    """
    scenes_by_specimen: dict[int, dict[Scene, None]] = {}
    for each in samples:
        # The scene at a frame's end matters only for frames scanned during a movement.
        scenes = [each.scene, each.after] if skewed and each.after is not None else [each.scene]
        scenes += [without_touches(scene) for scene in scenes]
        scenes_by_specimen.setdefault(each.specimen, {}).update(dict.fromkeys(scenes))
    solved: dict[tuple[int, Scene], Impedance] = {}
    asked: list[tuple[Simulator, list[Scene], Instrument]] = []
    numbers: list[int] = []
    for number, distinct in scenes_by_specimen.items():
        made, board = specimen(recipe, number), instrument(recipe, number)
        solved[number, Scene()] = flat_impedance(made, recipe, board)
        scenes = [scene for scene in distinct if scene != Scene()]
        tables = {
            support: is_tabulable(replace(made.design, support=support or made.design.support))
            for support in {scene.support: None for scene in scenes}
        }
        for tabulated in dict.fromkeys(tables.values()):
            alike = [scene for scene in scenes if tables[scene.support] == tabulated]
            simulator = _simulator(
                made, recipe.nominal_sensor, recipe.resolution, recipe.protocol, tabulated=tabulated
            )
            asked.append((simulator, alike, board))
            numbers.append(number)
    for number, (_, alike, _), frames in zip(numbers, asked, measure_together(asked), strict=True):
        solved |= {(number, scene): row for scene, row in zip(alike, frames, strict=True)}
    return solved


# Meshing takes as long as a few scenes, so simulators are cached, but only a few: each holds the
# matrices of its mesh. Specimens follow each other, so that shards next to each other share one.
@lru_cache(maxsize=4)
def _simulator(
    drawn_specimen: Specimen,
    nominal: SensorDesign,
    resolution: Resolution,
    protocol: Protocol | None,
    *,
    tabulated: bool,
) -> Simulator:
    """Simulator of a specimen, kept."""
    touch_model: TouchModel = "tabulated" if tabulated else "solved"
    return drawn_specimen.simulator(nominal, resolution, protocol, touch_model)


def flat_impedance(made: Specimen, recipe: Recipe, board: Instrument) -> Impedance:
    """Noise-free impedances of the flat, untouched specimen on its board.

    They are those of the instrument's terminals, (2, measurements) [ohm].
    """
    nominal = recipe.nominal_sensor
    simulator = _simulator(made, nominal, recipe.resolution, recipe.protocol, tabulated=True)
    impedance: Impedance = simulator.measure_all([Scene()], instrument=board)[0]
    return impedance
