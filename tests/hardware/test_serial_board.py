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
from eitskin.hardware.protocol.frame_parts import FrameData
from eitskin.hardware.protocol.messages import Ack, Event, pack
from eitskin.hardware.protocol.packets import MessageType, Packet, encode
from eitskin.hardware.virtual.virtual_board import virtual_terminal
from eitskin.simulator import Scene

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


def test_a_flood_of_events_hides_no_frame_and_fills_no_memory(running):
    board, port, frames = running
    port.waiting += encode(pack(Event(2, 1, "again"), 0)) * 20_000
    assert [next(frames).number for _ in range(3)] == [1, 2, 3]
    assert len(board.events) == 20


def test_a_firmware_that_tells_of_an_hour_between_frames_is_not_waited_for():
    assert longest_silence(4294.967295) == 600.0
    assert longest_silence(174.0) > 2 * 174.0  # 16,384 channels
    assert longest_silence(0.3) == pytest.approx(0.9)
    assert longest_silence(float("nan")) == longest_silence(-0.0) == float("inf")


def test_a_restart_with_another_table_is_an_error(running):
    _board, port, frames = running
    port.firmware.info = dataclasses.replace(port.firmware.info, table_crc32=1)
    port.waiting += port.firmware.boot()
    with pytest.raises(DeviceError, match=r"expected board .*table"):
        next(frames)


@pytest.mark.parametrize("waiting", [5, 200])
def test_the_newest_frame_overtakes_the_others(waiting):
    board, port = connected(firmware())
    frames = board.frames(newest=True)
    next(frames)
    port.waiting += b"".join(port.firmware.frame() for _ in range(waiting))
    assert next(frames).number == waiting
    assert (board.counts.skipped, board.lost, board.counts.frames) == (waiting - 1, 0, 2)


def test_frames_that_lay_unread_for_long_are_not_given_out_as_new():
    board, port = connected(firmware())
    frames = board.frames(newest=True)
    next(frames)
    port.waiting += b"".join(port.firmware.frame() for _ in range(5))
    for _ in range(100):
        port.firmware.skip()  # its queues were full
    port.now += 60.0
    assert next(frames).number > 105
    assert board.counts.frames + board.counts.skipped == next(frames).number
    assert board.lost == 0


def test_frames_from_before_the_start_are_never_given_out():
    board, port = connected(firmware())
    port.firmware.receive(encode(Packet(MessageType.START, 1, bytes(4))))
    port.waiting += b"".join(port.firmware.frame() for _ in range(5))
    assert take(board, 1)[0].number == 5


# ---- what goes wrong on connecting ----


@pytest.mark.parametrize("deaf", [1, 2])
def test_a_request_is_repeated_under_the_same_number(deaf):
    _, port = connected(firmware(), deaf=deaf)
    hellos = [packet.seq for packet in port.heard if packet.type == MessageType.HELLO]
    assert hellos == hellos[:1] * (deaf + 1)


def test_no_answer_in_three_tries_is_an_error():
    port = Loopback(firmware())
    port.deaf = 99
    with pytest.raises(DeviceError, match=r"HELLO.*0\.5 s.*3"):
        SerialBoard(lambda: port, "serial:x", clock=port.clock)
    assert 1.5 <= port.now < 1.8
    assert [packet.type for packet in port.heard].count(MessageType.HELLO) == 3
    assert port.closed


def answering(response):
    """A port whose board answers every request with the same bytes."""
    port = Loopback(firmware())
    port.firmware.receive = lambda _: response
    return port


@pytest.mark.parametrize(
    ("response", "complaint"),
    [
        (encode(Packet(MessageType.INFO, 0, version=3)), "another version of the protocol"),
        (encode(Packet(MessageType.INFO, 0, b"hello")), "it sent INFO of 5 bytes"),
        (b"\0RzMag: 600.0 Ohm\0", "bad stuffing.*baud rate"),
        (encode(pack(Ack(1, MessageType.HELLO, 3), 0)), "refused HELLO: busy"),
        (encode(pack(Ack(1, MessageType.HELLO, 77), 0)), "status 77; check that its firmware fits"),
        (
            encode(pack(Event(2, 1, "check the SPI"), 0))
            + encode(pack(Ack(1, MessageType.HELLO, 4), 1)),
            r"refused HELLO: failed \(its firmware says: check the SPI\)$",
        ),
    ],
)
def test_a_board_that_speaks_otherwise_is_told_apart(response, complaint):
    port = answering(response)
    with pytest.raises(DeviceError, match=complaint):
        SerialBoard(lambda: port, "serial:x", clock=port.clock)


