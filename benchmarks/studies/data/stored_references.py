"""Sessions with a stored reference: bent and pressed starts, and sensors mounted in a curve.

Run by `python -m eitskin.benchmarks.studies.data.stored_references`, for `docs/pipeline.md`.

Held-out specimens of the recipe `training`, each on an AD5940 of its own, and the pipeline that
ships. Prints, as Markdown, errors of the third frame after a flat reference whose conductivity has
changed by 2 % since, and errors of angles and touches on sensors whose zero is their mounted shape.
"""

import argparse
import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.studies.data.session_starts import FIRST_HELD_OUT, SimulatedSensor, scenes
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.store.state import State
from eitskin.errors import EitskinError
from eitskin.frame import Frame
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.provenance import Provenance
from eitskin.simulator.scene.scene import Scene
from eitskin.training.evaluation.matching import localisation
from eitskin.training.pipeline.estimate import Estimate
from eitskin.training.pipeline.pipeline import Pipeline
from eitskin.training.pipeline.saved_form import SHIPPED
from eitskin.training.pipeline.stored_reference import Zero

STARTS = ("flat", "+10 deg", "+30 deg", "3 N", "9 N", "+30 deg, 9 N")
MOUNTED_DEG = (10.0, 20.0, 30.0)
MOVED_DEG = (-10.0, 10.0)
KNOWN_DEG = (-10.0, -5.0, 0.0, 5.0, 10.0)
DRIFT = 1.02  # of the conductivity since the reference
REFERENCE_FRAMES, JUDGED_FRAME = 8, 3

Array = NDArray[np.float64]


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--specimens", type=int, default=30, help="of the first table")
    parser.add_argument("--mounted", type=int, default=5, help="specimens of the second table")
    options = parser.parse_args()
    recipe = Recipe.shipped("training")
    numbers = range(FIRST_HELD_OUT, FIRST_HELD_OUT + max(options.specimens, options.mounted))
    print(Provenance.now(recipe.seed))
    print("\n## flat reference\n")
    print("| start | state right | angle, rms | standard error, rms | touches found | error |")
    print("|---|---|---|---|---|---|", flush=True)
    started = [_started(recipe, number) for number in numbers[: options.specimens]]
    for name in STARTS:
        print(f"| {name} | {_start_cells([each[name] for each in started if name in each])} |")
    print("\n## mounted\n")
    print("| mounted at | angle, rms | calibrated | refused calibrations | touches, rms |")
    print("|---|---|---|---|---|", flush=True)
    for mounted in MOUNTED_DEG:
        found = [_mounted(recipe, number, mounted) for number in numbers[: options.mounted]]
        print(f"| {mounted:g} deg | {_mounted_cells(found)} |", flush=True)


def _started(recipe: Recipe, number: int) -> dict[str, tuple[Scene, Estimate]]:
    """Scene and estimate of each start of one specimen; none where its reference is doubted."""
    sensor, pipeline = SimulatedSensor(recipe, number), Pipeline.load(SHIPPED)
    try:
        reference = pipeline.tare(sensor.frames(Scene(), REFERENCE_FRAMES))
    except EitskinError as error:
        print(f"specimen {number}: {error}")
        return {}
    found = {}
    for name, scene in scenes(number).items():
        if name in STARTS:
            pipeline.use(reference)
            found[name] = (scene, _last(pipeline, sensor.frames(scene, JUDGED_FRAME, DRIFT)))
    return found


def _start_cells(found: Sequence[tuple[Scene, Estimate]]) -> str:
    right = [estimate.state is _state(scene) for scene, estimate in found]
    angle = _rms([_angle(each) - scene.bend.angle_deg for scene, each in found])
    deviation = _rms([each.bend_deviation_deg or np.nan for _, each in found])
    cells = [f"{100.0 * np.mean(right):.0f} %", f"{angle:.2f} deg", f"{deviation:.2f} deg"]
    score = localisation([(_true(scene), _places(estimate)) for scene, estimate in found])
    if score.true:
        share = 100.0 * len(score.errors) / score.true
        median = 1e3 * np.median(score.errors) if score.errors else np.nan
        cells += [f"{share:.0f} %", f"{median:.1f} mm"]
    else:
        cells += ["", ""]
    return " | ".join(cells)


@dataclasses.dataclass(frozen=True, slots=True)
class _Mounted:
    """Errors of one mounted specimen: angles [deg], before and after calibration, and touches [m].

    `calibrated` is None where the calibration was refused.
    """

    angles: list[float]
    calibrated: list[float] | None
    touches: list[float]


def _mounted(recipe: Recipe, number: int, mounted_deg: float) -> _Mounted:
    sensor, pipeline = SimulatedSensor(recipe, number), Pipeline.load(SHIPPED)
    touch = scenes(number)["9 N"].touches
    still = Scene(Bend(mounted_deg))
    reference = pipeline.tare(sensor.frames(still, REFERENCE_FRAMES), Zero.MOUNTED)

    def angle_errors() -> list[float]:
        errors = []
        for moved in MOVED_DEG:
            pipeline.use(reference)
            frames = sensor.frames(Scene(Bend(mounted_deg + moved)), JUDGED_FRAME)
            errors.append(_angle(_last(pipeline, frames)) - moved)
        return errors

    before = angle_errors()
    pipeline.use(reference)
    pressed = Scene(Bend(mounted_deg), touch)
    touched = _last(pipeline, sensor.frames(pressed, JUDGED_FRAME))
    errors = localisation([(_true(pressed), _places(touched))]).errors
    try:
        shown = [sensor.frames(Scene(Bend(mounted_deg + angle)), 1)[0] for angle in KNOWN_DEG]
        pipeline.calibrate(shown, KNOWN_DEG)
    except EitskinError:
        return _Mounted(before, None, list(errors))
    return _Mounted(before, angle_errors(), list(errors))


def _mounted_cells(found: Sequence[_Mounted]) -> str:
    calibrated = [each.calibrated for each in found if each.calibrated is not None]
    cells = [
        f"{_rms([error for each in found for error in each.angles]):.1f} deg",
        f"{_rms([error for errors in calibrated for error in errors]):.1f} deg",
        f"{len(found) - len(calibrated)} of {len(found)}",
        f"{1e3 * _rms([error for each in found for error in each.touches]):.1f} mm",
    ]
    return " | ".join(cells)


def _last(pipeline: Pipeline, frames: Sequence[Frame]) -> Estimate:
    return [pipeline.process(frame) for frame in frames][-1]


def _state(scene: Scene) -> State:
    if scene.touches:
        return State.TOUCH
    return State.BEND if scene.bend.angle_deg else State.IDLE


def _angle(estimate: Estimate) -> float:
    return np.nan if estimate.bend_angle_deg is None else float(estimate.bend_angle_deg)


def _true(scene: Scene) -> Array:
    return np.array([(touch.x, touch.y) for touch in scene.touches]).reshape(-1, 2)


def _places(estimate: Estimate) -> Array:
    return np.array([(x, y) for x, y, _ in estimate.touches or ()]).reshape(-1, 2)


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.nanmean(np.square(values)))) if len(values) else float("nan")


if __name__ == "__main__":
    main()
