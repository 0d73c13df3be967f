"""Boards: one suite for all of them, how they are opened, recordings, the command."""

import contextlib
import dataclasses
import importlib.metadata
import itertools
import os
import signal
import subprocess
import sys
import termios
import types

import numpy as np
import pytest
import serial.tools.list_ports

from eitskin.datasets import Dataset, ShardWriter, write_shard
from eitskin.errors import ConfigurationError, DataError, DeviceError
from eitskin.hardware import ReplayBoard, open_board
from eitskin.hardware.boards import port
from eitskin.hardware.boards.port import (
    PortInfo,
    connector,
    open_port,
    usb_serial_number,
)
from eitskin.hardware.protocol.messages import Table
from eitskin.hardware.virtual.virtual_board import virtual_terminal
from eitskin.simulator import Frame, Status

from compiled_firmware import compiled_terminal
from loopback import FLAT, PROTOCOL, FakeSimulator, connected, firmware, take, virtual


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording") / "run"
    rng = np.random.default_rng(1)
    with ShardWriter(folder) as writer:
        for number in range(12):
            status = np.zeros(28, np.uint8)
            status[number] = Status.CLIPPED
            impedance = FLAT + rng.normal(0, 0.1, 28)
            writer.append(Frame(impedance, PROTOCOL, 0.3 * number, number, 7, status=status))
    return folder


@contextlib.contextmanager
def served_by_the_firmware():
    """The firmware in C, behind a pseudo-terminal."""
    with compiled_terminal() as terminal, open_board(f"serial:{terminal.path}") as board:
        yield board


class MeasuredBoard(ReplayBoard):
    """Kind of board of an installed package, with an option of its own."""

    def __init__(self, path, uri, gain="1"):
        super().__init__(path, uri)
        self.gain = float(gain)


def offer(monkeypatch, kind):
    """Have an installed package offer a kind of board, mine:."""
    entry = types.SimpleNamespace(name="mine", load=lambda: kind)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_group: [entry])


@pytest.fixture(params=["virtual", "firmware in C", "replay", "loopback"])
def board(request, recording):
    opened = {
        "virtual": virtual,
        "firmware in C": served_by_the_firmware,
        "replay": lambda: open_board(f"replay:{recording}"),
        "loopback": lambda: connected(firmware())[0],
    }
    with opened[request.param]() as board:
        yield board


# ---- every board ----


@pytest.mark.slow
def test_frames_come_in_order_also_after_calibrating_and_connecting_again(board):
    frames = take(board, 10)
    assert board.protocol == PROTOCOL
    assert all(frame.protocol == PROTOCOL for frame in frames)
    assert [frame.number for frame in frames] == list(range(10))
    assert np.allclose([frame.impedance for frame in frames], FLAT, atol=2.0)
    assert len({frame.session for frame in frames}) == 1
    times = [frame.time for frame in frames]
    assert np.allclose(np.diff(times), board.info.period)
    assert (board.counts.frames, board.lost, board.counts.dropped) == (10, 0, {})
    assert (board.info.frequency, board.info.n_measurements) == (40e3, 28)
    assert board.info.table_crc32 == Table.from_protocol(PROTOCOL).crc32
    first = take(board, 3)
    board.reconnect()
    again = take(board, 3)
    assert again[0].session == first[0].session
    assert all(np.allclose(frame.impedance, FLAT, atol=2.0) for frame in again)
    assert board.counts.frames == 16
    if isinstance(board, ReplayBoard):
        with pytest.raises(ConfigurationError, match="a recording cannot"):
            board.calibrate()
    else:
        board.calibrate()
        assert np.allclose(take(board, 1)[0].impedance, FLAT, atol=2.0)
    board.close()
    board.close()


# ---- opening ----


def test_ports_open_without_flow_control_for_one_program_at_a_time():
    with virtual_terminal(speed="max", simulator=FakeSimulator()) as terminal:
        uri = f"serial:{terminal.path}"
        with open_board(uri) as first:
            with pytest.raises(DeviceError, match="another program"):
                open_board(uri)
            before = take(first, 3)
        with open_board(terminal.path) as second:  # a path alone is a port
            after = take(second, 3)
    assert after[0].number > before[-1].number
    assert after[0].session == before[0].session
    assert (second.lost, second.counts.frames) == (0, 3)
    with virtual_terminal(speed="max", simulator=FakeSimulator()) as terminal:
        port = open_port(terminal.path, "serial:x")
        settings = (port.baudrate, port.xonxoff, port.rtscts, port.exclusive)
        assert settings == (921600, False, False, True)
        port.close()


def test_a_kind_of_board_enters_by_an_entry_point(recording, monkeypatch):
    offer(monkeypatch, MeasuredBoard)
    with open_board(f"mine:{recording}?gain=2") as board:
        assert (type(board), board.gain) == (MeasuredBoard, 2.0)
        assert next(board.frames()).session == 7
    offer(monkeypatch, lambda *_: "no board")
    with pytest.raises(ConfigurationError, match=r"must give an eitskin.hardware.Board, got str"):
        open_board("mine:")
    with pytest.raises(ConfigurationError, match="mine:"):
        open_board("nime:")
    offer(monkeypatch, MeasuredBoard)
    with pytest.raises(ConfigurationError, match="'gains'"):
        open_board("mine:?gains=2")


# ---- recordings ----