@pytest.mark.parametrize(
    "changes", [{"table_crc32": 1}, {"n_measurements": 27}, {"n_electrodes": 4}]
)
def test_a_table_that_contradicts_info_is_an_error(changes):
    with pytest.raises(DeviceError, match=r"contradicts itself|table cannot be"):
        connected(firmware(**changes))


def test_a_frame_of_another_length_is_dropped(running):
    board, port, frames = running
    short = FrameData(1, 0.0, 0.0, np.ones(3, np.complex64), np.zeros(3, np.uint8))
    port.waiting += encode(pack(short, 0))
    assert next(frames).number == 1
    assert board.counts.dropped == {"malformed message": 1}


def test_the_answer_to_an_earlier_request_is_no_answer_to_this_one():
    board, port = connected(firmware())
    port.deaf = 99
    port.waiting += encode(pack(Ack(1, MessageType.CALIBRATE, 4), 0))
    with pytest.raises(DeviceError, match="CALIBRATE"):
        board.calibrate()


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


def test_closing_while_another_thread_reads_ends_its_reading():
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


# ---- connection ----


class Flaky:
    """Board whose connections fail some times and whose streams end in an error."""

    def __init__(self, streams, failures=0):
        self.streams, self.failures, self.tries = iter(streams), failures, 0

    def frames(self, newest=False):  # noqa: ARG002
        for each in next(self.streams):
            if isinstance(each, Exception):
                raise each
            yield each

    def reconnect(self):
        self.tries += 1
        if self.tries <= self.failures:
            raise DeviceError("not there yet")


GONE = DeviceError("went away")


def test_frames_go_on_after_the_board_has_been_away():
    waits, reasons = [], []

    def wait(seconds):
        waits.append(seconds)
        reasons.append(connection.problem)

    board = Flaky([[1, 2, GONE], [GONE], [3, GONE], [4]], failures=7)
    connection = Connection(board, wait=wait)
    assert list(connection.frames()) == [1, 2, 3, 4]
    assert board.tries == 10
    assert reasons[:2] == ["went away", "not there yet"]
    assert connection.problem == ""
    # Doubled up to the longest, also where it goes away at once; anew after a frame.
    assert waits[:3] == pytest.approx([FIRST_PAUSE, 0.2, 0.4])
    assert waits[7:] == [MAX_PAUSE, MAX_PAUSE, FIRST_PAUSE]


def skip_five(board):
    for _ in range(5):
        board.skip()


def count_anew(board):
    board.number = 0


@pytest.mark.parametrize(
    ("meanwhile", "expected", "lost"),
    [
        (skip_five, [(1, 8), (1, 9)], 5),  # frames that the board numbered are lost
        (lambda board: board.boot(), [(2, 0), (2, 1)], 0),  # a new session
        (count_anew, [(1, 0), (1, 1)], 0),  # a board that does not say so is believed
    ],
)
def test_frames_after_a_board_was_away(meanwhile, expected, lost):
    board, port = connected(firmware())
    take(board, 3)
    meanwhile(port.firmware)
    board.reconnect()
    assert [(frame.session, frame.number) for frame in take(board, 2)] == expected
    assert (board.lost, board.counts.reconnections, board.counts.dropped) == (lost, 1, {})


def test_half_a_packet_from_before_does_not_spoil_what_comes_after(running):
    board, port, frames = running
    port.waiting += port.firmware.frame() + port.firmware.frame()[:100]
    next(frames)
    board.reconnect()
    take(board, 2)
    assert board.counts.dropped == {}


