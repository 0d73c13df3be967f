"""Boards that print lines, on a port."""

import itertools
import math
import os

import numpy as np
import pytest

from eitskin.errors import DeviceError
from eitskin.hardware import open_board
from eitskin.hardware.boards.port import open_port
from eitskin.hardware.boards.text_board import TextBoard
from eitskin.simulator import Status

from printed_lines import LINE, PERIOD, PROTOCOL, printed


def frame_values(number, size=6):
    return (1000.0 * (number + 1) + 10.0 * np.arange(size)) * np.exp(-0.02j)


class Printer:
    """A port at whose other end lines are printed at known times; only reading moves its clock."""

    def __init__(self, events, room=10**9):
        self.events, self.now, self.closed = list(events), 0.0, False
        self.room = room
        self.waiting = bytearray()

    def clock(self):
        return self.now

    def arrive(self):
        while self.events and self.events[0][0] <= self.now:
            self.waiting += self.events.pop(0)[1][: self.room - len(self.waiting)]

    @property
    def in_waiting(self):
        self.arrive()
        return len(self.waiting)

    def read(self, size=1):
        self.arrive()
        if not self.waiting:
            nearest = self.events[0][0] if self.events else math.inf
            self.now = min(nearest, self.now + 0.05)
            self.arrive()
        data = bytes(self.waiting[:size])
        del self.waiting[:size]
        return data

    def reset_input_buffer(self):
        self.arrive()
        self.waiting.clear()

    def close(self):
        self.closed = True


def stream(numbers, start=0.5, mark="", skip=()):
    """Lines of frames at their times; those (frame, line) in `skip` are missing."""
    for number in numbers:
        begin = start + (number - numbers[0]) * PERIOD
        if mark:
            yield begin, f"{mark}\r\n".encode()
        for k, text in enumerate(printed(frame_values(number))):
            if (number, k) not in skip:
                yield begin + (k + 1) * LINE, text.encode()


def board_on(port, **options):
    return TextBoard(lambda: port, "text:fake", PROTOCOL, clock=port.clock, **options)


def test_frames_hold_the_values_that_were_printed():
    port = Printer(stream(range(8)))
    board = board_on(port)
    frames = list(itertools.islice(board.frames(), 5))
    for number, frame in enumerate(frames, start=2):
        assert frame.impedance == pytest.approx(frame_values(number), rel=1e-6)
        assert not frame.status.any()
        assert frame.frequency == 40e3
    assert [frame.number for frame in frames] == [0, 1, 2, 3, 4]
    assert np.diff([frame.time for frame in frames]) == pytest.approx(PERIOD, abs=1e-6)
    assert (board.counts.frames, board.lost, frames[0].time) == (5, 0, 0.0)
    assert board.info.period == pytest.approx(PERIOD)
    assert (board.info.frequency, board.info.n_measurements) == (40e3, 6)
    assert math.isnan(board.info.rtia)


def test_a_lost_line_costs_its_frame():
    board = board_on(Printer(stream(range(8), skip={(4, 2)})))
    frames = list(itertools.islice(board.frames(), 4))
    assert [round(abs(frame.impedance[0])) for frame in frames] == [3000, 4000, 6000, 7000]
    assert [frame.number for frame in frames] == [0, 1, 3, 4]
    assert board.lost == 1
    assert board.counts.dropped == {
        "measurement before the first whole frame": 12,
        "measurement of an incomplete frame": 5,
    }


@pytest.mark.parametrize("printed_as", ["inf", "1e39"])  # the second is beyond single precision
def test_an_infinite_value_is_marked_and_the_frame_kept(printed_as):
    events = list(stream(range(5)))
    when, _ = events[3 * 6 + 4]
    events[3 * 6 + 4] = when, f"RzMag: {printed_as} Ohm , RzPhase: 0\n".encode()
    _, frame = itertools.islice(board_on(Printer(events)).frames(), 2)
    assert frame.status.tolist() == [0, 0, 0, 0, Status.NOT_FINITE, 0]
    assert not np.isfinite(frame.impedance[4])
    assert np.array_equal(frame.impedance[:4], frame.impedance[:4].astype(np.complex64))


def test_a_slow_reader_gets_whole_frames_and_the_newest():
    port = Printer(stream(range(40)))
    board = board_on(port)
    frames = board.frames(newest=True)
    next(frames)
    for _ in range(5):
        port.now += 2.7 * PERIOD
        frame = next(frames)
        number = round(abs(frame.impedance[0]) / 1000.0) - 1
        assert frame.impedance == pytest.approx(frame_values(number), rel=1e-6)
        assert port.now - (0.5 + number * PERIOD) < 1.6 * PERIOD


