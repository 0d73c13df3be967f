"""Places found with the touch response of a twin, in sensors of `eitskin bench transfer`.

Run by `python -m eitskin.benchmarks.studies.data.twin_response [MODEL] --out OUT`.

OUT has the folder `transfer` of `eitskin bench transfer`; frames that it lacks are generated. For
each sensor a twin is fitted to its one flat frame, with the terms of the meter that its board has,
and the pipeline is adapted by the flat frame alone, and by five known angles and 15 presses, each
with and without the twin. Touches are located in the judged frames of the benchmark and in the
known presses that no adaptation has seen. Writes results and prints the table as Markdown.
"""

import argparse
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.results import Results, write_results
from eitskin.benchmarks.transfer.scores import Judged, Labelled
from eitskin.benchmarks.transfer.worlds import World, recipes
from eitskin.datasets.generation.generate import generate
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import open_dataset
from eitskin.datasets.store.state import State
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.provenance import Provenance
from eitskin.training.evaluation.metrics import root_mean_square
from eitskin.training.joint.method import JointMethod
from eitskin.training.joint.own_response import relative_residual
from eitskin.training.method.known_frames import KnownFrames
from eitskin.training.pipeline.pipeline import Pipeline
from eitskin.training.pipeline.saved_form import SHIPPED
from eitskin.training.twin.twin import PressedTwin, Twin