@pytest.mark.parametrize("changes", [{"uid": b"another one!"}, {"table_crc32": 7}])
def test_another_board_is_refused(changes):
    board, port = connected(firmware())
    known = board.info
    port.firmware.info = dataclasses.replace(port.firmware.info, **changes)
    with pytest.raises(UnrecoverableError, match=r"expected board .*found board"):
        board.reconnect()
    assert board.info == known


def test_a_closed_board_does_not_come_back():
    board, _ = connected(firmware())
    board.close()
    with pytest.raises(UnrecoverableError, match="is closed"):
        list(Connection(board, wait=lambda _: None).frames())


# ---- cables ----


def test_a_link_leads_to_the_board_before_and_after(tmp_path):
    link = tmp_path / "ttyEIT"
    with virtual_terminal(speed="max", simulator=FakeSimulator(), link=link) as terminal:
        with open_board(f"serial:{link}") as board:
            frames = Connection(board, wait=lambda _: None).frames()
            next(frames)
            terminal.firmware.stage.inject("replug")
            while next(frames).session == 1:
                pass
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


@pytest.mark.slow
def test_unplugging_and_replugging_leaves_nothing_behind():
    def state():
        return len(list(Path("/dev/fd").iterdir())), threading.active_count()

    with virtual() as board:
        connection = Connection(board, wait=lambda _: None)
        frames = connection.frames()
        next(frames)
        before = state()
        for _ in range(3):
            session = next(frames).session
            board.stage.inject("replug")
            while next(frames).session == session:
                pass
        assert state() == before
    assert board.counts.reconnections == 3


def test_a_board_that_starts_anew_again_and_again_is_a_stale_stream(running):
    _board, port, frames = running
    port.firmware.frame = port.firmware.boot

    def start(data, receive=port.firmware.receive):
        answer = receive(data)
        port.firmware.streaming = True
        return answer

    port.firmware.receive = start
    with pytest.raises(DeviceError, match="stale"):
        next(frames)


def test_closing_while_it_connects_leaves_no_port_open():
    ports = []

    def connect():
        port = Loopback(firmware())
        ports.append(port)
        if len(ports) == 2:
            held.close()
        return port

    held = ReopenablePort(connect, "serial:x")
    with pytest.raises(UnrecoverableError, match="is closed"):
        held.reopen()
    assert [port.closed for port in ports] == [True, True]


# ---- the stage ----


def test_the_board_never_waits_for_whoever_sets_a_scene():
    begun, go_on = threading.Event(), threading.Event()

    class Slow(FakeSimulator):
        def impedance_matrix(self, scene):
            if scene.bend.angle_deg:
                begun.set()
                assert go_on.wait(300.0)
            return super().impedance_matrix(scene)

    with open_board("virtual:?speed=max", simulator=Slow()) as board:
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


def test_an_impossible_scene_is_refused_where_it_is_set_and_the_board_goes_on():
    class Brittle(FakeSimulator):
        def impedance_matrix(self, scene):
            if scene.bend.angle_deg > 60:
                raise ConfigurationError("bend")
            return super().impedance_matrix(scene)

    with open_board("virtual:?speed=max", simulator=Brittle()) as board:
        with pytest.raises(ConfigurationError, match="bend"):
            board.stage.set(Scene(bend=Bend(90.0)))
        take(board, 2)
        assert board.stage.scene == Scene()


def test_faults_that_are_injected_strike_at_once_and_are_named():
    board, port = connected(firmware())
    frames = board.frames()
    numbers = [next(frames).number for _ in range(8)]
    board.stage = port.firmware.stage
    board.stage.inject("lost_frame, nan_channel:3")
    with pytest.raises(ConfigurationError, match="lost_frame"):
        board.stage.inject("lost_fram")
    numbers += [next(frames).number for _ in range(2)]
    assert numbers == [*range(8), 9, 10]
    assert board.stage.faults == ("nan_channel:3",)  # the other one is over
    assert next(frames).status.any()
    board.stage.clear()
    assert not next(frames).status.any()


def test_only_the_newest_scenes_are_remembered():
    board = firmware()
    for _ in range(5000):
        board.stage.impedance_at_frame(0)
        board.stage.record_truth(board.stage.frames)
        board.stage.frames += 1
    assert board.stage.truth(4999 - 4096) is None
    assert board.stage.truth(5000 - 4096) is not None
