"""The frames of one shard, simulated: a function of the recipe and the shard's number alone."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.dataset import Dataset
from eitskin.datasets.recipe import Recipe
from eitskin.datasets.sampling import Sample, Stream, generator, sample, specimen
from eitskin.datasets.specimen import Specimen
from eitskin.datasets.writer import touch_columns
from eitskin.simulator import Frame, Mechanics, Scene, Simulator, Touch
from eitskin.simulator.presses import pressed
from eitskin.simulator.resolution import Resolution

Impedance = NDArray[np.complex128]
Solved = Mapping[tuple[int, Scene], Impedance]


def prepare(recipe: Recipe) -> None:
    """Solve once what all workers need, and check what takes a solution to know.

    Raises ConfigurationError for forces that the sensor's presses do not reach.
    """
    forces = [group.force[1] for group in recipe.scenes if group.state == "touch"]
    if forces:
        pressed((Touch(0.0, 0.0, max(forces)),), recipe.sensor, Mechanics())


def simulate_shard(
    recipe: Recipe, shard: int, before_solve: Callable[[], None] = lambda: None
) -> Dataset:
    """The frames of `shard`; `before_solve` is called before each new scene and may raise."""
    samples = [sample(recipe, index) for index in recipe.shard_range(shard)]
    flats = [
        _flat(specimen(recipe, number), recipe.resolution)
        for number in range(recipe.specimens.count)
    ]
    solved = _solve(recipe, samples, before_solve)

    def measure(each: Sample, scene: Scene, stream: Stream) -> Impedance:
        rng = generator(recipe, stream, each.index)
        full_scale = flats[each.specimen].full_scale
        start, noise = rng.spawn(2)
        session = recipe.instrument.session(flats[0].frame.protocol, full_scale, start)
        (impedance,), _ = session.measure(solved[each.specimen, scene][None], np.zeros(1), noise)
        measured: Impedance = impedance
        return measured

    touches = [touch_columns(each.scene.touches) for each in samples]
    return Dataset.from_arrays(
        np.array([measure(each, each.scene, Stream.NOISE) for each in samples]),
        np.array([each.frame.impedance for each in flats]),
        touch_reference=np.array(
            [measure(each, _untouched(each.scene), Stream.REFERENCE_NOISE) for each in samples]
        ),
        specimen=np.array([each.specimen for each in samples]),
        state=np.array([each.state for each in samples]),
        bend_angle_deg=np.array([each.scene.bend.angle_deg for each in samples]),
        **{name: np.array([row[name] for row in touches]) for name in touches[0]},
        # Every snapshot is an episode of one frame.
        episode=np.array([each.index for each in samples]),
        protocol=flats[0].frame.protocol,
        frequency=flats[0].frame.frequency,
        source="simulated",
        recipe=recipe.to_toml(),
        seed=recipe.seed,
        design=recipe.sensor,
    )


@dataclass(frozen=True, slots=True)
class _Flat:
    """What the flat, untouched specimen gives, free of noise; full scale [ohm]."""

    frame: Frame
    full_scale: float


def _solve(recipe: Recipe, samples: Sequence[Sample], before_solve: Callable[[], None]) -> Solved:
    """The noise-free impedance [ohm] of every different scene, each solved once."""
    wanted = dict.fromkeys(
        (each.specimen, scene) for each in samples for scene in (each.scene, _untouched(each.scene))
    )
    solved = {}
    # By specimen and angle, so that what one scene has prepared can serve the next.
    for number, scene in sorted(wanted, key=lambda item: (item[0], item[1].bend.angle_deg)):
        before_solve()
        made = specimen(recipe, number)
        if scene == Scene():
            frame = _flat(made, recipe.resolution).frame
        else:
            frame = _simulator(made, recipe.resolution).measure(scene)
        solved[number, scene] = frame.impedance
    return solved


def _untouched(scene: Scene) -> Scene:
    return Scene(bend=scene.bend)


# Meshing takes as long as a few scenes, so simulators are kept, though only a few: each holds
# its mesh's matrices. Flat frames are small, and every shard needs those of all specimens.
@lru_cache(maxsize=8)
def _simulator(made: Specimen, resolution: Resolution) -> Simulator:
    return Simulator(made.design, resolution=resolution, fixture=made.hinge)


@lru_cache(maxsize=4096)
def _flat(made: Specimen, resolution: Resolution) -> _Flat:
    simulator = _simulator(made, resolution)
    return _Flat(simulator.measure(Scene()), simulator.full_scale)
