"""Cramer-Rao bounds of the frames of a world: what the noise of one frame leaves of any method."""

from collections.abc import Iterator

import numpy as np

from eitskin.benchmarks.paper.limits import scene_of
from eitskin.benchmarks.paper.sets import Progress
from eitskin.benchmarks.transfer.scores import Figures
from eitskin.benchmarks.transfer.worlds import World
from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.schema import State
from eitskin.training.evaluation.cramer_rao import scene_derivatives
from eitskin.training.evaluation.scores import root_mean_square

TOUCHED, BENT = 4, 4  # frames of each sensor, evenly among its frames


def bounds(world: World, recipe: Recipe, progress: Progress) -> Figures:
    """Bounds of some frames of every sensor, each of the sensor as it truly is.

    The white noise of the recipe's instrument is all that they count: shape, contacts and bends of
    the sensor are known. Places: mean distance, against the mean of as many untouched frames as the
    recipe says, angle and force unknown. Angles: root mean square, of untouched frames against a
    flat reference without noise.

    Args:
        world: of the frames.
        recipe: that they were made from.
        progress: called after every sensor.
    """
    placed, angles = [], []
    numbers = world.frames.specimen_number
    for number in np.unique(world.frames.specimen).tolist():
        made = specimen(recipe, int(numbers[number]))
        simulator = made.simulator(recipe.sensor, recipe.resolution, recipe.protocol)
        full_scale = simulator.full_scale_on(recipe.instrument)
        for state, count in ((State.TOUCH, TOUCHED), (State.BEND, BENT)):
            for row in _rows(world, number, state, count):
                scene = scene_of(world.frames, row)
                found = scene_derivatives(simulator, scene, instrument=recipe.instrument)
                noise = found.noise(recipe.instrument, full_scale)
                if state == State.TOUCH:
                    placed.append(found.bound(noise, recipe.reference_frames).distance)
                else:
                    angles.append(found.bound(noise, np.inf).angle_deg)
        progress(f"bounds: {world.name}", number + 1, len(numbers))
    return {
        "place, mean [mm]": 1e3 * float(np.mean(np.concatenate(placed))),
        "angle, rms [deg]": root_mean_square(np.array(angles)),
    }


def _rows(world: World, number: int, state: State, count: int) -> Iterator[int]:
    """Some frames of a sensor in one state, evenly spaced among these."""
    data = world.frames
    rows = np.flatnonzero((data.specimen == number) & (data.state == state))
    yield from rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int)].tolist()