def test_recordings_keep_status_count_losses_and_wait_as_recorded_or_are_refused(
    recording, tmp_path
):
    with open_board(f"replay:{recording}") as board:
        frames = list(board.frames())
    assert [int(np.flatnonzero(frame.status)[0]) for frame in frames] == list(range(12))
    assert {frame.session for frame in frames} == {7}
    with ShardWriter(tmp_path / "run") as writer:
        for number, session in ((0, 1), (3, 1), (2**32 - 1, 1), (0, 1), (9, 2), (10, 2)):
            writer.append(Frame(FLAT, PROTOCOL, 0.3 * number, number, session))
    with open_board(f"replay:{tmp_path / 'run'}") as board:
        assert [board.lost for _ in board.frames()] == [0, 2, 2, 2, 2, 2]  # none falls behind
    with pytest.raises(DataError, match="not a complete dataset"):
        open_board(f"replay:{tmp_path}")
    path = tmp_path / "shard-00000.h5"
    write_shard(path, Dataset.from_arrays(np.ones((4, 28), np.complex64)), 0)
    with pytest.raises(DataError, match="--protocol"):
        open_board(f"replay:{path}")
    now, waits = [0.0], []

    def wait(seconds):
        waits.append(seconds)
        now[0] += seconds

    board = ReplayBoard(str(recording), speed="real", clock=lambda: now[0], wait=wait)
    for frame in itertools.islice(board.frames(), 4):
        now[0] += 0.1 if frame.number else 0.0  # time that the listener takes
    assert waits == pytest.approx([0.0, 0.3, 0.2, 0.2])


# ---- the command ----


@pytest.mark.slow
@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGTERM])
def test_eitskin_board_serves_one_host_after_the_other_until_interrupted(ended_by, tmp_path):
    # A program in the background of a script inherits that SIGINT is ignored.
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    script = heard + "import typer; from eitskin.cli.commands.simulate import virtual_board; "
    script += "typer.run(virtual_board)"
    options = ["--speed", "max", "--quiet", "--link", str(tmp_path / "tty")]
    process = subprocess.Popen(
        [sys.executable, "-c", script, *options],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    with process:
        try:
            uri = process.stdout.readline().strip()
            assert uri == f"serial:{tmp_path / 'tty'}"
            numbers = []
            for _ in range(2):
                with open_board(uri) as board:
                    numbers += [frame.number for frame in take(board, 5)]
            assert numbers == sorted(set(numbers))
            process.send_signal(ended_by)
            assert process.wait(300) == 130
            assert not list(tmp_path.iterdir())
        finally:
            process.kill()


# ---- ports ----


BUILT_IN = PortInfo("/dev/ttyS0")
BOARD = PortInfo("/dev/ttyACM0", "EIT board", "ST", 0x0483, 0x5740, "205A3D")
OTHER = PortInfo("/dev/ttyUSB0", "FT232R", "FTDI", 0x0403, 0x6001, "A10 1&2")


@pytest.fixture
def ports(monkeypatch):
    """Ports of this machine, at first a board and a port without USB."""
    here = [BUILT_IN, BOARD]
    monkeypatch.setattr(port, "serial_ports", lambda: here)
    monkeypatch.setattr(port, "open_port", lambda *opened: opened)
    return here


def test_a_board_is_followed_by_its_serial_number_of_a_path_or_link(ports, tmp_path):
    """Also one that was named by its path, or by none where it is the only one of USB."""
    named = connector("", "serial:?usb=205A3D", 1, usb="205A3D")
    by_path = connector("/dev/ttyACM0", "serial:/dev/ttyACM0", 2)
    alone = connector("", "text:", 230400)
    without = connector("/dev/ttyS0", "serial:/dev/ttyS0", 3)
    assert alone() == ("/dev/ttyACM0", "text:", 230400)
    assert [named()[0], by_path()[0]] == ["/dev/ttyACM0"] * 2
    # Another device has its place now.
    ports[:] = [dataclasses.replace(OTHER, device="/dev/ttyACM0")]
    ports.append(dataclasses.replace(BOARD, device="/dev/ttyACM3"))
    assert [named()[0], by_path()[0]] == ["/dev/ttyACM3"] * 2
    ports.clear()
    assert by_path()[0] == "/dev/ttyACM0"
    assert without() == ("/dev/ttyS0", "serial:/dev/ttyS0", 3)
    with pytest.raises(DeviceError, match="205A3D"):
        named()
    ports[:] = [BUILT_IN, dataclasses.replace(BOARD, device=str(tmp_path / "real"))]
    (tmp_path / "by-id").symlink_to(tmp_path / "real")
    paths = (tmp_path / "real", tmp_path / "by-id", "/dev/ttyS0", "/dev/none")
    assert [usb_serial_number(str(path)) for path in paths] == ["205A3D", "205A3D", "", ""]


def test_what_pyserial_lists_is_taken_over_and_named_where_a_port_is_missing(monkeypatch):
    unknown = {"manufacturer": None, "vid": None, "pid": None, "serial_number": None}
    known = {"manufacturer": "ST", "vid": 0x0483, "pid": 0x5740, "serial_number": "205A3D"}
    found = [
        types.SimpleNamespace(device="/dev/ttyUSB0", description="n/a", **unknown),
        types.SimpleNamespace(device="/dev/ttyACM0", description="EIT board", **known),
    ]
    monkeypatch.setattr(serial.tools.list_ports, "comports", lambda: found)
    assert port.serial_ports() == (BOARD, PortInfo("/dev/ttyUSB0"))
    with pytest.raises(DeviceError, match=r"cable.*/dev/ttyACM0 \(EIT board"):
        open_port("/dev/nowhere-at-all", "serial:/dev/nowhere-at-all")

    def vanish(*_, **__):
        raise termios.error(5, "Input/output error")

    monkeypatch.setattr("serial.Serial", vanish)
    with pytest.raises(DeviceError, match="cannot open"):
        open_port("/dev/ttyACM0", "serial:/dev/ttyACM0")
