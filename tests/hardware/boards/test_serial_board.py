"""Serial board: faults on the wire, on connecting, and of cables."""

import dataclasses
import threading

import numpy as np
import pytest
import serial

from eitskin.errors import DeviceError
from eitskin.hardware import SerialBoard
from eitskin.hardware.boards.board import longest_silence
from eitskin.hardware.protocol.frame_parts import FrameData
from eitskin.hardware.protocol.messages import Ack, Event, pack
from eitskin.hardware.protocol.packets import MessageType, Packet, encode

from loopback import Loopback, connected, firmware, take, virtual

# ---- what goes wrong on the wire ----


def test_silence_for_three_periods_is_a_stale_stream():
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)
    port.firmware.streaming = False
    began = port.now
    with pytest.raises(DeviceError, match=r"stale.*0\.890 s"):
        next(frames)
    assert 3 * 0.2968 <= port.now - began < 3 * 0.2968 + 0.1


def test_a_flood_of_events_hides_no_frame_and_fills_no_memory():
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)
    port.waiting += encode(pack(Event(2, 1, "again"), 0)) * 20_000
    assert [next(frames).number for _ in range(3)] == [1, 2, 3]
    assert len(board.events) == 20


def test_a_firmware_that_tells_of_an_hour_between_frames_is_not_waited_for():
    assert longest_silence(4294.967295) == 600.0
    assert longest_silence(174.0) > 2 * 174.0  # 16,384 channels
    assert longest_silence(0.3) == pytest.approx(0.9)
    assert longest_silence(float("nan")) == longest_silence(-0.0) == float("inf")


def test_a_restart_with_another_table_is_an_error():
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)
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


def test_a_streaming_board_that_never_answers_is_an_error_too():
    port = Loopback(firmware())
    port.firmware.receive(encode(Packet(MessageType.START, 1, bytes(4))))
    port.deaf = 99
    with pytest.raises(DeviceError, match="none came"):
        SerialBoard(lambda: port, "serial:x", clock=port.clock)


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


def test_a_frame_of_another_length_is_dropped():
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)
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
def test_each_way_a_port_dies_is_the_same_error(error, method, monkeypatch):
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)

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
    assert first.wait(10.0)
    board.close()
    thread.join(10.0)
    assert not thread.is_alive()
    assert len(failures) == 1
