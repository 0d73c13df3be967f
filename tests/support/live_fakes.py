"""Fake pipelines and boards for the live loop."""

import threading
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import typer
from typer.testing import CliRunner

from eitskin.cli.commands.live import command as live
from eitskin.datasets import State
from eitskin.errors import DeviceError
from eitskin.hardware import Counts
from eitskin.simulator import Frame
from eitskin.training import Estimate as AnyEstimate
from eitskin.training import Pipeline, TouchEstimate

from loopback import PROTOCOL, FakeSimulator, firmware

Estimate = partial(
    AnyEstimate,
    state=State.TOUCH,
    probabilities=(0.1, 0.8, 0.1),
    bend_angle_deg=-12.5,
    bend_deviation_deg=None,
    touch_map=np.zeros((32, 80)),
    touches=(TouchEstimate(0.05, 0.02, strength=0.9),),
    problems=(),
    number=0,
    time=0.0,
)
NOT_ESTIMATED = dict.fromkeys(("state", "bend_angle_deg", "touch_map", "touches"))
Info = partial(replace, firmware().info)


class FakePipeline:
    """Gives one estimate for every frame, but raises the `errors` of some, by their order."""

    stored_reference, expected_magnitudes, flat_sensors = None, None, "known"

    def __init__(self, estimate=None, errors=()):
        self.estimate, self.errors = estimate or Estimate(), dict(errors)
        self.layout = SimpleNamespace(
            known_design=None, known_protocol=None, require_same_measurements=lambda *_: None
        )
        self.seen = []

    def process(self, frame):
        self.seen.append(frame.number)
        if error := self.errors.get(len(self.seen) - 1):
            raise error
        return self.estimate


NOTHING_LOST = Counts()


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
    info: object = Info()
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
