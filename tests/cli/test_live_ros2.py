"""`eitskin live --ros2`: what the node of a session is given, and the zero that it sets."""

import types

import pytest

from eitskin.cli.commands.live.session import LiveSession
from eitskin.cli.options import Output
from eitskin.errors import ConfigurationError
from eitskin.hardware import Connection
from eitskin.hardware.ros2 import skin_node
from eitskin.training.method.predictions import Zero

from live_fakes import FakePipeline, frame, run_command

BOARD = ("--board", "virtual:?speed=max", "--frames", "3", "-q")


@pytest.fixture
def nodes(monkeypatch):
    """Nodes that were made, which only remember."""
    made = []

    class FakeNode:
        refused = 2

        def __init__(self, name, domain, tare):
            self.name, self.domain, self.tare = name, domain, tare
            self.published, self.closed = [], False
            made.append(self)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self.closed = True

        def publish(self, reading):
            self.published.append(reading.frame.number)

    monkeypatch.setattr(skin_node, "SkinNode", FakeNode)
    return made


def test_every_reading_is_published_and_the_node_closed(monkeypatch, nodes):
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    result = run_command(
        monkeypatch, FakePipeline(), *BOARD[:-1], "--ros2", "--ros2-namespace", "pad"
    )
    assert result.exit_code == 0, result.output
    (node,) = nodes
    assert (node.name, node.domain, node.closed) == ("pad", 7, True)
    assert len(node.published) == 3
    assert "2 ROS 2 messages found no room" in result.stderr


def test_without_the_option_there_is_no_node(monkeypatch, nodes):
    assert run_command(monkeypatch, FakePipeline(), *BOARD).exit_code == 0
    assert not nodes


def test_an_impossible_name_ends_the_command(monkeypatch):
    pytest.importorskip("cyclonedds")
    words = (*BOARD, "--ros2", "--ros2-namespace", "2nd")
    result = run_command(monkeypatch, FakePipeline(), *words)
    assert isinstance(result.exception, ConfigurationError)


def test_the_service_takes_a_zero_of_the_session_s_kind():
    """Flat, unless the session's stored reference is of a mounted sensor."""
    info = types.SimpleNamespace(uid=bytes(range(12)), period=0.3)
    board = types.SimpleNamespace(uri="serial:x", info=info, counts=None)
    asked = []

    def tare(*arguments):
        asked.append(arguments)
        pipeline.stored = types.SimpleNamespace(zero=Zero.MOUNTED)

    pipeline, frames = types.SimpleNamespace(tare=tare), [frame(0), frame(1)]
    session = LiveSession(Connection(board), Output(quiet=True), pipeline)
    assert session.tare(frames) == "zero: the sensor flat, mean of 2 frames"
    assert session.tare(frames) == "zero: the sensor as mounted, mean of 2 frames"
    assert asked == [
        (frames, zero, bytes(range(12)).hex(), "serial:x") for zero in (Zero.FLAT, Zero.MOUNTED)
    ]
