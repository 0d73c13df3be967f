"""Fake pipelines and boards for the live loop."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import typer
from typer.testing import CliRunner

from eitskin.cli.commands.live import command as live
from eitskin.datasets import State
from eitskin.hardware import Counts
from eitskin.simulator import Frame
from eitskin.training import Pipeline

from loopback import PROTOCOL, FakeSimulator


@dataclass
class Estimate:
    state: State | str = State.TOUCH
    probabilities: tuple = (0.1, 0.8, 0.1)
    bend_angle_deg: float = -12.5
    touch_map: np.ndarray = field(default_factory=lambda: np.zeros((32, 80)))
    touches: tuple = ((0.05, 0.02, 0.9),)
    problems: tuple = ()


class FakePipeline:
    """Gives one estimate for every frame; may be slow, or be interrupted."""

    stored_reference, expected_magnitudes, flat_sensors = None, None, "known"

    def __init__(self, estimate=None, interrupt_at=None):
        self.estimate, self.interrupt_at = estimate or Estimate(), interrupt_at
        self.layout = SimpleNamespace(
            known_design=None, known_protocol=None, require_same_measurements=lambda *_: None
        )
        self.seen = []

    def process(self, frame):
        self.seen.append(frame.number)
        if len(self.seen) == self.interrupt_at:
            raise KeyboardInterrupt
        return self.estimate


class FakeBoard:
    """Frames from a list; remembers how it was asked."""

    counts = Counts()

    def __init__(self, frames):
        self._frames = frames

    def frames(self, newest=False):
        self.newest = newest
        yield from self._frames


def frame(number=0, **changes):
    return Frame(np.full(28, 600.0), PROTOCOL, 0.3 * number, number, **changes)


def run_command(monkeypatch, pipeline, *arguments):
    """Run `eitskin live` with the given pipeline in place of a trained one."""
    monkeypatch.setattr(Pipeline, "load", lambda *_: pipeline)
    monkeypatch.setattr(
        "eitskin.hardware.virtual.virtual_board.Simulator", lambda *_, **__: FakeSimulator()
    )
    app = typer.Typer()
    app.command()(live.command)
    return CliRunner().invoke(app, ["a.eitmodel", *arguments])
