"""Boards that print lines: the decoder of lines, the finder of frames, and boards on a port."""

import cmath
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.errors import DeviceError
from eitskin.hardware import open_board
from eitskin.hardware.boards.text_board import TextBoard
from eitskin.hardware.boards.text_lines import (
    FrameDrop,
    FrameFinder,
    Line,
    LineDecoder,
    LineDrop,
    Mark,
    Measurement,
)
from eitskin.simulator import Protocol, Status

PROTOCOL = Protocol.pairwise(4)  # six lines a frame
LINE, PAUSE = 0.0106, 0.06  # s
PERIOD = 6 * LINE + PAUSE

# ---- lines ----


def decoded(text, **options):
    """The one line in a text."""
    (line,) = LineDecoder(**options).feed(text.encode() + b"\r\n")
    return line


@pytest.mark.parametrize(
    ("text", "impedance", "frequency"),
    [
        ("Freq:40000.00 RzMag: 612.500000 Ohm , RzPhase: 0.000000 ", 612.5, 40e3),
        ("RzMag: 2.0 Ohm , RzPhase: -630.0", 2j, math.nan),  # off by two turns
        ("Freq: 1000.00, RzMag: 2 Ohm, RzPhase: -90", -2j, 1e3),
        ("RzMag:     8.25 Ohm, RzPhase:    0.00 deg", 8.25, math.nan),
        ("Freq:50000.00 Impedance:(Real,Image) = (3.5,-4.25)", 3.5 - 4.25j, 50e3),
        ("rzmag: 1e3 ohm , rzphase: 180", -1e3, math.nan),
        ("Point 1 - Magnitude: 2000.0, Phase: 90", 2000j, math.nan),
        ("Impedance: 2000 ohms, Phase: 90.0 degrees", 2000j, math.nan),
        ("Freq:40000,00 RzMag: 2000,000 Ohm , RzPhase: 90,0", 2000j, 40e3),
        ("RzMag: 2.0 kOhm , RzPhase: 90", 2000j, math.nan),
        ("|Z| = 2000, theta = 1.5707963267949 rad", 2000j, math.nan),
        ("R: 0 X: 2000", 2000j, math.nan),
        ("Real=0.0/Imag=2000", 2000j, math.nan),
    ],
)
def test_what_programs_print_is_read(text, impedance, frequency):
    line = decoded(text)
    assert line.impedance == pytest.approx(impedance, abs=1e-9)
    assert line.frequency == pytest.approx(frequency, nan_ok=True)


@pytest.mark.parametrize("number", ["nan", "-inf", "nan(0x7)", "1e400", "-5.0"])
def test_a_value_that_is_no_number_keeps_its_place(number):
    assert cmath.isnan(decoded(f"RzMag: {number} Ohm , RzPhase: 1.0").impedance)


def test_a_frequency_holds_for_the_lines_that_follow_and_the_rest_is_counted():
    decoder, line = LineDecoder(), "RzMag: 1 Ohm , RzPhase: 0\n"
    first, *rest = decoder.feed(f"{line}Freq: 12.00 Hz\n{line}{line}".encode())
    assert math.isnan(first.frequency)
    assert [line.frequency for line in rest] == [12.0, 12.0]
    junk = ["hello", "RzMag: 12 Ohm ,", "zMag: 1 Ohm , RzPhase: 2", "RzMag: 1 2 Ohm , RzPhase: 3"]
    two = "RzMag: 1 Ohm , RzPhase: 2RzMag: 1 Ohm , RzPhase: 2"
    assert decoder.feed("\n".join([*junk, two, "", "  ", ""]).encode()) == []
    assert decoder.feed(b"x" * 10_000) == []
    assert len(decoder.feed(f"\n{line}".encode())) == 1
    assert decoder.drops == {LineDrop.UNKNOWN: 5, LineDrop.TOO_LONG: 1}


@settings(max_examples=100)
@given(st.binary(max_size=600), st.lists(st.integers(0, 600), max_size=8))
def test_bytes_of_any_kind_never_raise_and_may_be_cut_anywhere(noise, cuts):
    stream = noise + b"\nRzMag: 3 Ohm , RzPhase: 4\ngo\n" + noise
    whole, cut = LineDecoder("go", 4), LineDecoder("go", 4)
    together = whole.feed(stream)
    edges = [0, *sorted(cuts), len(stream)]
    apart = [line for a, b in itertools.pairwise(edges) for line in cut.feed(stream[a:b])]
    assert repr(apart) == repr(together)
    assert cut.drops == whole.drops
    assert all(isinstance(line, Line) for line in apart)


# ---- frames ----


