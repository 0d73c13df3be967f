"""Hostile boards: bytes of ports, frames and sessions."""

import dataclasses
import functools
import math
import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.studies.boards.fuzz_codec import fuzz_codec
from eitskin.benchmarks.studies.hostile.mutations import damaged
from eitskin.benchmarks.studies.hostile.texts import Draws, Trial
from eitskin.errors import DataError
from eitskin.frame import Frame
from eitskin.hardware.boards.board import Counts
from eitskin.hardware.boards.text_frames import FrameFinder
from eitskin.hardware.boards.text_lines import LineDecoder
from eitskin.hardware.live import run_live
from eitskin.hardware.protocol.frame_parts import FrameData
from eitskin.hardware.protocol.messages import pack, unpack
from eitskin.hardware.protocol.packets import MAX_PAYLOAD, Decoder, MessageError, Packet, encode
from eitskin.hardware.streams.reading_record import reading_record
from eitskin.training.pipeline.pipeline import Pipeline

CODEC_BYTES = 10_000  # of one trial
ODD_NUMBERS = (0, 5_000_000, 2**31, 2**32 - 1)
ODD_TIMES = (math.nan, math.inf, -math.inf, -1e308, 1e308, 4294.967295, 0.0)
ODD_VALUES = (math.nan, math.inf, -math.inf, 0.0, 1e-300, 1e300, -1.0, 500.0)
LINE = b"Freq:40000.00 RzMag: 612.500000 Ohm , RzPhase: -1.250000\r\n"


def boards() -> Mapping[str, Trial]:
    """Trials of boards by kind."""
    return {
        "codec, 10,000 bytes each": _codec,
        "messages with a right checksum": _message,
        "bytes of a port": _port,
        "lines of text boards": _lines,
        "random frames": _frame,
        "sessions": session,
    }


def _codec(rng: Draws, folder: Path) -> object:  # noqa: ARG001
    found = fuzz_codec(CODEC_BYTES, rng.randrange(2**32))
    if found.raised or found.false or found.mixed:
        raise AssertionError(found)
    return found


def _good_message(rng: random.Random) -> Packet:
    values = np.array([complex(rng.uniform(400, 800), 1.0) for _ in range(28)], np.complex64)
    return pack(FrameData(1, 0.3, 0.297, values, np.zeros(28, np.uint8)), 1)


def _message(rng: Draws, folder: Path) -> object:  # noqa: ARG001
    """Message that a board has damaged before it made the checksum."""
    good = _good_message(rng)
    payload = damaged(rng, good.payload)[:MAX_PAYLOAD]
    kind = rng.choice((good.type, rng.randrange(256)))
    return _unpacked(encode(dataclasses.replace(good, type=kind, payload=payload)))


def _port(rng: Draws, folder: Path) -> object:  # noqa: ARG001
    packet = encode(_good_message(rng))
    return _unpacked(damaged(rng, packet) + packet)


def _unpacked(data: bytes) -> list[Any]:
    found = []
    for packet in Decoder().feed(data):
        try:
            found.append(unpack(packet))
        except MessageError as error:
            raise DataError(str(error)) from error
    return found


def _lines(rng: Draws, folder: Path) -> object:  # noqa: ARG001
    """Lines of three frames with odd times between them."""
    decoder, finder = LineDecoder(), FrameFinder(4, marked=False)
    stream, clock, found = damaged(rng, LINE * 24), 0.0, []
    while stream:
        cut = rng.choice((1, 20, len(LINE), 400))
        piece, stream = stream[:cut], stream[cut:]
        clock += rng.choice((0.001, 0.01, 0.3, 0.0, 1e9))
        found += finder.feed(clock, decoder.feed(piece))
    return found


@functools.lru_cache
def shipped_pipeline() -> Pipeline:
    """The pipeline that comes with eitskin, loaded once."""
    return Pipeline.load("reference.eitmodel")


