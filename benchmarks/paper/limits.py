"""Signal-to-noise ratio and Cramer-Rao bound of the frames of `bench paper`."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.simulator.scene.scene import Scene, Touch
from eitskin.simulator.simulator import Simulator
from eitskin.training.evaluation.cramer_rao import SceneDerivatives, scene_derivatives
from eitskin.training.evaluation.scores import root_mean_square

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SignalToNoise:
    """Root mean square of touches' signals over that of a frame's noise, over the channels."""

    least: float
    median: float
    most: float

    @classmethod
    def of(cls, sets: Mapping[str, Dataset]) -> "SignalToNoise":
        """Signal-to-noise ratio of all touches in `sets`; idle frames minus reference are noise."""
        touched = [_changes(sets[name]) for name in ("indentation", "touch")]
        idle = sets["states"].select(sets["states"].state == State.IDLE)
        # The reference adds the noise of the mean of its frames.
        noise = _rms(_changes(idle)) / np.sqrt(1.0 + 1.0 / idle.reference_frames)
        ratio = _rms(np.concatenate(touched)) / noise
        return cls(float(ratio.min()), float(np.median(ratio)), float(ratio.max()))


def bounds(sets: Mapping[str, Dataset], recipe: Recipe, count: int, seed: int) -> dict[str, float]:
    """Cramer-Rao bounds of the figures of `scores`, by the same names, over some frames.

    For the nominal sensor, and the white noise of the recipe's instrument alone. Places: the mean
    distance [mm], against the mean of as many frames of the sensor at that bend as the recipe says,
    the angle unknown. Angles: root mean square [deg], of one frame against a flat reference
    without noise, touches unknown; frames before the touch may tell more.

    Args:
        sets: experiments, by name.
        recipe: of the frames.
        count: how many frames of each kind.
        seed: which ones.
    """
    simulator = Simulator(recipe.sensor, "fast", recipe.fixture, mechanics=recipe.mechanics)
    rng = np.random.default_rng(seed)
    touch, bending = sets["touch"], sets["bending"]
    kinds = {"indentation": sets["indentation"]}
    for number in np.unique(touch.touch_count).tolist():
        kinds[f"touch.{number}"] = touch.select(touch.touch_count == number)
    limits, angles = {}, []
    for name, data in kinds.items():
        placed = []
        for each in _derivatives(simulator, data, count, rng):
            noise = each.noise(recipe.instrument, simulator.full_scale)
            placed.append(each.bound(noise, recipe.reference_frames).distance)
            if name != "indentation":
                angles.append(each.bound(noise, np.inf).angle_deg)
        limits[f"{name}.error_mm"] = 1e3 * float(np.mean(np.concatenate(placed)))
    bent = [
        each.bound(each.noise(recipe.instrument, simulator.full_scale), np.inf).angle_deg
        for each in _derivatives(simulator, bending.select(bending.state == State.BEND), count, rng)
    ]
    limits["touch.angle_deg"] = limits["calibrated.touched_deg"] = root_mean_square(angles)
    limits["bend.angle_deg"] = limits["calibrated.angle_deg"] = root_mean_square(bent)
    return limits


def _derivatives(
    simulator: Simulator, data: Dataset, count: int, rng: np.random.Generator
) -> Iterator[SceneDerivatives]:
    """Derivatives of the scenes of some frames."""
    for row in rng.permutation(len(data))[:count].tolist():
        yield scene_derivatives(simulator, scene_of(data, row))


def scene_of(data: Dataset, row: int) -> Scene:
    """Scene of one frame with known touches."""
    places = zip(data.touch_x[row], data.touch_y[row], data.touch_force[row], strict=True)
    touches = (Touch(float(x), float(y), float(f)) for x, y, f in places if np.isfinite(x))
    return Scene(Bend(float(data.bend_angle_deg[row])), tuple(touches))


def _changes(data: Dataset) -> Array:
    """Change from the untouched sensor at the same bend over the flat magnitude, (n, channels)."""
    size = np.abs(data.reference[data.specimen])
    change: Array = (data.impedance - data.touch_reference).real.astype(float) / size
    return change


def _rms(values: Array) -> Array:
    rms: Array = np.sqrt(np.mean(values**2, axis=0))
    return rms
