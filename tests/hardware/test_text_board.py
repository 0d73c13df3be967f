"""Boards that print lines, on a port."""

import cmath
import itertools
import math
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.errors import DeviceError
from eitskin.hardware import open_board
from eitskin.hardware.boards.port import open_port
from eitskin.hardware.boards.text_board import TextBoard
from eitskin.hardware.boards.text_lines import (
    FrameDrop,
    FrameFinder,
    LineDecoder,
    LineDrop,
    Mark,
    Measurement,
)
from eitskin.simulator import Protocol, Status

PROTOCOL = Protocol.pairwise(4)  # six lines a frame
LINE, PAUSE = 0.0106, 0.06  # s
PERIOD = 6 * LINE + PAUSE


def printed(values, first="Freq:40000.00 "):
    """As the example program AD5940_Impedance prints them."""
    polar = [(abs(z), math.degrees(cmath.phase(z))) for z in values]
    lines = [f"RzMag: {size:f} Ohm , RzPhase: {phase:f} \n" for size, phase in polar]
    return [first + lines[0], *lines[1:]]


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


def test_with_marks_the_newest_overtakes_the_others():
    port = Printer(stream(range(30), mark="go"))
    frames = (board := board_on(port, mark="go")).frames(newest=True)
    next(frames)
    port.now += 4.0 * PERIOD
    assert abs(next(frames).impedance[0]) == pytest.approx(5000.0)
    assert (board.counts.skipped, board.lost) == (3, 0)


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


@pytest.mark.parametrize(
    ("text", "impedance", "frequency"),
    [
        ("Freq:40000.00 RzMag: 612.500000 Ohm , RzPhase: 0.000000 ", 612.5, 40e3),
        ("RzMag: 2.0 Ohm , RzPhase: 90.0", 2j, math.nan),
        ("Freq: 1000.00, RzMag: 2 Ohm, RzPhase: -90", -2j, 1e3),
        ("RzMag:     8.25 Ohm, RzPhase:    0.00 deg", 8.25, math.nan),
        ("Freq:50000.00 Impedance:(Real,Image) = (3.5,-4.25)", 3.5 - 4.25j, 50e3),
        ("rzmag: 1e3 ohm , rzphase: 180", -1e3, math.nan),
    ],
)
def test_what_the_example_programs_print_is_read(text, impedance, frequency):
    (line,) = LineDecoder().feed(text.encode() + b"\r\n")
    assert line.impedance == pytest.approx(impedance, abs=1e-9)
    assert line.frequency == pytest.approx(frequency, nan_ok=True)


@given(st.floats(0.01, 1e6), st.floats(-179.0, 179.0), st.integers(-3, 3))
def test_a_phase_may_be_off_by_turns(size, degrees, turns):
    (line,) = LineDecoder().feed(f"RzMag: {size} Ohm , RzPhase: {degrees + 360 * turns}\n".encode())
    assert line.impedance == pytest.approx(cmath.rect(size, math.radians(degrees)), rel=1e-9)


@pytest.mark.parametrize("number", ["nan", "-nan", "inf", "-inf", "nan(0x7)", "1e400", "-5.0"])
def test_a_value_that_is_no_number_keeps_its_place(number):
    (line,) = LineDecoder().feed(f"RzMag: {number} Ohm , RzPhase: 1.0\n".encode())
    assert cmath.isnan(line.impedance)


def test_a_frequency_holds_for_the_lines_that_follow():
    text = "RzMag: 1 Ohm , RzPhase: 0\nFreq: 12.00 Hz\n" + "".join(printed([1, 2], first=""))
    first, *rest = LineDecoder().feed(text.encode())
    assert math.isnan(first.frequency)
    assert [line.frequency for line in rest] == [12.0, 12.0]


def test_what_is_no_measurement_is_dropped_and_counted():
    decoder = LineDecoder()
    junk = ["hello", "RzMag: 12 Ohm ,", "zMag: 1 Ohm , RzPhase: 2", "RzMag: 1 2 Ohm , RzPhase: 3"]
    two = "RzMag: 1 Ohm , RzPhase: 2RzMag: 1 Ohm , RzPhase: 2"
    assert decoder.feed("\n".join([*junk, two, "", "  ", ""]).encode()) == []
    assert decoder.drops == {LineDrop.UNKNOWN: 5}


def test_a_line_without_end_does_not_fill_the_memory():
    decoder = LineDecoder()
    assert decoder.feed(b"x" * 10_000) == []
    assert len(decoder._begun) < 300
    assert len(decoder.feed(b"\n" + printed([1])[0].encode())) == 1
    assert decoder.drops == {LineDrop.TOO_LONG: 1}


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=600), st.lists(st.integers(0, 600), max_size=8))
def test_bytes_of_any_kind_never_raise_and_may_be_cut_anywhere(noise, cuts):
    stream = noise + b"\n" + "".join(printed([3, 4])).encode() + noise
    whole, cut = LineDecoder("go"), LineDecoder("go")
    together = whole.feed(stream)
    edges = [0, *sorted(cuts), len(stream)]
    apart = [line for a, b in itertools.pairwise(edges) for line in cut.feed(stream[a:b])]
    assert repr(apart) == repr(together)
    assert cut.drops == whole.drops
    assert all(isinstance(line, Measurement | Mark) for line in apart)


# ---- frames ----


def fed(finder, counts, pause=PAUSE):
    """Frames found in groups of so many lines; the values say which group they came from."""
    now, found = 0.0, []
    for group, count in enumerate(counts):
        for k in range(count):
            now += LINE
            found += finder.feed(now, [Measurement(complex(group, k))])
        now += pause
    return [*found, *finder.feed(now + 1.0, [])]