@pytest.mark.parametrize("mark", ["", "go"])
def test_a_port_that_overflows_mixes_no_frames(monkeypatch, mark):
    monkeypatch.setattr("eitskin.hardware.boards.text_board.CHUNK", 400)
    for away in np.linspace(0.5, 12.0, 20) * PERIOD:
        port = Printer(stream(range(40), mark=mark), room=399)
        frames = board_on(port, mark=mark).frames()
        next(frames)
        port.now += away
        for frame in itertools.islice(frames, 4):
            number = round(abs(frame.impedance[0]) / 1000.0) - 1
            assert frame.impedance == pytest.approx(frame_values(number), rel=1e-6), away


def test_with_marks_the_newest_overtakes_the_others():
    port = Printer(stream(range(30), mark="go"))
    frames = (board := board_on(port, mark="go")).frames(newest=True)
    next(frames)
    port.now += 4.0 * PERIOD
    assert abs(next(frames).impedance[0]) == pytest.approx(5000.0)
    assert (board.counts.skipped, board.lost) == (3, 0)


@pytest.mark.parametrize(
    ("events", "said"),
    [
        ((), r"stale.*10\.0 s.*baud"),
        (stream(range(99), skip={(n, 5) for n in range(99)}), "5, 5, 5 lines .*6"),
        (((0.01 * k, printed([1])[0].encode()) for k in range(1200)), "mark=.*pause="),
        (((0.1 * k, b"\xf0\x81\n") for k in range(200)), "wrong baud rate"),
    ],
    ids=["silent", "too few lines", "no pause", "wrong baud rate"],
)
def test_a_board_without_whole_frames_says_what_is_wrong(events, said):
    with pytest.raises(DeviceError, match=said):
        next(board_on(Printer(events)).frames())


def test_a_board_that_comes_back_is_a_new_session():
    ports = [Printer(stream(range(4))), Printer(stream(range(10, 14)))]
    used = []

    def connect():
        used.append(ports[len(used)])
        return used[-1]

    board = TextBoard(connect, "text:fake", PROTOCOL, clock=lambda: used[-1].now)
    first = next(board.frames())
    board.reconnect()
    second = next(board.frames())
    assert ports[0].closed
    assert round(abs(second.impedance[0])) == 13000
    assert (first.session, second.session) == (0, 1)
    assert (second.time, board.counts.reconnections) == (0.0, 1)


def test_a_port_that_goes_away_is_one_error_and_closing_lets_go():
    port = Printer([])
    port.read = lambda _: (_ for _ in ()).throw(OSError("unplugged"))
    with board_on(port) as board, pytest.raises(DeviceError, match=r"went away \(unplugged"):
        next(board.frames())
    assert port.closed
    board.close()
    with pytest.raises(DeviceError, match="closed"):
        next(board.frames())
    with pytest.raises(DeviceError, match="closed"):
        board.reconnect()


def test_a_uri_opens_it(monkeypatch):
    opened = []
    port = Printer(stream(range(3), mark="go"))
    monkeypatch.setattr(
        "eitskin.hardware.boards.text_board.connector",
        lambda *given: opened.append(given) or (lambda: port),
    )
    uri = "text:/dev/ttyACM0?protocol=pairwise:4&mark=go&frequency=1e4&baud=115200"
    with open_board(uri) as board:
        assert (board.uri, len(board.protocol)) == (uri, 6)
    assert opened == [("/dev/ttyACM0", uri, 115200, "")]


def test_over_a_real_pseudo_terminal():
    ours, theirs = os.openpty()
    text = "".join("go\r\n" + "".join(printed(frame_values(n))) for n in range(3)) + "go\n"

    def connect():
        port = open_port(os.ttyname(theirs), "text:pty", 230400)
        flush = port.reset_input_buffer
        # It prints once somebody listens, so that nothing needs to wait.
        port.reset_input_buffer = lambda: (flush(), os.write(ours, text.encode()))
        return port

    try:
        with TextBoard(connect, "text:pty", PROTOCOL, mark="go") as board:
            frames = board.frames()
            for number in range(3):
                assert next(frames).impedance == pytest.approx(frame_values(number), rel=1e-6)
            os.close(ours)
            with pytest.raises(DeviceError, match="went away"):
                next(frames)
    finally:
        os.close(theirs)