def found(finder, counts, late=lambda now: now):
    """Groups found among groups of so many lines: the values say which they came from."""
    now, ended = 0.0, []
    for group, count in enumerate(counts):
        for k in range(count):
            now += LINE
            ended += finder.feed(late(now), [Measurement(complex(group, k))])
        now += PAUSE
    ended += finder.feed(now + 1.0, [])
    return [
        (each.number, {int(line.impedance.real) for line in each.measurements}) for each in ended
    ]


@pytest.mark.parametrize(
    ("size", "counts", "frames", "incomplete"),
    [
        # With the first frame the distance of lines is known, and with its pause where it ends.
        (6, [4, 6, 6, 6], [(0, {2}), (1, {3})], 0),
        (6, [6, 6, 6, 1, 6], [(0, {2}), (2, {4})], 1),
        (6, [6, 6, 6, 7, 6], [(0, {2}), (2, {4})], 7),
        (6, [6, 6, 6, 12, 6], [(0, {2}), (3, {4})], 12),
        (28, [28] * 4, [(0, {2}), (1, {3})], 0),
        (1, [1] * 4, [(0, {2}), (1, {3})], 0),
    ],
)
def test_frames_are_whole_groups_between_pauses(size, counts, frames, incomplete):
    finder = FrameFinder(size, marked=False)
    assert found(finder, counts) == frames
    assert finder.lost == frames[-1][0] + 1 - len(frames)
    assert finder.drops[FrameDrop.FIRST] == sum(counts[:2])
    assert finder.drops[FrameDrop.INCOMPLETE] == incomplete


def test_late_lines_are_no_pause_and_marks_need_none():
    finder = FrameFinder(6, marked=False)
    bundled = found(finder, [6] * 5, lambda now: math.ceil(now / 0.016) * 0.016)
    assert [group for _, group in bundled][-3:] == [{2}, {3}, {4}]
    assert finder.period == pytest.approx(PERIOD, abs=0.016)
    assert found(FrameFinder(6, marked=False, pause=0.03), [6, 6]) == [(0, {1})]
    finder = FrameFinder(6, marked=True)
    lines = [Measurement(1 + 0j)] * 6
    given = [*lines[:3], Mark(), *lines, Mark(), *lines[:5], Mark(), *lines, Mark(), Mark(), *lines]
    assert [each.number for each in finder.feed(0.0, given)] == [0, 2]
    assert finder.lost == 2
    assert finder.drops == {FrameDrop.FIRST: 3, FrameDrop.INCOMPLETE: 5}


@pytest.mark.slow
@settings(max_examples=60, derandomize=True)
@given(st.sets(st.tuples(st.integers(0, 19), st.integers(0, 5))), st.booleans())
def test_whatever_lines_are_lost_no_value_stands_for_another(lost, marked):
    finder, ended = FrameFinder(6, marked), []
    for frame in range(20):
        if marked:
            ended += finder.feed(frame * PERIOD, [Mark()])
        for k in range(6):
            if (frame, k) not in lost:
                ended += finder.feed(frame * PERIOD + k * LINE, [Measurement(complex(frame, k))])
    for lines in ended:
        (frame,) = {each.impedance.real for each in lines.measurements}
        assert [each.impedance.imag for each in lines.measurements] == [0, 1, 2, 3, 4, 5]
        assert not {place for place in lost if place[0] == frame}


# ---- boards ----


class Printer:
    """A port at whose other end lines are printed at known times; only reading moves its clock."""

    def __init__(self, events, room=10**9):
        self.events, self.now, self.closed = list(events), 0.0, False
        self.room = room
        self.waiting = bytearray()

    def clock(self):
        return self.now

    @property
    def in_waiting(self):
        while self.events and self.events[0][0] <= self.now:
            self.waiting += self.events.pop(0)[1][: self.room - len(self.waiting)]
        return len(self.waiting)

    def read(self, size=1):
        if not self.in_waiting:
            nearest = self.events[0][0] if self.events else math.inf
            self.now = min(nearest, self.now + 0.05)
        data = bytes(self.waiting[: min(size, self.in_waiting)])
        del self.waiting[: len(data)]
        return data

    def reset_input_buffer(self):
        del self.waiting[: self.in_waiting]

    def close(self):
        self.closed = True


def frame_values(number):
    return (1000.0 * (number + 1) + 10.0 * np.arange(6)) * np.exp(-0.02j)


def frame_number(frame):
    """Number of the frame that was printed, all of whose values must be there."""
    number = round(abs(frame.impedance[0]) / 1000.0) - 1
    assert frame.impedance == pytest.approx(frame_values(number), rel=1e-6)
    return number