def groups(found):
    return [{int(each.impedance.real) for each in lines.measurements} for lines in found]


def test_frames_are_what_lies_between_pauses():
    finder = FrameFinder(6, marked=False)
    found = fed(finder, [4, 6, 6, 6])
    # With the first frame the distance of lines becomes known, and with its pause where it ends.
    assert groups(found) == [{2}, {3}]
    assert [lines.number for lines in found] == [0, 1]
    assert (finder.lost, finder.drops) == (0, {FrameDrop.FIRST: 10})
    assert finder.period == pytest.approx(PERIOD)


@pytest.mark.parametrize(("count", "lost"), [(1, 1), (5, 1), (7, 1), (12, 2)])
def test_lines_lost_or_added_cost_their_frame_and_shift_none(count, lost):
    finder = FrameFinder(6, marked=False)
    found = fed(finder, [6, 6, 6, count, 6, 6])
    assert groups(found) == [{2}, {4}, {5}]
    assert [lines.number for lines in found] == [0, 1 + lost, 2 + lost]
    assert (finder.lost, finder.drops[FrameDrop.INCOMPLETE]) == (lost, count)


@pytest.mark.parametrize("size", [1, 3, 28])
def test_frames_of_any_size_are_found(size):
    finder = FrameFinder(size, marked=False)
    assert groups(fed(finder, [size] * 9))[-5:] == [{4}, {5}, {6}, {7}, {8}]
    assert finder.lost == 0


def test_lines_that_usb_delays_and_bundles_are_no_pause():
    finder = FrameFinder(6, marked=False)
    found = []
    for frame in range(5):
        for k in range(6):
            ready = frame * PERIOD + k * LINE
            late = math.ceil(ready / 0.016) * 0.016  # every 16 ms what is ready by then
            found += finder.feed(late, [Measurement(complex(frame, k))])
    found += finder.feed(9.0, [])
    assert groups(found)[-3:] == [{2}, {3}, {4}]


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.sets(st.tuples(st.integers(0, 19), st.integers(0, 5))), st.booleans())
def test_whatever_lines_are_lost_no_value_stands_for_another(lost, marked):
    finder = FrameFinder(6, marked)
    found = []
    for frame in range(20):
        if marked:
            found += finder.feed(frame * PERIOD, [Mark()])
        for k in range(6):
            if (frame, k) not in lost:
                found += finder.feed(frame * PERIOD + k * LINE, [Measurement(complex(frame, k))])
    for lines in found:
        (frame,) = {each.impedance.real for each in lines.measurements}
        assert [each.impedance.imag for each in lines.measurements] == [0, 1, 2, 3, 4, 5]
        assert not {place for place in lost if place[0] == frame}


def test_a_pause_that_is_given_is_known_at_once():
    finder = FrameFinder(6, marked=False, pause=0.03)
    assert groups(fed(finder, [6, 6])) == [{1}]


def test_marks_need_no_pause():
    finder = FrameFinder(6, marked=True)
    lines = [Measurement(1 + 0j)] * 6
    given = [*lines[:3], Mark(), *lines, Mark(), *lines[:5], Mark(), *lines, Mark(), Mark(), *lines]
    found = finder.feed(0.0, given)
    assert [each.number for each in found] == [0, 2]
    assert finder.lost == 2
    assert finder.drops == {FrameDrop.FIRST: 3, FrameDrop.INCOMPLETE: 5}


# ---- all numbers of a frame in one line, and other forms of a measurement ----


def frames(lines, protocol):
    """Frames of a board that prints lines, one at a time, after the end of one that was cut."""
    texts = [b"5\r\n", *(line.encode() + b"\r\n" for line in lines)]
    port = Printer((0.1 * k, text) for k, text in enumerate(texts, 1))
    board = TextBoard(lambda: port, "text:x", protocol, clock=port.clock)
    return list(itertools.islice(board.frames(), len(lines)))


@pytest.mark.parametrize(
    "form",
    [
        "magnitudes : {} , {} , {} , ",
        "{}, {}, {}",
        "{};{};{};",
        "{} {}\t{}",
        "[{}, {}, {}],",
        '{{"n": 7, "eit": [{}, {}, {}]}}',
        "EIT={},{},{}",
    ],
)
def test_a_line_is_a_frame(form):
    found = frames([form.format(612.5, -3, "1e3"), form.format(1, "nan", 3)], Protocol.pairwise(3))
    assert np.array_equal(found[0].impedance, [612.5, -3, 1000])
    assert found[1].status.tolist() == [0, Status.NOT_FINITE, 0]
    assert [frame.number for frame in found] == [0, 1]


def test_the_end_of_a_line_is_no_frame():
    decoder = LineDecoder(size=3)
    decoder.restart()
    assert decoder.feed(b"2.5,3,4\n") == []
    assert len(decoder.feed(b"612.5,3,4\n")) == 1


def test_lines_of_another_number_are_quoted():
    with pytest.raises(DeviceError, match=r"2 numbers .* 3 measurements: 'a: 1.5, 2'.*protocol="):
        frames(["a: 1.5, 2"], Protocol.pairwise(3))


@pytest.mark.parametrize(
    "text",
    [
        "Point 1 - Magnitude: 2000.0, Phase: 90",
        "Impedance: 2000 ohms, Phase: 90.0 degrees",
        "Freq:40000,00 RzMag: 2000,000 Ohm , RzPhase: 90,0",
        "RzMag: 2.0 kOhm , RzPhase: 90",
    ],
)
def test_a_measurement_is_printed_in_other_words_and_units(text):
    (line,) = LineDecoder().feed(text.encode() + b"\n")
    assert line.impedance == pytest.approx(2000j, abs=1e-9)
