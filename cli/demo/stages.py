"""The stages of a demo, each kept: from the bare sensor to a pipeline on a live board."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from rich.table import Table

from eitskin.cli.commands.evaluate import paper_table
from eitskin.cli.demo import (
    measured as demo_measured,
)
from eitskin.cli.demo import (
    real_input,
)
from eitskin.cli.demo import (
    sensor as demo_sensor,
)
from eitskin.cli.demo import (
    sets as demo_sets,
)
from eitskin.cli.demo.folder import HERE, RESULTS, SHIPPED, Demo, made_with
from eitskin.cli.demo.parts import Kept, Part, keep
from eitskin.cli.episode import episode_table


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of the demo.

    Attributes:
        name: of the part and its file.
        heading: that it has on the screen and in the report.
        made_from: what decides over it, beside the versions and the seed.
        make: it, from what the demo has so far.
        table: of its numbers for the screen, beside what the part tells.
    """

    name: str
    heading: str
    made_from: Callable[[Demo], Mapping[str, Any]]
    make: Callable[[Demo], Part]
    table: Callable[[Part], Table] | None = None


def run_stages(demo: Demo) -> dict[str, Kept]:
    """Every stage in turn, by its name; those that lie in the demo's folder are taken from there.

    Raises PartialError where the folder cannot be written to any more; the same demo goes on then.
    """
    parts = {}
    for number, stage in enumerate(STAGES, 1):
        demo.output.heading(f"{number}. {stage.heading}")
        start = time.perf_counter()  # sets are made, and a pipeline trained, when first asked for
        made_from = {"versions": made_with(), "seed": demo.plan.seed, **stage.made_from(demo)}
        path = demo.out / RESULTS / f"{stage.name}.json"
        kept = parts[stage.name] = keep(path, made_from, partial(stage.make, demo), start)
        if stage.table:
            demo.output.show(stage.table(kept.part))
        for sentence in kept.part.told:
            demo.output.show(sentence)
    return parts


def _of_design(demo: Demo) -> dict[str, Any]:
    return {"design": dataclasses.asdict(demo.plan.recipes["quick"].sensor)}


def _of_weights(*which: str) -> Callable[[Demo], dict[str, Any]]:
    return lambda demo: {"weights": {name: demo.weights[name] for name in which}}


def _of_frames(name: str, *which: str) -> Callable[[Demo], dict[str, Any]]:
    return lambda demo: {**_of_weights(*which)(demo), "frames": demo.frames[name]}


def _measured(name: str, which: str) -> Callable[[Demo], Part]:
    return lambda demo: demo_measured.evaluated(demo.pipeline(which), demo.sets[name])


def _report_table(part: Part) -> Table:
    return paper_table(demo_measured.report_of(part))


STAGES = (
    Stage(
        "sensor",
        "The sensor",
        _of_design,
        lambda demo: demo_sensor.sensor(demo.plan.recipes["quick"].sensor),
    ),
    Stage(
        "states",
        "Bent and pressed",
        _of_design,
        lambda demo: demo_sensor.states(demo.plan.recipes["quick"].sensor),
    ),
    Stage(
        "sets",
        "Training and test frames",
        lambda demo: {"frames": demo.frames},
        lambda demo: demo_sets.sets(demo.sets, demo.plan.recipes),
    ),
    Stage(
        "training",
        "Training",
        _of_weights(HERE),
        lambda demo: demo_measured.training(demo.pipeline(HERE)),
    ),
    Stage(
        "test",
        "The pipeline trained here, on frames of a finer mesh and other seeds",
        _of_frames("quick_test", HERE),
        _measured("quick_test", HERE),
        _report_table,
    ),
    Stage(
        "indentation",
        "The pipeline trained here at the paper's 27 places",
        _of_frames("paper_indentation", HERE),
        _measured("paper_indentation", HERE),
        _report_table,
    ),
    Stage(
        "shipped",
        "The pipeline that comes with eitskin, trained on other sensors",
        _of_frames("quick_test", SHIPPED),
        _measured("quick_test", SHIPPED),
        _report_table,
    ),
    Stage(
        "shipped_indentation",
        "The pipeline that comes with eitskin at the paper's 27 places",
        _of_frames("paper_indentation", SHIPPED),
        _measured("paper_indentation", SHIPPED),
        _report_table,
    ),
    Stage(
        "latency",
        "Time per frame",
        _of_frames("quick_test", HERE, SHIPPED),
        lambda demo: demo_measured.latency(
            {name: demo.pipeline(name) for name in (HERE, SHIPPED)}, demo.sets["quick_test"]
        ),
    ),
    Stage(
        "live",
        "The saved pipeline, unchanged, on a virtual board over a serial link",
        lambda demo: {**_of_weights(HERE)(demo), "step": demo.plan.episode_frames},
        lambda demo: demo_measured.live(
            demo.pipeline(HERE), demo.plan.seed, demo.plan.episode_frames
        ),
        lambda part: episode_table(part.numbers["steps"]),
    ),
    Stage(
        "real",
        "Real recordings",
        lambda demo: {**_of_weights(HERE)(demo), "files": real_input.sums(demo.data)},
        lambda demo: real_input.real(demo.data, demo.out, demo.pipeline(HERE)),
    ),
)
"""In their order."""