def stream(numbers, mark="", skip=()):
    """Lines of frames at their times; those (frame, line) in `skip` are missing."""
    for number in numbers:
        begin = 0.5 + (number - numbers[0]) * PERIOD
        if mark:
            yield begin, f"{mark}\r\n".encode()
        for k, value in enumerate(frame_values(number)):
            size, phase = abs(value), math.degrees(cmath.phase(value))
            text = f"RzMag: {size:f} Ohm , RzPhase: {phase:f} \n"
            if (number, k) not in skip:
                yield (
                    begin + (k + 1) * LINE,
                    ("" if k else "Freq:40000.00 ").encode() + text.encode(),
                )


def board_on(port, **options):
    return TextBoard(lambda: port, "text:fake", PROTOCOL, clock=port.clock, **options)


def test_frames_hold_what_was_printed_and_a_lost_line_costs_its_frame():
    board = board_on(Printer(stream(range(9), skip={(5, 2)})))
    frames = list(itertools.islice(board.frames(), 5))
    assert [frame_number(frame) for frame in frames] == [2, 3, 4, 6, 7]
    assert [frame.number for frame in frames] == [0, 1, 2, 4, 5]
    assert not any(frame.status.any() for frame in frames)
    assert [frame.time / PERIOD for frame in frames] == pytest.approx([0, 1, 2, 4, 5], abs=1e-3)
    assert (board.counts.frames, board.lost) == (5, 1)
    assert board.counts.dropped == {
        "measurement before the first whole frame": 12,
        "measurement of an incomplete frame": 5,
    }
    assert board.info.period == pytest.approx(PERIOD)
    assert (board.info.frequency, board.info.n_measurements) == (40e3, 6)
    assert frames[0].frequency == 40e3


@pytest.mark.parametrize("mark", ["", "go"])
def test_a_slow_reader_gets_whole_frames_and_the_newest(mark):
    port = Printer(stream(range(40), mark))
    board = board_on(port, mark=mark)
    frames = board.frames(newest=True)
    first = frame_number(next(frames))
    for _ in range(5):
        port.now += 2.7 * PERIOD
        last = frame_number(next(frames))
        assert port.now - (0.5 + last * PERIOD) < (2.1 if mark else 1.6) * PERIOD
    if mark:
        assert board.counts.frames + board.counts.skipped == last - first + 1
        assert board.lost == 0


@pytest.mark.parametrize("mark", ["", "go"])
def test_a_port_that_overflows_mixes_no_frames(monkeypatch, mark):
    monkeypatch.setattr("eitskin.hardware.boards.text_board.CHUNK", 400)
    for away in np.linspace(0.5, 12.0, 20) * PERIOD:
        port = Printer(stream(range(40), mark), room=399)
        frames = board_on(port, mark=mark).frames()
        next(frames)
        port.now += away
        for frame in itertools.islice(frames, 4):
            frame_number(frame)


@pytest.mark.parametrize(
    ("events", "said"),
    [
        ((), r"stale.*10\.0 s.*baud"),
        (stream(range(99), skip={(n, 5) for n in range(99)}), "5, 5, 5 measurements .*6"),
        (((0.01 * k, b"RzMag: 1 Ohm , RzPhase: 0\n") for k in range(1200)), "mark=.*pause="),
        (((0.1 * k, b"\xf0\x81\n") for k in range(200)), "wrong baud rate"),
        (((0.1 * k, b"1,9,1,9,1,9,1,9,1,9,1,9\n") for k in range(200)), "12 numbers .*pairs="),
        (((0.1 * k, b"1A2B,0123,0,0,0,0\n") for k in range(200)), "let the board print decimal"),
        (
            ((0.1 * k, b"a: 1, 2, 3, 4\n") for k in range(200)),
            r"4 numbers .*6 .*'a: 1, 2, 3, 4'.*protocol=",
        ),
    ],
    ids=["silent", "too few lines", "no pause", "wrong baud rate", "pairs", "hex", "other numbers"],
)
def test_a_board_without_whole_frames_says_what_is_wrong(events, said):
    with pytest.raises(DeviceError, match=said):
        next(board_on(Printer(events)).frames())


