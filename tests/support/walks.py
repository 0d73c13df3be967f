"""Files that five walks through the code enter, counted by a profiler hook.

    python tests/support/walks.py

prints, for each walk, how many files of the project it enters and how often it changes file.
"""

import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("eitskin", "geometry", "simulator", "datasets", "training", "hardware", "cli")
PREFIXES = tuple(f"{ROOT / room}{os.sep}" for room in ROOMS)
RECIPE = """
name = "walk"
description = "Six frames of two specimens."
seed = 1
resolution = "coarse"
frames_per_shard = 6
sensor = "reference"
[instrument]
board = "ad5940"
[specimens]
count = 2
conductivity = 0.1
[[scenes]]
state = "idle"
count = 2
[[scenes]]
state = "touch"
count = 4
angle_deg = [-20, 50]
touches = [1, 2]
force = [4, 10]
"""


@dataclass
class Walk:
    """Files entered by calls, and how often a call went from one file of the project to another."""

    files: set[str] = field(default_factory=set)
    changes: int = 0
    last: str = ""

    def count_call(self, frame: FrameType, event: str, _: object) -> None:
        """Profiler hook: count a call of a function of the project; imports do not count."""
        file = frame.f_code.co_filename
        if event != "call" or frame.f_code.co_name == "<module>" or not file.startswith(PREFIXES):
            return
        self.files.add(file)
        self.changes += file != self.last
        self.last = file


@contextmanager
def count_walk() -> Iterator[Walk]:
    """Context in which the calls of this thread and of all that it starts are counted."""
    walk = Walk()
    threading.setprofile(walk.count_call)
    sys.setprofile(walk.count_call)
    try:
        yield walk
    finally:
        sys.setprofile(None)
        threading.setprofile(None)


def walks() -> Iterator[tuple[str, Callable[[], object]]]:
    """Each walk with its name, prepared as its user would have prepared it."""
    from typer.testing import CliRunner

    from eitskin import Bend, Pipeline, Recipe, Scene, SensorDesign, Simulator, Touch, generate
    from eitskin.cli.main import app

    near, far = Touch(0.05, 0.02), Touch(0.1, 0.04)
    pressed = Scene(Bend(30.0), (near, far))
    sim = Simulator(SensorDesign.reference())
    yield "scene to frame, two touches on a bend, first time", lambda: sim.measure(pressed)
    again = Scene(Bend(30.0), (near,))
    yield "scene to frame, one touch, tables in memory", lambda: sim.measure(again)
    pipeline = Pipeline.load("reference.eitmodel")
    pipeline.process(sim.measure(Scene()))
    frame = sim.measure(pressed)
    yield "frame to estimate, two touches", lambda: pipeline.process(frame)
    with tempfile.TemporaryDirectory() as folder:
        (path := Path(folder) / "walk.toml").write_text(RECIPE, encoding="utf-8")
        recipe = Recipe.from_toml(path)
        yield "six frames of a recipe", lambda: generate(recipe, Path(folder) / "set", shard=0)
    live = ["live", "reference.eitmodel", "--board", "virtual:", "--page", "--frames", "3"]
    yield "live page, three frames", lambda: CliRunner().invoke(app, live)


def main() -> None:
    """Print the table."""
    for name, run in walks():
        with count_walk() as walk:
            run()
        print(f"{name}: {len(walk.files)} files, {walk.changes} changes of file")  # noqa: T201


if __name__ == "__main__":
    main()
