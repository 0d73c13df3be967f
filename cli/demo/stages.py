"""The demo's stages in their order, from the bare sensor to a pipeline on a live board."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from rich.table import Table

from eitskin.cli.commands.evaluate import paper_table
from eitskin.cli.demo import measured, recordings, sensor
from eitskin.cli.demo.results import StageResult, StoredResult, stored
from eitskin.cli.demo.workspace import RESULTS, SHIPPED, TRAINED, Workspace, versions
from eitskin.cli.episode import episode_table
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.training.evaluation.report.drawing import style


@dataclass(frozen=True, slots=True)
class DemoStage:
    """One stage of the demo.

    Attributes:
        name: of its file, and of its numbers in report.json.
        heading: on the screen and in the report.
        inputs: everything that its result depends on, beside versions and seed.
        make: computes its result.
        table: its numbers for the screen.
    """

    name: str
    heading: str
    inputs: Callable[[Workspace], Mapping[str, Any]]
    make: Callable[[Workspace], StageResult]
    table: Callable[[StageResult], Table] | None = None


def run_stages(demo: Workspace) -> dict[str, StoredResult]:
    """Results of all stages by name, those of earlier runs where their inputs are the same.

    Raises PartialError where the folder cannot be written to any more; the same demo goes on then.
    """
    results = {}
    for number, stage in enumerate(STAGES, 1):
        demo.output.heading(f"{number}. {stage.heading}")
        start = time.perf_counter()  # datasets and pipeline are made when first asked for
        inputs = {"versions": versions(), "seed": demo.plan.seed, **stage.inputs(demo)}
        path = demo.out / RESULTS / f"{stage.name}.json"
        with style():
            found = stored(path, inputs, partial(stage.make, demo), start)
        results[stage.name] = found
        if stage.table:
            demo.output.show(stage.table(found.result))
        for remark in found.result.remarks:
            demo.output.show(remark)
    return results


def _of_sensor(name: str, heading: str, make: Callable[[SensorDesign], StageResult]) -> DemoStage:
    """A stage that depends on the sensor's design only."""
    return DemoStage(
        name,
        heading,
        lambda demo: {"design": dataclasses.asdict(_design(demo))},
        lambda demo: make(_design(demo)),
    )


def _design(demo: Workspace) -> SensorDesign:
    return demo.plan.recipes["quick"].sensor


def _evaluation(name: str, heading: str, frames: str, which: str) -> DemoStage:
    """A stage that evaluates one pipeline on one dataset."""
    return DemoStage(
        name,
        heading,
        lambda demo: {**_weights(demo, which), "frames": demo.frames[frames]},
        lambda demo: measured.evaluated(demo.pipeline(which), demo.sets[frames]),
        lambda result: paper_table(measured.report_of(result)),
    )


def _weights(demo: Workspace, *which: str) -> dict[str, Any]:
    return {"weights": {name: demo.weights[name] for name in which}}


STAGES = (
    _of_sensor("sensor", "The sensor", sensor.flat_sensor),
    _of_sensor("states", "Bent and touched", sensor.deformed_sensor),
    DemoStage(
        "sets",
        "Training and test frames",
        lambda demo: {"frames": demo.frames},
        lambda demo: measured.contents(demo.sets, demo.plan.recipes),
    ),
    DemoStage(
        "training",
        "Training",
        lambda demo: _weights(demo, TRAINED),
        lambda demo: measured.training(demo.pipeline(TRAINED)),
    ),
    _evaluation("test", "Trained here: other frames, of a finer mesh", "quick_test", TRAINED),
    _evaluation("indentation", "Trained here: 27 positions", "paper_indentation", TRAINED),
    _evaluation("shipped", "Comes with eitskin: the same frames", "quick_test", SHIPPED),
    _evaluation(
        "shipped_indentation", "Comes with eitskin: 27 positions", "paper_indentation", SHIPPED
    ),
    DemoStage(
        "latency",
        "Time per frame",
        lambda demo: {**_weights(demo, TRAINED, SHIPPED), "frames": demo.frames["quick_test"]},
        lambda demo: measured.latency(
            {which: demo.pipeline(which) for which in (TRAINED, SHIPPED)}, demo.sets["quick_test"]
        ),
    ),
    DemoStage(
        "live",
        "The saved pipeline, unchanged, on a virtual board over a serial link",
        lambda demo: {**_weights(demo, TRAINED), "step": demo.plan.episode_frames},
        lambda demo: measured.live(
            demo.pipeline(TRAINED), _design(demo), demo.plan.seed, demo.plan.episode_frames
        ),
        lambda result: episode_table(result.numbers["steps"]),
    ),
    DemoStage(
        "real",
        "Real recordings",
        lambda demo: {**_weights(demo, TRAINED), "files": recordings.checksums(demo.data)},
        lambda demo: recordings.real_recordings(demo.data, demo.out, demo.pipeline(TRAINED)),
    ),
)
"""All stages in their order."""
