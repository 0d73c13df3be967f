"""Worlds of `bench transfer`: how the sensors there differ from those of the recipe "training"."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from eitskin.benchmarks.frames import generate_missing
from eitskin.benchmarks.paper.sets import KNOWN_DEG
from eitskin.benchmarks.results import Progress
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Mounts, Specimens
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.geometry.design.sensor import Plates
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.instrument.meter import FourTerminalMeter

SENSORS, QUICK_SENSORS = 16, 2
SEED = 4000  # added to seeds, which keeps test sensors apart from those of training sets
SENSOR_FRAMES = (
    SceneGroup("idle", count=3),
    SceneGroup("bend", count=3, angle_deg=(-20.0, -5.0)),
    SceneGroup("bend", count=9, angle_deg=(5.0, 50.0)),
    SceneGroup("touch", count=6, force=(4.0, 12.0)),
    SceneGroup("touch", count=6, force=(4.0, 12.0), angle_deg=(-20.0, 50.0), per_bend=3),
)
"""Frames of each sensor. The state of bends below 5 deg, which are nearly flat, is not asked."""
KNOWN_FRAMES = (
    SceneGroup("idle", count=1),
    *(SceneGroup("bend", count=1, angle_deg=(angle, angle)) for angle in KNOWN_DEG),
    SceneGroup("bend", count=15, angle_deg=(-20.0, 50.0)),
    SceneGroup("touch", count=80, force=(4.0, 12.0)),
)
"""Labelled frames of each sensor, to adapt by: angles, and presses on the flat sensor."""


PLACES = (
    *((0.030, 0.020), (0.045, 0.040), (0.112, 0.017), (0.125, 0.033)),
    *((0.026, 0.044), (0.040, 0.025), (0.108, 0.038), (0.118, 0.022)),
)
"""Presses of "pressed while bent" [m], on the plates, two at each of four angles."""
FEW_SENSORS = 2
FEW_FRAMES = (
    SceneGroup("idle", count=2),
    SceneGroup("bend", count=6, angle_deg=(10.0, 40.0)),
    SceneGroup("touch", positions=PLACES, force=(4.0, 8.0), angle_deg=(10.0, 40.0), per_bend=2),
)
"""All frames to be judged of the world whose presses take half a minute to minutes each."""


def _as_trained(recipe: Recipe) -> Recipe:
    return recipe


def _other_clamps(recipe: Recipe) -> Recipe:
    """Clamps with other spans, axes and held faces, without a spread about each."""
    still = _without_own_bends(recipe.specimens)
    mounts = Mounts(8, (0.028, 0.057), (0.005, 0.013), faces=("both", "bottom"))
    return dataclasses.replace(recipe, specimens=still, mounts=mounts)


def _other_stiffness(recipe: Recipe) -> Recipe:
    """Encapsulations 0.7 to 2 times as stiff, in clamps as in training."""
    still = _without_own_bends(recipe.specimens)
    mounts = Mounts(4, stiffness=(0.7, 2.0))  # softer ones are out of reach of 12 N
    return dataclasses.replace(recipe, specimens=still, mounts=mounts)


def _rough_electrodes(recipe: Recipe) -> Recipe:
    """Electrodes placed within 1 mm, contacts that differ by a factor of 2 between them."""
    rough = dataclasses.replace(
        recipe.specimens, conductivity=0.5, contact_impedance=0.8, electrode_place=0.001
    )
    return dataclasses.replace(recipe, specimens=rough)


def _other_board(recipe: Recipe) -> Recipe:
    """Board with loads to ground of its source, its sink and its idle electrodes."""
    meter = FourTerminalMeter(source=2e-5, sink=2e-4, idle=2e-5, common_mode=0.01)
    return dataclasses.replace(recipe, instrument=Instrument(snr_db=72.0, meter=meter))


def _pressed_while_bent(recipe: Recipe) -> Recipe:
    """Sensors on the two plates that bend them; presses are solved as one problem with the bend."""
    sensor = dataclasses.replace(recipe.sensor, support=Plates())
    still = _without_own_bends(recipe.specimens)
    return dataclasses.replace(recipe, sensor=sensor, specimens=still)


def _without_own_bends(spread: Specimens) -> Specimens:
    """Spread whose specimens share the bends of their mounts."""
    return dataclasses.replace(
        spread,
        thickness=0.0,
        gel_modulus=0.0,
        encapsulation_modulus=0.0,
        hinge_span=0.0,
        hinge_offset=0.0,
    )


WORLDS: dict[str, Callable[[Recipe], Recipe]] = {
    "as trained": _as_trained,
    "other clamps": _other_clamps,
    "other stiffness": _other_stiffness,
    "rough electrodes": _rough_electrodes,
    "other board": _other_board,
}
"""Recipe of each world, from one with the sensors and the instrument of "training"."""
FEW: dict[str, Callable[[Recipe], Recipe]] = {"pressed while bent": _pressed_while_bent}
"""The same of worlds of a handful of frames, on two sensors, without known presses."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class World:
    """Frames of the sensors of one world.

    Attributes:
        name: of the world.
        frames: flat, bent and touched, to be judged.
        known: labelled frames of the same sensors in the same sessions, to adapt by.
    """

    name: str
    frames: Dataset
    known: Dataset


def make(folder: Path, seed: int, quick: bool, workers: int, progress: Progress) -> list[World]:
    """Generate the frames that `folder` does not have yet, and read all of them.

    Raises ConfigurationError where `folder` holds frames of other recipes.
    """
    made = []
    for name in (*WORLDS, *(() if quick else FEW)):
        sets = []
        for recipe in recipes(name, seed, quick):
            place = folder / recipe.name.replace(" ", "-").replace(",", "")
            part = f"frames: {recipe.name}"
            sets.append(generate_missing(recipe, place, workers, progress, part))
        made.append(World(name, sets[0], _apart(*sets)))
    return made


def _apart(frames: Dataset, known: Dataset) -> Dataset:
    """Known frames less presses whose place and noise were drawn as those of a judged frame.

    Draws follow from a frame's number; only the first sensor has the same numbers in both sets.
    """
    judged = dict(zip(frames.number.tolist(), frames.specimen.tolist(), strict=True))
    pairs = zip(known.number.tolist(), known.specimen.tolist(), strict=True)
    same = np.array([judged.get(number) == specimen for number, specimen in pairs])
    return known.select(np.flatnonzero(~same | (known.state != State.TOUCH)))


def recipes(world: str, seed: int, quick: bool) -> tuple[Recipe, Recipe]:
    """Recipes of the frames to be judged and of the known frames of a world."""
    few = world in FEW
    count = FEW_SENSORS if few else QUICK_SENSORS if quick else SENSORS
    training = Recipe.shipped("training")
    spread: Specimens = dataclasses.replace(training.specimens, count=count)
    base = dataclasses.replace(
        training,
        name=world,
        description="",
        seed=SEED + seed,
        specimens=spread,
        reference_frames=8,
        scenes=FEW_FRAMES if few else tuple(_times(group, count) for group in SENSOR_FRAMES),
    )
    frames = (FEW if few else WORLDS)[world](base)
    known = tuple(group for group in KNOWN_FRAMES if not few or group.state != "touch")
    scenes = tuple(_times(group, count) for group in known)
    return frames, dataclasses.replace(frames, name=f"{world}, known", scenes=scenes)


def _times(group: SceneGroup, count: int) -> SceneGroup:
    return dataclasses.replace(group, count=group.count * count)
