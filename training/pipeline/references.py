"""References of a session: running means, or stored in a file; and the order of its frames."""

import json
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import LARGEST_READING, LEAST_READING, require_axes
from eitskin.config import Location, build
from eitskin.errors import ConfigurationError, DataError
from eitskin.extras import old_names
from eitskin.files import atomic_file, parse_json, read_bytes
from eitskin.frame import Frame
from eitskin.protocol import Protocol
from eitskin.training.method.observations import relative_difference
from eitskin.training.method.predictions import Zero

FORMAT = "eitskin-reference"
FORMAT_VERSION = 1
MAX_FILE = 10_000_000  # bytes; a thousand measurements need 50,000

Voltages = NDArray[np.complex128]

MAX_MEAN_FRAMES = 32  # frames; a longer mean would lag behind a drift too slow to count as motion
MAX_GAP = 5.0  # s without frames after which the dynamic reference may be out of date
NUMBERS = 2**32  # frame numbers on the wire are counted modulo this
STEPS = 9  # latest steps of time whose median is the usual one
MIN_STEPS = 3
JUMP = 20  # usual steps that make a jump
MAX_ELAPSED_TIME = 1e7  # s; four months without a restart, after which all drift has happened


@dataclass
class RunningMean:
    """Mean of the frames since the sensor last moved.

    Attributes:
        noise: rms over the channels of the relative difference of two frames of a still sensor.
        mean: complex (measurements,) [ohm], NaN where never measured; size 0 at first.
        count: number of frames in the mean.
        longest: number of frames beyond which the mean becomes exponential.
    """

    noise: float
    mean: Voltages = field(default_factory=lambda: np.zeros(0, np.complex128))
    count: int = 0
    longest: int = MAX_MEAN_FRAMES

    def restart(self, impedance: ArrayLike) -> None:
        """Begin a new mean with this frame (measurements,) [ohm]."""
        self.mean, self.count = np.array(impedance, dtype=np.complex128), 1

    def add(self, impedance: ArrayLike) -> bool:
        """Add one frame (measurements,) [ohm], NaN where a channel is bad.

        Returns whether the sensor moved, which restarts the mean. A still frame differs from the
        mean by at most `noise` rms; twice that counts as motion. With 28 channels, chance exceeds
        this limit less than once in a billion frames.
        """
        V = np.array(impedance, dtype=np.complex128)
        if not self.mean.size:
            self.restart(V)
            return False
        finite = np.isfinite(V) & np.isfinite(self.mean)
        change = relative_difference(V[finite], self.mean[finite])
        departed = bool(change.size and np.sqrt(np.mean(change**2)) > 2 * self.noise)
        self.count = 1 if departed else min(self.count + 1, self.longest)
        step = np.where(finite, (V - self.mean) / self.count, 0)
        only_new = np.isfinite(V) & ~np.isfinite(self.mean)
        self.mean = np.where(only_new, V, self.mean + step)
        return departed


