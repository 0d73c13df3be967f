"""Lines of text: decoding, and division into frames."""

import cmath
import contextlib
import itertools
import math
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.hardware.boards.text_lines import (
    FrameDrop,
    FrameFinder,
    LineDecoder,
    LineDrop,
    Mark,
    Measurement,
)

from printed_lines import LINE, PAUSE, PERIOD, printed

# ---- lines ----


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


@pytest.mark.parametrize("turns", [-3, -1, 1, 2])
def test_a_phase_may_be_off_by_turns(turns):
    (line,) = LineDecoder().feed(f"RzMag: 5 Ohm , RzPhase: {-1.5 + 360 * turns}\n".encode())
    assert math.degrees(cmath.phase(line.impedance)) == pytest.approx(-1.5)


@pytest.mark.parametrize("number", ["nan", "-nan", "inf", "-inf", "nan(0x7)", "1e400", "-5.0"])
def test_a_value_that_is_no_number_keeps_its_place(number):
    (line,) = LineDecoder().feed(f"RzMag: {number} Ohm , RzPhase: 1.0\n".encode())
    assert math.isnan(line.impedance.real)
    assert math.isnan(line.impedance.imag)


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


@contextlib.contextmanager
def little_memory():
    """Little of what is allocated meanwhile is kept."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[0] < 50_000
    finally:
        tracemalloc.stop()


def test_a_line_without_end_does_not_fill_the_memory():
    decoder = LineDecoder()
    with little_memory():
        for _ in range(100):
            assert decoder.feed(b"x" * 10_000) == []
    assert len(decoder.feed(b"\n" + printed([1])[0].encode())) == 1
    assert decoder.drops == {LineDrop.TOO_LONG: 1}


def test_the_mark_is_a_line_of_its_own():
    decoder = LineDecoder("frame")
    assert decoder.feed(b"frame 12\nRzMag: 1 Ohm , RzPhase: 0\n")[0] == Mark()
    assert not decoder.drops


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


@pytest.mark.parametrize("count", [1, 5, 7])
def test_a_line_lost_or_added_costs_its_frame_and_shifts_none(count):
    finder = FrameFinder(6, marked=False)
    found = fed(finder, [6, 6, 6, count, 6, 6])
    assert groups(found) == [{2}, {4}, {5}]
    assert [lines.number for lines in found] == [0, 2, 3]
    assert (finder.lost, finder.drops[FrameDrop.INCOMPLETE]) == (1, count)


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
