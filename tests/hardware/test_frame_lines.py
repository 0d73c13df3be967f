"""Boards that print all numbers of a frame in one line, and other forms of a measurement."""

import itertools

import numpy as np
import pytest

from eitskin.errors import DeviceError
from eitskin.hardware.boards.text_board import TextBoard
from eitskin.hardware.boards.text_lines import LineDecoder
from eitskin.simulator import Protocol, Status


class Port:
    """A port that prints lines, one at each read, after the end of one that was cut."""

    def __init__(self, lines):
        self.now, self.chunks = 0.0, [b"5\r\n", *(line.encode() + b"\r\n" for line in lines)]
        self.in_waiting = 0

    def read(self, size=1):  # noqa: ARG002
        self.now += 0.1
        return self.chunks.pop(0) if self.chunks else b""

    def reset_input_buffer(self):
        pass

    def close(self):
        pass


def frames(lines, protocol):
    port = Port(lines)
    board = TextBoard(lambda: port, "text:x", protocol, clock=lambda: port.now)
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
