"""Serial board: faults on the wire, on connecting, and of cables."""

import dataclasses
import threading
from pathlib import Path

import numpy as np
import pytest
import serial

from eitskin.errors import ConfigurationError, DeviceError
from eitskin.geometry import Bend
from eitskin.hardware import Connection, Script, SerialBoard, Step, open_board
from eitskin.hardware.boards.board import FIRST_PAUSE, MAX_PAUSE, longest_silence
from eitskin.hardware.boards.port import ReopenablePort, UnrecoverableError
from eitskin.hardware.protocol.messages import Ack, pack
from eitskin.hardware.protocol.packets import FrameData, MessageType, encode
from eitskin.hardware.virtual.virtual_board import virtual_terminal
from eitskin.simulator import Scene

from live_fakes import FakeBoard
from loopback import FakeSimulator, Loopback, connected, firmware, take, virtual


@pytest.fixture
def running():
    """A board that has given its first frame, its port, and the frames to come."""
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)
    return board, port, frames


# ---- what goes wrong on the wire ----


def test_silence_for_three_periods_is_a_stale_stream(running):
    _board, port, frames = running
    port.firmware.streaming = False
    began = port.now
    with pytest.raises(DeviceError, match=r"stale.*0\.890 s"):
        next(frames)
    assert 3 * 0.2968 <= port.now - began < 3 * 0.2968 + 0.1
    # A firmware that tells of an hour is not waited for; nor one without a period.
    waits = [longest_silence(period) for period in (0.1, 0.3, 174.0, 4295.0, float("nan"), -0.0)]
    assert waits == pytest.approx([0.5, 0.9, 522.0, 600.0, np.inf, np.inf])


def test_a_restart_with_another_table_or_without_end_is_an_error(running):
    _board, port, frames = running
    port.firmware.frame = port.firmware.boot

    def start(data, receive=port.firmware.receive):
        answer = receive(data)
        port.firmware.streaming = True
        return answer

    port.firmware.receive = start
    with pytest.raises(DeviceError, match="stale"):
        next(frames)
    port.firmware.info = dataclasses.replace(port.firmware.info, table_crc32=1)
    port.waiting += port.firmware.boot()
    with pytest.raises(DeviceError, match=r"expected board .*table"):
        next(_board.frames())


def test_the_newest_frame_overtakes_the_others_and_those_unread_for_long_are_not_new():
    board, port = connected(firmware())
    frames = board.frames(newest=True)
    next(frames)
    port.waiting += b"".join(port.firmware.frame() for _ in range(200))
    assert next(frames).number == 200
    assert (board.counts.skipped, board.lost, board.counts.frames) == (199, 0, 2)
    port.waiting += b"".join(port.firmware.frame() for _ in range(5))
    for _ in range(100):
        port.firmware.skip()  # its queues were full
    port.now += 60.0
    assert next(frames).number > 305
    assert board.counts.frames + board.counts.skipped == next(frames).number
    assert board.lost == 0


# ---- what goes wrong on connecting ----


def test_a_request_is_repeated_under_the_same_number_and_then_given_up():
    _, port = connected(firmware(), deaf=2)
    hellos = [packet.seq for packet in port.heard if packet.type == MessageType.HELLO]
    assert hellos == hellos[:1] * 3
    port = Loopback(firmware())
    port.deaf = 99
    with pytest.raises(DeviceError, match=r"HELLO.*0\.5 s.*3"):
        SerialBoard(lambda: port, "serial:x", clock=port.clock)
    assert 1.5 <= port.now < 1.8
    assert [packet.type for packet in port.heard].count(MessageType.HELLO) == 3
    assert port.closed


def test_a_frame_of_another_length_is_dropped_and_an_old_answer_is_none(running):
    board, port, frames = running
    short = FrameData(1, 0.0, 0.0, np.ones(3, np.complex64), np.zeros(3, np.uint8))
    port.waiting += encode(pack(short, 0))
    assert next(frames).number == 1
    assert board.counts.dropped == {"malformed message": 1}
    port.deaf = 99
    port.firmware.streaming = False
    port.waiting += encode(pack(Ack(1, MessageType.CALIBRATE, 4), 0))
    with pytest.raises(DeviceError, match="answer to CALIBRATE"):
        board.calibrate()


# ---- connection ----


def test_frames_go_on_after_the_board_has_been_away():
    waits, reasons, gone = [], [], DeviceError("went away")

    def wait(seconds):
        waits.append(seconds)
        reasons.append(connection.problem)

    board = FakeBoard([1, 2, gone, gone, 3, gone, 4], failures=7)
    connection = Connection(board, wait=wait)
    assert list(connection.frames()) == [1, 2, 3, 4]
    assert board.tries == 10
    assert reasons[:2] == ["went away", "not there yet"]
    assert connection.problem == ""
    # Doubled up to the longest, also where it goes away at once; anew after a frame.
    assert waits[:3] == pytest.approx([FIRST_PAUSE, 0.2, 0.4])
    assert waits[7:] == [MAX_PAUSE, MAX_PAUSE, FIRST_PAUSE]