NAME = "twin_response"
BOARDS: dict[str, tuple[str, ...]] = {
    "rough electrodes": (),
    "other board": ("source", "sink", "idle", "common_mode"),
}
"""Worlds, and the terms of the meter that are fitted there."""
LABELLED = (Labelled(0, 0), Labelled(5, 15))
SENSORS, SEED = 8, 0

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Touches of one sensor, located by one pipeline.

    Attributes:
        world, name: of the world and of the adaptation.
        place: errors of places (t,) [m].
        ratio: the same over their standard errors (t,).
        touches: number of true touches.
        residual: of the changes of single presses by the response, relative to them.
        kept: whether the twin's response was taken.
    """

    world: str
    name: str
    place: Array
    ratio: Array
    touches: int
    residual: float
    kept: bool


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PressedOnce:
    """Twin whose presses are kept, since every adaptation asks for the same ones."""

    twin: PressedTwin
    kept: dict[bytes, Array] = dataclasses.field(default_factory=dict)

    def inside(self, places: Array) -> NDArray[np.bool_]:
        """Whether places (n, 2) [m] are on the sensor (n,)."""
        return self.twin.inside(places)

    def changes(self, touches: Array, angle_deg: float, radius: float) -> Array:
        """Changes (n, C) as of `PressedTwin.changes`."""
        key = touches.tobytes() + np.array([angle_deg, radius]).tobytes()
        if key not in self.kept:
            self.kept[key] = self.twin.changes(touches, angle_deg, radius)
        return self.kept[key]


def world_of(name: str, folder: Path, workers: int) -> World:
    """Frames of a world of the benchmark, generated where they are absent."""
    sets = []
    for recipe in recipes(name, SEED, quick=False):
        place = folder / recipe.name.replace(" ", "-").replace(",", "")
        if not (place / "manifest.json").is_file():
            generate(recipe, place, workers, resume=(place / "recipe.toml").is_file())
        sets.append(open_dataset(place))
    return World(name, *sets)


def located(pipeline: Pipeline, world: World, sensor: int) -> Iterator[Located]:
    """Touches of a sensor by the pipeline adapted with and without its twin."""
    mine = world.known.select(world.known.specimen == sensor)
    judged = world.frames.select(world.frames.specimen == sensor)
    most = max(labelled.presses for labelled in LABELLED)
    presses = np.flatnonzero(mine.state == State.TOUCH)
    frames = [judged.select(judged.state == State.TOUCH), mine.select(presses[most:])]
    flat = mine.select(Labelled(0, 0).rows(mine))
    design = SensorDesign.reference()
    twin = PressedOnce(PressedTwin.of(Twin.fit(design, flat, terms=BOARDS[world.name])))
    for labelled in LABELLED:
        for own_twin in (None, twin):
            own = dataclasses.replace(pipeline)
            said = own.adapt(mine.select(labelled.rows(mine)), twin=own_twin)
            name = f"{labelled}{', twin' * (own_twin is not None)}"
            kept = said.twin is not None and said.twin.kept
            yield _located(own, world.name, name, frames, kept)


def _located(own: Pipeline, world: str, name: str, frames: list[Dataset], kept: bool) -> Located:
    found = [Judged.of(each, own.perceive(each)) for each in frames]
    known = KnownFrames.of(frames[1], None, own.layout)
    if not isinstance(own.method, JointMethod):
        raise ConfigurationError("expected a pipeline of the joint method, got another one")
    response = own.method.response_of(known.observations.flat[0])
    return Located(
        world,
        name,
        np.concatenate([each.place for each in found]),
        np.concatenate([each.place_ratio for each in found]),
        sum(each.touches for each in found),
        relative_residual(response, known, own.method.combinations),
        kept,
    )


def figures(found: list[Located]) -> dict[str, float]:
    """Means over the sensors of each world, by adaptation."""
    named: dict[str, float] = {}
    for world, name in dict.fromkeys((each.world, each.name) for each in found):
        mine = [each for each in found if (each.world, each.name) == (world, name)]
        place = np.concatenate([each.place for each in mine])
        row = f"{world}, {name}"
        named[f"{row} / place, mean [mm]"] = 1e3 * float(place.mean())
        named[f"{row} / place, median [mm]"] = 1e3 * float(np.median(place))
        ratio = np.concatenate([each.ratio for each in mine])
        named[f"{row} / place, error over standard error"] = root_mean_square(ratio)
        named[f"{row} / touches found"] = len(place) / sum(each.touches for each in mine)
        residual = np.array([each.residual for each in mine])
        named[f"{row} / residual of the changes [%]"] = 100.0 * root_mean_square(residual)
        named[f"{row} / sensors"] = len(mine)
        if name.endswith("twin"):
            named[f"{row} / twins taken"] = sum(each.kept for each in mine)
    return named


def main() -> None:
    """Run, write and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path, nargs="?", help="of the joint method; that which ships")
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    parser.add_argument("--frames", type=Path, help="folder `transfer` of the benchmark's frames")
    parser.add_argument("--worlds", nargs="+", choices=list(BOARDS), default=list(BOARDS))
    parser.add_argument("--sensors", type=int, default=SENSORS, help="of each world")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    began, rows = time.perf_counter(), []
    pipeline, found = Pipeline.load(options.model or SHIPPED), []
    for name in options.worlds:
        world = world_of(name, options.frames or options.out / "transfer", options.workers)
        for sensor in np.unique(world.frames.specimen)[: options.sensors].tolist():
            for each in located(pipeline, world, sensor):
                found.append(each)
                rows.append(_row(each, sensor))
                print(rows[-1], flush=True)
    named = figures(found)
    command = (
        f"python -m {__spec__.name if __spec__ else __name__} MODEL --sensors {options.sensors}"
    )
    quick = options.sensors != SENSORS or options.worlds != list(BOARDS)
    results = Results(
        NAME, command, Provenance.now(SEED), time.perf_counter() - began, quick, named
    )
    write_results(results, options.out, rows, {})
    for name, value in named.items():
        print(f"{name}: {value:.3g}")


def _row(each: Located, sensor: int) -> dict[str, Any]:
    return {
        "world": each.world,
        "sensor": sensor,
        "adapted by": each.name,
        "mean_mm": 1e3 * float(each.place.mean()),
        "found": len(each.place) / each.touches,
        "residual_percent": 100.0 * each.residual,
        "kept": each.kept,
    }


if __name__ == "__main__":
    main()
