"""The command `eitskin live` on fake pipelines: what it prints, records and publishes."""

import errno
import json
import os
import time
import types
from dataclasses import replace
from functools import partial
from unittest import mock

import numpy as np
import pytest
from mcap_reader import read
from rich.console import Console

from eitskin.cli.commands.live.session import LiveSession, Recording, touch_picture
from eitskin.cli.options import Output, opened_board
from eitskin.datasets import ShardWriter, open_dataset
from eitskin.errors import PartialError
from eitskin.geometry import Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.hardware import Connection, Reading
from eitskin.hardware.ros2 import skin_node
from eitskin.simulator import Protocol, Status
from eitskin.training import InputSpec, Zero

from live_fakes import (
    NOT_ESTIMATED,
    PROTOCOL,
    Estimate,
    FakeBoard,
    FakePipeline,
    Info,
    frame,
    run_command,
)
from on_demand import OnDemand

rosbag2 = OnDemand("rosbags.rosbag2")

BOARD = ("--board", "virtual:?speed=max")


@pytest.fixture
def run(monkeypatch):
    return partial(run_command, monkeypatch)


def test_the_command_shows_frames_as_json_and_lines_and_says_what_is_not_estimated(run):
    result = run(FakePipeline(), *BOARD, "--json", "--frames", "4")
    assert result.exit_code == 0
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(lines) == 4
    assert lines[0]["state"] == "touch"
    (touch,) = lines[0]["touches"]
    assert touch == {"x": 0.05, "y": 0.02, "strength": 0.9, "force": None, "deviation": None}
    assert lines[0]["wall_time"] == pytest.approx(time.time(), abs=3600.0)
    assert lines[0]["bend_angle_deg"] == -12.5
    assert lines[0]["rate_hz"] is None
    assert lines[-1]["bad_channels"] == {}
    assert lines[-1]["problems"] == []
    assert lines[-1]["number"] == lines[-1]["skipped"] + 3
    board = "virtual:?speed=max&faults=nan_channel@0:1"
    pipeline = FakePipeline(Estimate(problems=("electrode 3 is open",)))
    result = run(pipeline, "--board", board, "--frames", "3", "--every-frame")
    assert result.exit_code == 0
    for shown in ("touch", "-12.5", "50, 20", "0 lost", "0-2 not finite", "electrode 3 is open"):
        assert shown in result.stdout
    assert result.stdout.endswith("\n"), "what is said next begins a line"
    assert "3 frames processed" in result.stderr
    quiet = run(FakePipeline(), *BOARD, "--frames", "3", "-q")
    assert (quiet.exit_code, quiet.output) == (0, "")
    unknown = Estimate(**NOT_ESTIMATED, probabilities=(np.nan, 0.9, 0.1))
    pipeline, board = FakePipeline(unknown), ("--board", "virtual:?speed=max", "--frames", "1")
    line = json.loads(run(pipeline, *board, "--json").stdout)
    assert [line[name] for name in ("state", "bend_angle_deg", "touches")] == [None] * 3
    assert line["probabilities"] == {"idle": None, "touch": 0.9, "bend": 0.1}
    shown = run(pipeline, *board).stdout
    assert shown.count("not estimated") == 3
    assert "touch map" not in shown


@pytest.mark.slow
def test_a_virtual_board_imitates_the_pipelines_sensor_unless_it_is_described():
    outline = Rectangle(0.06, 0.04)
    ring = uniform(outline, 5, 0.004)
    patch = replace(SensorDesign.reference(), outline=outline, electrodes=ring)
    layout = InputSpec(patch, Protocol.from_name("adjacent", 5), 40e3, np.ones(10))
    for query, electrodes in (("", 5), ("&protocol=pairwise", 8)):
        with opened_board(f"virtual:?speed=max&resolution=coarse{query}", 0, layout) as board:
            assert board.protocol.n_electrodes == electrodes