@pytest.mark.parametrize(
    ("meanwhile", "expected", "lost"),
    [
        (lambda board: [board.skip() for _ in range(5)], [(1, 8), (1, 9)], 5),
        (lambda board: board.boot(), [(2, 0), (2, 1)], 0),  # a new session
        # A board that counts anew and does not say so is believed.
        (lambda board: setattr(board, "number", 0), [(1, 0), (1, 1)], 0),
    ],
)
def test_frames_after_a_board_was_away(running, meanwhile, expected, lost):
    board, port, frames = running
    port.waiting += port.firmware.frame() + port.firmware.frame()[:100]  # half a packet
    next(frames)
    meanwhile(port.firmware)
    board.reconnect()
    assert [(frame.session, frame.number) for frame in take(board, 2)] == expected
    lost_half = expected[0] == (1, 8)
    assert (board.lost, board.counts.reconnections) == (lost + lost_half, 1)
    assert board.counts.dropped == {}


@pytest.mark.parametrize("changes", [{"uid": b"another one!"}, {"table_crc32": 7}])
def test_another_board_is_refused(changes):
    board, port = connected(firmware())
    known = board.info
    port.firmware.info = dataclasses.replace(port.firmware.info, **changes)
    with pytest.raises(UnrecoverableError, match=r"expected board .*found board"):
        board.reconnect()
    assert board.info == known


# ---- cables ----


@pytest.mark.parametrize("error", [serial.SerialException("gone"), OSError(5, "gone"), TypeError()])
@pytest.mark.parametrize("method", ["read", "in_waiting"])
def test_each_way_a_port_dies_is_the_same_error(running, error, method, monkeypatch):
    board, port, frames = running

    def die(*_):
        raise error

    monkeypatch.setattr(Loopback, method, property(die) if method == "in_waiting" else die)
    with pytest.raises(DeviceError, match="went away"):
        next(frames)
    board.close()
    assert port.closed
    with pytest.raises(UnrecoverableError, match="is closed"):
        list(Connection(board, wait=lambda _: None).frames())


def test_closing_closes_the_port_and_ends_what_other_threads_read_or_open():
    port = Loopback(firmware())
    ReopenablePort(lambda: port, "serial:x").close()
    assert port.closed
    failures, first = [], threading.Event()
    board = virtual()

    def read():
        try:
            for _ in board.frames():
                first.set()
        except DeviceError as error:
            failures.append(str(error))

    thread = threading.Thread(target=read)
    thread.start()
    assert first.wait(300.0)
    board.close()
    thread.join(300.0)
    assert not thread.is_alive()
    assert len(failures) == 1

    ports = []

    def connect():
        ports.append(Loopback(firmware()))
        if len(ports) == 2:
            held.close()
        return ports[-1]

    held = ReopenablePort(connect, "serial:x")
    with pytest.raises(UnrecoverableError, match="is closed"):
        held.reopen()
    assert [port.closed for port in ports] == [True, True]


@pytest.mark.slow
def test_replugging_leaves_nothing_behind_and_a_link_leads_to_the_board(tmp_path):
    def state():
        return len(list(Path("/dev/fd").iterdir())), threading.active_count()

    link = tmp_path / "ttyEIT"
    with virtual_terminal(speed="max", simulator=FakeSimulator(), link=link) as terminal:
        with open_board(f"serial:{link}") as board:
            frames = Connection(board, wait=lambda _: None).frames()
            next(frames)
            before = state()
            for _ in range(3):
                session = next(frames).session
                terminal.firmware.stage.inject("replug")
                while next(frames).session == session:
                    pass
            assert state() == before
        assert board.counts.reconnections >= 3
        assert link.is_symlink()
    assert not link.is_symlink()


def test_a_link_is_left_to_a_file_and_to_a_board_that_took_it_over(tmp_path):
    link, notes = tmp_path / "ttyEIT", tmp_path / "notes"
    first, second = (virtual_terminal(simulator=FakeSimulator(), link=link) for _ in range(2))
    first.close()
    assert str(link.readlink()) == second.path
    second.close()
    assert not link.is_symlink()
    notes.write_text("kept")
    with pytest.raises(ConfigurationError, match="no link"):
        virtual_terminal(simulator=FakeSimulator(), link=notes)
    assert notes.read_text() == "kept"


# ---- the stage ----


def test_the_board_never_waits_for_whoever_sets_a_scene_and_goes_on_after_an_impossible_one():
    begun, go_on = threading.Event(), threading.Event()

    class Slow(FakeSimulator):
        def impedance_matrix(self, scene):
            if scene.bend.angle_deg > 60:
                raise ConfigurationError("bend")
            if scene.bend.angle_deg:
                begun.set()
                assert go_on.wait(300.0)
            return super().impedance_matrix(scene)

    with open_board("virtual:?speed=max", simulator=Slow()) as board:
        with pytest.raises(ConfigurationError, match="bend"):
            board.stage.set(Scene(bend=Bend(90.0)))
        assert board.stage.scene == Scene()
        script = Script((Step(Scene(bend=Bend(20.0)), 2),))
        setter = threading.Thread(target=board.stage.play, args=(script,))
        setter.start()
        assert begun.wait(300.0)
        assert len(take(board, 50)) == 50
        go_on.set()
        setter.join()
        frames = board.frames(newest=True)
        while not board.stage.truth(next(frames).number).bend.angle_deg:
            pass


def test_faults_that_are_injected_strike_at_once_and_are_named(running):
    _board, port, frames = running
    stage = port.firmware.stage
    numbers = [next(frames).number for _ in range(7)]
    stage.inject("lost_frame, nan_channel:3")
    with pytest.raises(ConfigurationError, match="lost_frame"):
        stage.inject("lost_fram")
    numbers += [next(frames).number for _ in range(2)]
    assert numbers == [*range(1, 8), 9, 10]
    assert stage.faults == ("nan_channel:3",)  # the other one is over
    assert next(frames).status.any()
    stage.clear()
    assert not next(frames).status.any()