@pytest.mark.parametrize(
    "form",
    [
        "magnitudes : {} , {} , {} , ",
        "{}, {}, {}",
        "{};{};{};",
        "{} {}\t{}",
        '{{"n": 7, "eit": [{}, {}, {}]}}',
        "EIT={},{},{}",
        "({}|{}|{})",
        "14:05:00.120 -> {}\t{}\t{}\t",
        "v0={} v1={} v2={}",
        "{} Ohm, {} Ohm, {} Ohm",
    ],
)
def test_a_line_may_be_a_frame_but_the_end_of_one_is_none(form):
    texts = ("5, 6, 7", form.format(612.5, -3, "1e3"), form.format("nan", "1e39", 3))
    port = Printer((0.1 * k, f"{text}\r\n".encode()) for k, text in enumerate(texts, 1))
    board = TextBoard(lambda: port, "text:x", Protocol.pairwise(3), clock=port.clock)
    frames = list(itertools.islice(board.frames(), 2))
    assert np.array_equal(frames[0].impedance, [612.5, -3, 1000])
    assert frames[1].status.tolist() == [Status.NOT_FINITE, Status.NOT_FINITE, 0]  # beyond float32
    assert [frame.number for frame in frames] == [0, 1]


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ('{"real": [1, 2.5], "imag": [3, -4]}', [1 + 3j, 2.5 - 4j]),
        ('{"phase": [90, "inf"], "mag": [2, 1]}', [2j, complex(math.nan, math.nan)]),
        ('{"n": 7, "z1": 1.5, "z2": 2}', [1.5, 2]),
        ("1.5+2j, 3-4i", [1.5 + 2j, 3 - 4j]),
        ("1,5 2,5", [1.5, 2.5]),
        ("1.5 kOhm;2 kOhm;", [1500, 2000]),
        ("1.5, 2, oops", []),
        ("$EIT,1.5,2*5A", [1.5, 2]),
        ("S,1.5,2,E", [1.5, 2]),
        ("<0:1.5 1:2>", [1.5, 2]),
        ("Z (kOhm): 1.5 | 2", [1500, 2000]),
        ("2026-11-23 14:05:00.1 -> {'z': ['1.5', [2, 3]]}", [1.5, 2 + 3j]),
        ('{"frame": {"values": [1.5, 2]}}', [1.5, 2]),
        ("nan, 2", [complex(math.nan, math.nan), 2]),
    ],
)
def test_a_line_has_other_numbers_of_a_frame(text, values):
    lines = LineDecoder(size=2).feed(text.encode() + b"\n")
    read = [each.impedance for line in lines for each in line.measurements]
    assert read == pytest.approx(values, abs=1e-9, nan_ok=True)


@pytest.mark.parametrize("form", ["{}", "{} {}", "Z = {} Ohm", "3: {}", "D1: {}, {}, {}"])
def test_a_line_is_a_part_of_a_frame(form):
    """Of one number, or of those of a drive pair."""
    values, count = iter(range(72)), form.count("{}")
    texts = [form.format(*itertools.islice(values, count)) for _ in range(72 // count)]
    when = [LINE * k + PAUSE * (k // (6 // count)) for k in range(len(texts))]
    port = Printer(zip(when, (text.encode() + b"\n" for text in texts), strict=True))
    board = TextBoard(lambda: port, "text:x", PROTOCOL, clock=port.clock)
    for frame in itertools.islice(board.frames(), 3):
        first = frame.impedance[0].real
        assert first % 6 == 0
        assert np.array_equal(frame.impedance, first + np.arange(6))


def test_two_numbers_are_a_measurement_where_that_is_said_and_a_rest_is_no_part():
    for pairs, second, value in (("deg", 90, 2j), ("rad", -math.pi / 2, -2j), ("imag", 9, 2 + 9j)):
        for text in (f"2,{second},1,0\n", f"2,{second}\n1,0\n", f"2 {second}; 1 0\n"):
            lines = LineDecoder(size=2, pairs=pairs).feed(text.encode())
            read = [each.impedance for line in lines for each in line.measurements]
            assert read == pytest.approx([value, 1], abs=1e-9)
    lines = LineDecoder(size=4).feed(b"1,2,3,4\n3,4\n4\nRzMag: 1 Ohm , RzPhase: 2\n1,2\n")
    assert [len(getattr(line, "measurements", "1")) for line in lines] == [4, 1]


def test_a_board_that_comes_back_is_a_new_session_until_it_is_closed():
    ports = [Printer(stream(range(4))), Printer(stream(range(10, 14)))]
    used = []

    def connect():
        used.append(ports[len(used)])
        return used[-1]

    board = TextBoard(connect, "text:fake", PROTOCOL, clock=lambda: used[-1].now)
    first = next(board.frames())
    used[0].read = lambda _: (_ for _ in ()).throw(OSError("unplugged"))
    with pytest.raises(DeviceError, match=r"went away \(unplugged"):
        next(board.frames())
    board.reconnect()
    second = next(board.frames())
    assert ports[0].closed
    assert frame_number(second) == 12
    assert (first.session, second.session) == (0, 1)
    assert (second.time, board.counts.reconnections) == (0.0, 1)
    board.close()
    board.close()
    assert ports[1].closed
    for use in (lambda: next(board.frames()), board.reconnect):
        with pytest.raises(DeviceError, match="closed"):
            use()


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