def test_the_seed_is_the_virtual_boards(run, tmp_path):
    def recorded(name, *arguments):
        run(FakePipeline(), "--frames", "2", "--record", str(tmp_path / name), *arguments)
        return open_dataset(tmp_path / name).impedance

    first = recorded("a", "--board", "virtual:?speed=max", "--seed", "5")
    assert np.array_equal(first, recorded("b", "--board", "virtual:?speed=max&seed=5"))
    assert not np.array_equal(first, recorded("c", "--board", "virtual:?speed=max"))


def session_of(board, **known):
    output = Output(console=Console(width=100), notes=Console(width=200))
    return LiveSession(Connection(board), output, clock=lambda: 50.0, **known)


def reading(number=0, **changes):
    return Reading(frame(number, **changes), Estimate(), 0.001, 3.0)


def shown(session):
    console = Console(width=100)
    with console.capture() as capture:
        console.print(session.view())
    return capture.get()


def test_nothing_old_is_shown_as_new_and_a_new_session_is_announced():
    session = session_of(FakeBoard())
    session.take(reading())
    assert "nothing for" not in shown(session)
    session.clock = lambda: 50.8
    assert "nothing for" not in shown(session)  # three periods, but a busy machine may do that
    session.clock = lambda: 57.0
    session.connection.problem = "went away"
    assert "nothing for 7 s" in shown(session)
    session.connection.board.info = Info(period=float("nan"))
    session.clock = lambda: 1e6
    assert "nothing for" not in shown(session)  # of a board whose period is unknown
    session = session_of(
        FakeBoard(), pipeline=types.SimpleNamespace(expected_magnitudes=np.full(28, 600.0))
    )
    with session.output.notes.capture() as capture:
        for number in range(40):
            status = np.zeros(28, np.uint8)
            status[[3 in row for row in PROTOCOL.table]] = Status.OPEN * (number >= 20)
            session.take(reading(number, session=1 + (number >= 20), status=status))
    said = capture.get()
    assert said.count("session 2 begins") == 1
    assert "electrode 3 is open" in said.partition("session 2 begins")[2]
    assert "electrode 3 is open" not in said.partition("session 2 begins")[0]


@pytest.fixture
def full_disk(monkeypatch):
    """A disk, or folder, that takes so many files from now on."""

    def fill(files, code=errno.ENOSPC):
        left = [files]

        def counted(path, flags, *mode, real=os.open):
            left[0] -= bool(flags & os.O_EXCL)
            if left[0] < 0 and flags & os.O_EXCL:
                raise OSError(code, os.strerror(code))
            return real(path, flags, *mode)

        monkeypatch.setattr(os, "open", counted)

    return fill


@pytest.mark.parametrize(
    ("files", "readable", "code"),  # a shard, the manifest, and so on
    [(0, 0, 28), (1, 0, errno.EROFS), (2, 4, errno.EACCES), (3, 4, 28), (4, 8, errno.EDQUOT)],
)
def test_a_disk_that_fails_ends_only_the_recording(tmp_path, full_disk, files, readable, code):
    recording = Recording(ShardWriter(tmp_path / "r", frames_per_shard=4), tmp_path / "r")
    session = session_of(FakeBoard(), recordings=[recording])
    full_disk(files, code)
    with session.output.notes.capture() as capture:
        for number in range(11):
            session.take(reading(number))
        recording.close()
    # The last shard is written when the session has ended, and the command says what it lacks.
    assert capture.get().count("recording stopped: cannot write") == (files < 4)
    assert (session.processed, recording.missing) == (11, 11 - readable)
    assert os.strerror(code) in recording.problem
    assert "make room" not in recording.problem
    if readable:
        assert len(open_dataset(tmp_path / "r")) == readable


def test_the_command_outlives_an_unplugged_cable(run):
    board = "virtual:?speed=max&period=0.01&faults=replug@4"
    result = run(FakePipeline(), "--board", board, "--frames", "30", "--json", "--every-frame")
    assert result.exit_code == 0
    last = json.loads(result.stdout.splitlines()[-1])
    assert (last["session"], last["reconnections"]) == (2, 1)
    assert result.stderr.count("went away") == result.stderr.count("the board is back") == 1


