"""Order of the frames of a session by their numbers and times, and faults of these."""

import math
from collections import deque
from dataclasses import dataclass, field
from statistics import median
from typing import NamedTuple

from eitskin.frame import Frame

MAX_GAP = 5.0  # s without frames after which the dynamic reference may be out of date
NUMBERS = 2**32  # frame numbers on the wire are counted modulo this
STEPS = 9  # latest steps of time whose median is the usual one
MIN_STEPS = 3
JUMP = 20  # usual steps that make a jump
MAX_ELAPSED_TIME = 1e7  # s; four months without a restart, after which all drift has happened


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
