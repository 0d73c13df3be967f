"""The line in memory: frames depend on the requests alone, and its faults are those of a cable."""

import itertools

import numpy as np
import pytest

from eitskin.errors import DeviceError
from eitskin.geometry import Bend
from eitskin.hardware import Connection, Script, SerialBoard, Step
from eitskin.hardware.protocol.frame_parts import FrameData
from eitskin.hardware.protocol.messages import Start, pack, unpack
from eitskin.hardware.protocol.packets import Decoder, encode
from eitskin.hardware.virtual.fault_table import read_faults
from eitskin.hardware.virtual.memory_line import MemoryLine
from eitskin.hardware.virtual.virtual_board import VirtualBoard
from eitskin.simulator import Protocol, Scene

from loopback import FLAT, firmware, take, virtual


class Clock:
    """Time that only waiting moves [s]."""

    now = 0.0

    def __call__(self):
        return self.now

    def wait(self, seconds):
        self.now += max(seconds, 1e-6)


def line(faults="", clock=None, period=0.0, **options):
    clock = clock or Clock()
    return MemoryLine(firmware(read_faults(faults), **options), period, clock, clock.wait)


def test_the_board_is_never_ahead_of_its_host():
    with virtual(snr_db=np.inf) as board:
        assert [frame.number for frame in take(board, 3)] == [0, 1, 2]
        board.stage.set(Scene(Bend(20.0)))
        (bent,) = take(board, 1)
        assert bent.number == 3
        assert bent.impedance == pytest.approx(1.02 * FLAT, rel=1e-6)
        stream = board.frames()
        next(stream)
        board.stage.set(Scene(Bend(40.0)))
        assert next(stream).impedance == pytest.approx(1.04 * FLAT, rel=1e-6)
        board.stage.play(Script((Step(Scene(), 1), Step(Scene(Bend(10.0)), 1))))
        ratios = [next(stream).impedance[0].real / FLAT[0] for _ in range(4)]
        assert ratios == pytest.approx([1.0, 1.01, 1.0, 1.01])
        assert (board.lost, board.counts.skipped, board.counts.dropped) == (0, 0, {})


def test_the_newest_frame_is_the_next_where_none_waits():
    with virtual() as board:
        stream = board.frames(newest=True)
        assert [next(stream).number for _ in range(5)] == list(range(5))
        assert board.counts.skipped == 0


def test_frames_of_several_packets_are_measured_one_by_one():
    large = Protocol.adjacent(32)
    with VirtualBoard(line(sensor=lambda n: np.full(928, 1.0 + n), protocol=large)) as board:
        for number in range(4):
            (frame,) = take(board, 1)
            assert frame.number == number
            assert np.all(frame.impedance == 1.0 + number)


def test_a_pulled_cable_ends_the_port_and_comes_back_as_another_session():
    clock = Clock()
    cable = line("replug@4:2", clock)
    with VirtualBoard(cable) as board:
        waits = []

        def wait(seconds):
            waits.append(cable.cable)
            clock.wait(seconds)

        frames = list(itertools.islice(Connection(board, wait=wait).frames(), 8))
        assert [frame.session for frame in frames] == [1] * 4 + [2] * 4
        assert waits[0] == 1  # it was out for a while
        assert (cable.cable, board.counts.reconnections) == (2, 1)


def test_an_unplugged_board_stays_away_until_its_faults_are_cleared():
    board = VirtualBoard(line("unplug@2"))
    stream = board.frames()
    take_two = [next(stream).number for _ in range(2)]
    assert take_two == [0, 1]
    with pytest.raises(DeviceError, match="went away"):
        next(stream)
    for _ in range(2):
        with pytest.raises(DeviceError, match="clear its faults"):
            board.reconnect()
    board.stage.clear()
    board.reconnect()
    assert next(board.frames()).session == 2
    board.close()
    board.close()


def test_delays_pass_by_the_clock_and_an_idle_line_makes_its_reader_wait():
    clock = Clock()
    delayed = line("stall@1:7", clock)
    delayed.start()
    port = delayed.connect("virtual:")
    port.reset_input_buffer()
    assert (port.read(9), clock.now) == (b"", 0.05)
    with SerialBoard(lambda: delayed.connect("virtual:"), "virtual:", clock) as board:
        stream = board.frames()
        next(stream)
        next(stream)
        before = clock.now
        with pytest.raises(DeviceError, match="stale"):
            next(stream)
        assert clock.now - before == pytest.approx(3 * 0.2968, abs=0.051)


def test_a_frame_that_takes_long_to_simulate_is_no_stale_stream():
    clock = Clock()
    slow = line(clock=clock)
    measured = slow.firmware.frame

    def frame():
        clock.wait(60.0)
        return measured()

    slow.firmware.frame = frame
    with VirtualBoard(slow, clock=slow.now) as board:
        assert [each.number for each in take(board, 3)] == [0, 1, 2]
    assert slow.now() < clock.now


def numbers_of(port):
    """Numbers of the frames that wait in a port."""
    packets = Decoder().feed(port.read(port.in_waiting or 1))
    return [message.number for message in map(unpack, packets) if isinstance(message, FrameData)]


def started(paced):
    paced.start()
    port = paced.connect("virtual:")
    port.write(encode(pack(Start(), 1)))
    port.reset_input_buffer()
    return port


def test_a_paced_board_gives_a_frame_when_it_is_due_and_not_before():
    clock = Clock()
    port = started(line(clock=clock, period=0.3))
    clock.now = 0.29
    assert port.in_waiting == 0
    assert (port.read(9), clock.now) == (b"", pytest.approx(0.3))  # it waits for the frame alone
    assert numbers_of(port) == [0]
    clock.now = 1.25
    assert numbers_of(port) == [1, 2, 3]


def test_a_paced_board_skips_frames_that_its_host_has_no_room_for():
    clock = Clock()
    port = started(line(clock=clock, period=0.3))
    clock.now = 300.05
    late = numbers_of(port)
    assert late == list(range(len(late)))
    assert 10 < len(late) < 100
    clock.now = 300.35
    assert numbers_of(port) == [1000]


def test_a_frame_that_takes_long_to_simulate_moves_the_clock_of_a_paced_board():
    clock = Clock()
    slow = line(clock=clock, period=0.3)
    measured = slow.firmware.frame

    def frame():
        clock.wait(2.0)
        return measured()

    slow.firmware.frame = frame
    with VirtualBoard(slow, clock=slow.now) as board:
        times = [each.time for each in take(board, 3)]
    period = slow.firmware.info.period
    assert np.diff(times) == pytest.approx([period + 1.7] * 2)
