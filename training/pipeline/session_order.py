"""Order of a session's frames: sessions and frame numbers decide, times only measure ages."""

from collections import deque
from dataclasses import dataclass, field
from statistics import median

from eitskin.frame import Frame

LONGEST_GAP = 5.0  # s without frames after which the dynamic reference may be out of date
NUMBERS = 2**32  # frame numbers on the wire are counted modulo this
STEPS = 9  # latest steps of time whose median is the usual one
FEWEST_STEPS = 3
JUMP = 20  # usual steps that make a jump


@dataclass(frozen=True, slots=True)
class Step:
    """Step from one frame to the next.

    Attributes:
        new_session: whether the frame begins a new session.
        gap: whether no frames came for more than `LONGEST_GAP`.
        problems: faults of clock and counters, and a session's beginning, in words.
    """

    new_session: bool = False
    gap: bool = False
    problems: tuple[str, ...] = ()


@dataclass
class SessionOrder:
    """Frames of a session in their order.

    A frame of another session, or one with a smaller number, begins a new session; a number that
    wraps at 2^32 does not. A time that runs backwards or jumps changes nothing and is told.

    Attributes:
        elapsed: time since the session's first frame [s], without steps backwards.
    """

    elapsed: float = 0.0
    _last: Frame | None = None
    _steps: deque[float] = field(default_factory=lambda: deque(maxlen=STEPS))

    def follow(self, frame: Frame) -> Step:
        """Take the next frame."""
        last, self._last = self._last, frame
        if last is None:
            return Step()
        if frame.session != last.session:
            return self._begin(f"session {frame.session} follows session {last.session}")
        advance = (frame.number - last.number) % NUMBERS
        if advance >= NUMBERS // 2:
            return self._begin(f"frame number {frame.number} follows {last.number}")
        step = frame.time - last.time
        self.elapsed += max(step, 0.0)
        problem = self._clock_problem(step, max(advance, 1))
        self._steps.append(step / max(advance, 1))
        told = f"frame {frame.number}: {problem}; the references stay as they were"
        return Step(False, step > LONGEST_GAP, (told,) if problem else ())

    def _begin(self, reason: str) -> Step:
        """A new session's first step."""
        self.elapsed = 0.0
        self._steps.clear()
        return Step(new_session=True, problems=(f"a new session begins: {reason}",))

    def _clock_problem(self, step: float, advance: int) -> str:
        """Fault of a step of time [s] between frames `advance` apart, in words; empty without."""
        if step < 0:
            return f"the clock ran back by {-step:.3g} s"
        if len(self._steps) < FEWEST_STEPS:
            return ""
        usual = median(self._steps)
        if step > max(LONGEST_GAP, JUMP * usual) + usual * advance:
            return f"the clock jumped ahead by {step:.3g} s, {usual * advance:.3g} s are usual"
        return ""