@old_names(of="from_frames")
@dataclass(frozen=True, slots=True, eq=False)
class StoredReference:
    """Mean of untouched frames of one sensor.

    Attributes:
        impedance: (measurements,) [ohm]; NaN where a channel was bad.
        protocol: protocol of the measurements.
        frequency: frequency of the excitation [Hz].
        zero: state of the sensor, `Zero.FLAT` or `Zero.MOUNTED`.
        frames: number of frames in the mean.
        noise: rms of the relative difference of two of the frames; None for a single one.
        taken: time of writing, ISO 8601 with time zone.
        board: unique number of the board in hexadecimal digits; empty where unknown.
        source: URI or path that the frames came from; empty where unknown.

    Example:
        >>> from eitskin import Pipeline, Scene, SensorDesign, Simulator
        >>> pipeline = Pipeline.load("reference.eitmodel")
        >>> pipeline.tare([Simulator(SensorDesign.reference(), "coarse").measure(Scene())]).frames
        1
    """

    impedance: NDArray[np.complex128]
    protocol: Protocol
    frequency: float
    zero: Zero
    frames: int
    noise: float | None
    taken: str
    board: str = ""
    source: str = ""

    @classmethod
    def from_frames(
        cls,
        impedance: Sequence[NDArray[np.complex128]],
        protocol: Protocol,
        frequency: float,
        zero: Zero,
        still: float = math.inf,
        board: str = "",
        source: str = "",
    ) -> "StoredReference":
        """Mean of n frames (n, measurements) [ohm], NaN where a channel is bad, taken now.

        Args:
            impedance: n frames; readings beyond those of all sensors are bad.
            protocol, frequency, zero, board, source: values of the attributes.
            still: rms of the relative difference of two frames of a still sensor; twice that is
                motion.

        Raises DataError for a sensor that moves, and without a good channel in any frame.
        """
        values, count = np.asarray(impedance), len(impedance)
        size = np.abs(values)
        values = np.where((size >= LEAST_READING) & (size <= LARGEST_READING), values, np.nan)
        mean = RunningMean(still, longest=count)
        for number, frame in enumerate(values, 1):
            if mean.add(frame):
                raise DataError(
                    f"expected frames of a still sensor, but it moves in frame {number} of "
                    f"{count}; hold it still and take the reference again"
                )
        average, noise = mean.mean, None
        if not np.isfinite(average).any():
            raise DataError(
                "expected readings of the untouched sensor, but every channel is bad; check the "
                "board and its cable"
            )
        if count > 1:
            departures = relative_difference(values, average)
            noise = math.sqrt(2.0 * float(np.nanmean(departures**2)) * count / (count - 1))
        time_text = datetime.now(UTC).isoformat(timespec="seconds")
        return cls(average, protocol, frequency, zero, count, noise, time_text, board, source)

    def magnitudes(self, usual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Magnitudes (measurements,) [ohm]; `usual` ones, scaled, where a channel was bad."""
        require_axes("usual", usual, len(self.protocol), more=False)
        finite = np.isfinite(self.impedance)
        scale = np.median(np.abs(self.impedance[finite]) / usual[finite])
        return np.where(finite, np.abs(self.impedance), scale * usual)

    def frame(self, time: float = 0.0) -> Frame:
        """The reference as a frame at a time [s]; bad channels are NaN."""
        return Frame(self.impedance, self.protocol, time, frequency=self.frequency)

    def write(self, path: str | Path) -> Path:
        """Write the file, whole or not at all; returns its path.

        Raises ConfigurationError where it cannot be written.
        """
        path = Path(path)
        document = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "protocol": asdict(self.protocol),
            **{name: getattr(self, name) for name in self.__slots__[2:]},
            **{
                name: [value if math.isfinite(value) else None for value in part.tolist()]
                for name, part in (
                    ("real", self.impedance.real),
                    ("imaginary", self.impedance.imag),
                )
            },
        }
        with atomic_file(path) as temporary:
            temporary.write_text(json.dumps(document, allow_nan=False) + "\n", encoding="utf-8")
        return path

    @classmethod
    def read(cls, path: str | Path) -> "StoredReference":
        """Reference from a file.

        Raises DataError for a file that is missing, damaged, no reference, or newer than this
        eitskin.
        """
        path = Path(path)
        try:
            data = parse_json(read_bytes(path, MAX_FILE))
            if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
                raise DataError(f"{path} is no reference; make one with eitskin tare")
            if (version := data.pop("format_version", None)) != FORMAT_VERSION:
                raise DataError(
                    f"{path} has format version {version}, this eitskin reads {FORMAT_VERSION}; "
                    "install a newer eitskin, or make the reference again with eitskin tare"
                )
            return build(_reference, data, Location(str(path)))
        except DataError:
            raise
        except (ConfigurationError, ValueError) as error:
            raise DataError(
                f"{path} is no whole reference: {error}; make it again with eitskin tare"
            ) from error


def _reference(
    protocol: Protocol,
    frequency: float,
    zero: Literal["flat", "as mounted"],
    frames: int,
    noise: float | None,
    taken: str,
    board: str,
    source: str,
    real: tuple[float | None, ...],
    imaginary: tuple[float | None, ...],
) -> StoredReference:
    """The reference of a file, null where a channel was bad; raises ValueError for others."""
    if not len(real) == len(imaginary) == len(protocol):
        raise ValueError(
            f"expected {len(protocol)} real and imaginary values, got {len(real)} and "
            f"{len(imaginary)}"
        )
    parts = np.array([real, imaginary], dtype=float)  # None becomes NaN
    impedance = parts[0] + 1j * parts[1]
    if not np.isfinite(impedance).any() or (impedance == 0).any():
        raise ValueError("expected impedances other than 0 ohm, and a good channel at least")
    if frames < 1 or frequency <= 0 or not (noise is None or noise >= 0):
        raise ValueError("expected a positive number of frames and a frequency above 0 Hz")
    datetime.fromisoformat(taken)
    return StoredReference(
        impedance, protocol, frequency, Zero(zero), frames, noise, taken, board, source
    )


@dataclass(frozen=True, slots=True)
class Step:
    """Step from one frame to the next.

    Attributes:
        new_session: whether the frame begins a new session.
        gap: whether no frames came for more than `MAX_GAP`.
        problems: faults of clock and counters, and a session's beginning, in words.
    """

    new_session: bool = False
    gap: bool = False
    problems: tuple[str, ...] = ()


class _FrameStamp(NamedTuple):
    """Frame's number and time [s], NaN where it had none, and the time elapsed until then [s]."""

    number: int
    time: float
    elapsed: float = 0.0

    def advance(self, frame: Frame) -> int:
        """Number of frames from this one to another; half of `NUMBERS` or more backwards."""
        return (frame.number - self.number) % NUMBERS


@dataclass
class SessionOrder:
    """Frames of a session in their order.

    A frame of another session begins a new session, and so does one whose number and time both ran
    back; a number that wraps at 2^32 did not, nor one that fills the latest gap. A fault of one of
    the two, or of both in a single frame, is reported and changes nothing: a session that it began
    would take the sensor as it then is for its zero.
    """

    _session: int = 0
    _last: _FrameStamp | None = None
    _before: _FrameStamp | None = None  # the latest jump ahead, while the frames may yet come back
    _previous: _FrameStamp | None = None  # the one before the last
    _steps: deque[float] = field(default_factory=lambda: deque(maxlen=STEPS))

    @property
    def elapsed_time(self) -> float:
        """Time since the session's first frame [s], without steps backwards."""
        return 0.0 if self._last is None else self._last.elapsed

    def follow(self, frame: Frame) -> Step:
        """Take the next frame."""
        last = self._last
        if last is None:
            return self._begin(frame, "")
        if frame.session != self._session:
            return self._begin(frame, f"session {frame.session} follows session {self._session}")
        if self._before is not None and self._returns(frame, self._before, last):
            last = self._before
        advance, step = last.advance(frame), frame.time - last.time
        backwards = advance >= NUMBERS // 2
        if backwards and step < 0 and self._is_late(frame, last):
            return Step(problems=_describe_fault(frame, f"it comes after frame {last.number}"))
        if backwards and step < 0:
            return self._begin(frame, f"frame number {frame.number} follows {last.number}")
        self._previous = last
        timed = math.isfinite(frame.time)
        if not timed or math.isnan(last.time):
            time = frame.time if timed else last.time
            self._last = _FrameStamp(frame.number, time, last.elapsed)
            return Step(
                problems=_describe_fault(frame, "" if timed else f"its time is {frame.time}")
            )
        problem = self._clock_problem(step, max(advance, 1))
        if backwards:
            problem = f"its number follows {last.number}, but its time went on"
        if not problem:
            self._steps.append(step / max(advance, 1))
        self._before = last if problem and step >= 0 and not backwards else None
        elapsed = min(last.elapsed + max(step, 0.0), MAX_ELAPSED_TIME)
        self._last = _FrameStamp(frame.number, frame.time, elapsed)
        return Step(False, step > MAX_GAP, _describe_fault(frame, problem))

    def _begin(self, frame: Frame, reason: str) -> Step:
        """A session's first step; `reason`: of a session after the first."""
        time = frame.time if math.isfinite(frame.time) else math.nan
        self._session, self._last, self._before = (
            frame.session,
            _FrameStamp(frame.number, time),
            None,
        )
        self._previous = None
        self._steps.clear()
        problems: tuple[str, ...] = (f"a new session begins: {reason}",) if reason else ()
        problems += _describe_fault(frame, f"its time is {frame.time}") if math.isnan(time) else ()
        return Step(new_session=bool(reason), problems=problems)

    def _is_late(self, frame: Frame, last: _FrameStamp) -> bool:
        """Whether a frame belongs between the last two by its number and its time."""
        previous = self._previous
        if previous is None:
            return False
        between = 0 < previous.advance(frame) < (last.number - previous.number) % NUMBERS
        return between and previous.time < frame.time < last.time

    def _returns(self, frame: Frame, before: _FrameStamp, last: _FrameStamp) -> bool:
        """Whether a frame goes on where the frames were `before` they jumped ahead to `last`."""
        ran_back = frame.time < last.time or last.advance(frame) >= NUMBERS // 2
        step, advance = frame.time - before.time, before.advance(frame)
        goes_on = advance < NUMBERS // 2 and step >= 0
        return ran_back and goes_on and not self._clock_problem(step, max(advance, 1))

    def _clock_problem(self, step: float, advance: int) -> str:
        """Fault of a step of time [s] between frames `advance` apart, in words; empty without."""
        if step < 0:
            return f"the clock ran back by {-step:.3g} s"
        if len(self._steps) < MIN_STEPS:
            return ""
        usual = median(self._steps)
        due = usual * advance
        if step > max(MAX_GAP, JUMP * usual) + due:
            return f"the clock jumped ahead by {step:.3g} s, {due:.3g} s are usual"
        if due > max(MAX_GAP, JUMP * usual) + JUMP * step:
            return f"its number jumped ahead by {advance}, in {step:.3g} s"
        return ""


def _describe_fault(frame: Frame, problem: str) -> tuple[str, ...]:
    """Fault of a frame's number or time, as a problem of its estimate; none where it is empty."""
    message = f"frame {frame.number}: {problem}; the references stay as they were"
    return (message,) if problem else ()