def test_the_touch_map_is_drawn_with_y_up():
    touch_map = np.zeros((32, 80))
    touch_map[0, 0] = 1.0  # (0, 0) mm, lower left
    touch_map[31, 79] = 1.0  # (150, 60) mm, upper right
    touch_map[16:18, 40] = 1.0
    lines = touch_picture(touch_map).plain.split("\n")
    assert [len(line) for line in lines] == [80] * 16
    assert (lines[15][0], lines[0][79], lines[7][40]) == ("▄", "▀", "█")
    assert sum(line.count(" ") for line in lines) == 80 * 16 - 3


@pytest.mark.slow
def test_ctrl_c_leaves_a_whole_file_beside_a_whole_recording(run, tmp_path, monkeypatch):
    monkeypatch.setattr("time.time_ns", lambda: 5_000_000_000)
    path, folder = tmp_path / "run.mcap", tmp_path / "r"
    kept = ("--mcap", str(path), "--record", str(folder))
    result = run(FakePipeline(errors={4: KeyboardInterrupt()}), *BOARD, *kept)
    assert result.exit_code == 130
    stamps, written = zip(*read(path)["/eitskin/impedance"], strict=True)
    assert stamps[0] == 5_000_000_000
    np.testing.assert_allclose(np.diff(stamps), 0.2968e9)
    written = [message.data[::2] for message in written]
    np.testing.assert_array_equal(written, open_dataset(folder).impedance.real)
    angles = [message.position[0] for _, message in read(path)["/eitskin/bend"]]
    assert angles == [np.radians(-12.5)] * 4
    assert len(written) == 4
    assert sorted(tmp_path.iterdir()) == [folder, path]


def test_a_full_disk_ends_the_file_and_not_the_session(run, tmp_path, monkeypatch, full_disk):
    left, real = [9], rosbag2.Writer.write  # until the second frame

    def write(*arguments):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        real(*arguments)

    monkeypatch.setattr(rosbag2.Writer, "write", write)
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
    (unfinished,) = (tmp_path / "run.mcap.unfinished").iterdir()
    assert unfinished.read_bytes().startswith(b"\x89MCAP0\r\n")
    full_disk(0)
    result = run(FakePipeline(), *BOARD, "--frames", "3", "--record", str(tmp_path / "full"))
    assert isinstance(result.exception, PartialError)
    assert "3 frames" in str(result.exception)


def test_every_reading_is_published_and_the_node_closed(run, monkeypatch):
    node = mock.MagicMock(refused=2)
    node.return_value.__enter__.return_value = node
    monkeypatch.setattr(skin_node, "SkinNode", node)
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    result = run(FakePipeline(), *BOARD, "--frames", "3", "--ros2", "--ros2-namespace", "pad")
    assert result.exit_code == 0, result.output
    assert node.call_args.args[:2] == ("pad", 7)
    assert node.publish.call_count == 3
    assert node.return_value.__exit__.called
    assert "2 ROS 2 messages found no room" in result.stderr


def test_the_service_takes_a_zero_of_the_session_s_kind():
    """Flat, unless the session's stored reference is of a mounted sensor."""
    frames = [frame(0), frame(1)]
    board = FakeBoard(uri="serial:x", info=Info(uid=bytes(range(12))))
    pipeline = mock.Mock(stored_reference=None)
    session = session_of(board, pipeline=pipeline)
    assert session.tare(frames) == "zero: the sensor flat, mean of 2 frames"
    pipeline.stored_reference = types.SimpleNamespace(zero=Zero.MOUNTED)
    assert session.tare(frames) == "zero: the sensor as mounted, mean of 2 frames"
    asked = [call.args for call in pipeline.tare.call_args_list]
    known = bytes(range(12)).hex(), "serial:x"
    assert asked == [(frames, zero, *known) for zero in (Zero.FLAT, Zero.MOUNTED)]