def good_frame(pipeline: Pipeline, rng: np.random.Generator, number: int) -> Frame:
    """Frame of a sensor at rest, with noise."""
    layout = pipeline.layout
    impedance = layout.reference * (1 + 2e-4 * rng.standard_normal(len(layout.reference)))
    return Frame(
        impedance.astype(complex), layout.protocol, 0.3 * number, number, frequency=layout.frequency
    )


def damaged_frame(good: Frame, rng: np.random.Generator) -> Frame:
    """Frame with one fault, or several."""
    values, count = good.impedance.copy(), len(good.impedance)
    chosen = rng.random(count) < rng.choice([0.04, 0.5, 1.0])
    faults: dict[str, Callable[[], NDArray[Any]]] = {
        "sign": lambda: np.where(chosen, -values, values),
        "values": lambda: np.where(chosen, rng.choice(ODD_VALUES, count), values),
        "factor": lambda: np.where(chosen, values * 10 ** rng.uniform(-12, 12), values),
        "phase": lambda: values * np.exp(2j * np.pi * rng.random()),
        "order": lambda: rng.permutation(values),
        "touch": lambda: values * (1 + 0.2 * rng.standard_normal(count)),
        "every other": lambda: np.where(np.arange(count) % 2, np.nan, values),
    }
    changes: dict[str, Any] = {"impedance": faults[rng.choice(list(faults))]()}
    if rng.random() < 0.3:
        changes["time"] = float(rng.choice(ODD_TIMES))
    if rng.random() < 0.3:
        changes["number"] = int(rng.choice(ODD_NUMBERS))
    if rng.random() < 0.1:
        changes["session"] = int(rng.integers(0, 2**16))
    if rng.random() < 0.2:
        changes["status"] = rng.integers(0, 256, count).astype(np.uint8) * chosen
    return dataclasses.replace(good, **changes)


def _frame(rng: Draws, folder: Path) -> object:  # noqa: ARG001
    """Frame of odd values after a good one, or as the first of a session."""
    pipeline, numbers = shipped_pipeline(), np.random.default_rng(rng.randrange(2**32))
    pipeline.reset()
    good = good_frame(pipeline, numbers, 0)
    if rng.random() < 0.9:
        pipeline.process(good)
    estimate = pipeline.process(
        damaged_frame(dataclasses.replace(good, number=1, time=0.3), numbers)
    )
    _require_finite(estimate)
    return estimate


def _require_finite(estimate: Any) -> None:
    """Raise ArithmeticError unless what is estimated is finite, or there is a problem."""
    numbers = [estimate.bend_angle_deg or 0.0, *np.ravel(estimate.touches or [0.0])]
    if not (estimate.problems or np.isfinite(numbers).all()):
        raise ArithmeticError(f"not finite, without a problem: {estimate}")


@dataclass
class FrameSource:
    """Board of a list of frames."""

    counts: ClassVar[Counts] = Counts()
    made: list[Frame]

    def frames(self, newest: bool = False) -> Iterator[Frame]:  # noqa: ARG002
        """The frames."""
        return iter(self.made)


def session(rng: Draws, folder: Path, frames: int = 50) -> int:  # noqa: ARG001
    """Number of estimates in a live session of which most frames are damaged after the first."""
    pipeline, numbers = shipped_pipeline(), np.random.default_rng(rng.randrange(2**32))
    made = [good_frame(pipeline, numbers, number) for number in range(frames)]
    bad = [each if numbers.random() < 0.3 else damaged_frame(each, numbers) for each in made[1:]]
    pipeline.reset()
    estimates = 0
    readings = list(run_live(FrameSource([made[0], *bad]), pipeline))
    for reading in readings:
        if (reading.estimate is None) != bool(reading.problem):
            raise AssertionError(f"estimate and problem: {reading}")
        if reading.problem.startswith("the pipeline failed"):
            raise ArithmeticError(reading.problem)
        reading_record(reading, FrameSource.counts)
        estimates += reading.estimate is not None
    if len(readings) != frames:
        raise AssertionError(f"{len(readings)} readings of {frames} frames")
    return estimates
