"""`eitskin live --mcap`: what is written beside a session, whatever ends it."""

import types
from functools import partial

import numpy as np
import pytest
from mcap_reader import read
from rich.console import Console
from rosbags.rosbag2 import Writer

from eitskin.cli.commands.live import session as live
from eitskin.cli.commands.live.session import Recording
from eitskin.cli.options import Output
from eitskin.datasets import open_dataset
from eitskin.errors import DeviceError, PartialError
from eitskin.hardware import Connection, Counts, Reading
from eitskin.hardware.ros2.mcap import McapWriter

from live_fakes import Estimate, FakePipeline, frame, run_command

BOARD = ("--board", "virtual:?speed=max")


@pytest.fixture
def run(monkeypatch):
    return partial(run_command, monkeypatch)


def full_after(monkeypatch, messages):
    """A disk that takes so many messages from now on."""
    left, real = [messages], Writer.write

    def write(*arguments):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        real(*arguments)

    monkeypatch.setattr(Writer, "write", write)


def test_every_frame_and_estimate_is_in_the_file(run, tmp_path, monkeypatch):
    monkeypatch.setattr("time.time_ns", lambda: 5_000_000_000)
    path = tmp_path / "run.mcap"
    result = run(FakePipeline(), *BOARD, "--frames", "6", "--mcap", str(path), "-q")
    assert result.exit_code == 0, result.output
    stamps = [stamp for stamp, _ in read(path)["/eitskin/impedance"]]
    assert stamps[0] == 5_000_000_000
    np.testing.assert_allclose(np.diff(stamps), 0.2968e9)
    angles = [message.position[0] for _, message in read(path)["/eitskin/bend"]]
    assert angles == [np.radians(-12.5)] * 6
    assert list(tmp_path.iterdir()) == [path]


def test_ctrl_c_leaves_a_whole_file_beside_a_whole_recording(run, tmp_path):
    path, folder = tmp_path / "run.mcap", tmp_path / "r"
    kept = ("--mcap", str(path), "--record", str(folder))
    result = run(FakePipeline(interrupt_at=5), *BOARD, *kept)
    assert result.exit_code == 130
    written = [message.data[::2] for _, message in read(path)["/eitskin/impedance"]]
    np.testing.assert_array_equal(written, open_dataset(folder).impedance.real)
    assert len(written) == 4
    assert sorted(tmp_path.iterdir()) == [folder, path]


def test_a_full_disk_ends_the_file_and_not_the_session(run, tmp_path, monkeypatch):
    full_after(monkeypatch, 9)  # in the second frame
    path, folder = tmp_path / "run.mcap", tmp_path / "r"
    kept = ("--mcap", str(path), "--record", str(folder))
    result = run(FakePipeline(), *BOARD, "--frames", "6", *kept)
    assert isinstance(result.exception, PartialError)
    assert "No space left" in str(result.exception)
    assert "run.mcap.unfinished" in str(result.exception)
    assert result.stderr.count("recording stopped: could not write") == 1
    assert "6 frames processed" in result.stderr
    assert len(open_dataset(folder)) == 6
    assert not path.exists()
    (left,) = (tmp_path / "run.mcap.unfinished").iterdir()
    assert left.read_bytes().startswith(b"\x89MCAP0\r\n")


@pytest.mark.parametrize(
    ("ending", "raised"),
    [(KeyboardInterrupt(), PartialError), (DeviceError("the board is gone"), DeviceError)],
)
def test_what_is_lost_is_said_unless_an_error_ends_the_session(
    run, tmp_path, monkeypatch, ending, raised
):
    def full(_):
        raise OSError(28, "No space left on device")

    def end(_):
        raise ending

    monkeypatch.setattr(Writer, "close", full)
    monkeypatch.setattr(live.LiveSession, "sum_up", end)
    result = run(FakePipeline(), *BOARD, "--frames", "2", "--mcap", str(tmp_path / "run.mcap"))
    assert type(result.exception) is raised


def test_after_a_failure_nothing_more_is_written(tmp_path, monkeypatch):
    """Not even where there is room again: a chunk may have been cut short."""
    board = types.SimpleNamespace(counts=Counts(), info=types.SimpleNamespace(period=0.3))
    recording = Recording(McapWriter(tmp_path / "run.mcap"), tmp_path)
    session = live.LiveSession(
        Connection(board),
        Output(notes=Console(width=200)),
        recordings=[recording],
        clock=lambda: 50.0,
    )
    with monkeypatch.context() as patched, session.output.notes.capture() as capture:
        full_after(patched, 3)
        session.take(Reading(frame(0), Estimate(), 0.001, 3.0))
    assert capture.get().count("recording stopped") == 1
    session.take(Reading(frame(1), Estimate(), 0.001, 3.0))
    recording.close()
    assert session.processed == 2
    assert "No space left" in recording.loss
    assert [each.name for each in tmp_path.iterdir()] == ["run.mcap.unfinished"]
