"""Fake pipelines and boards for the live loop."""

import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import typer
from typer.testing import CliRunner

from eitskin.cli.commands.live import command as live
from eitskin.datasets import State
from eitskin.errors import DeviceError
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


NOTHING_LOST = Counts()


@dataclass(frozen=True)
class Info:
    firmware: str = "fake"
    period: float = 0.3
    uid: bytes = b""


@dataclass
class FakeBoard:
    """Frames from steps, of which errors are raised; then the end, or silence until it is closed.

    Remembers how it was asked, and may not be there for the first tries to reconnect.
    """

    steps: Iterable = ()
    silent: bool = False
    failures: int = 0
    uri: str = "fake:"
    stage: object = None
    info: Info = Info()
    counts: Counts = NOTHING_LOST
    protocol, lost, tries = PROTOCOL, 0, 0

    def __post_init__(self):
        self.steps, self.closed = iter(self.steps), threading.Event()

    def frames(self, newest=False):
        self.newest = newest
        for step in self.steps:
            if isinstance(step, Exception):
                raise step
            yield step
        if self.silent:
            self.closed.wait()
            raise DeviceError("closed")

    def reconnect(self):
        self.tries += 1
        if self.tries <= self.failures:
            raise DeviceError("not there yet")

    def close(self):
        self.closed.set()


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
