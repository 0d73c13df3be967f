"""Live loop: frames of a board through a pipeline, with latency, rate and damaged frames."""

import logging
import math
import time
import typing
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.state import State
from eitskin.errors import FrameError, UnusableFrameError
from eitskin.frame import Frame
from eitskin.input_files import printable

LONGEST_REASON = 200  # letters

log = logging.getLogger(__name__)


class Estimate(typing.Protocol):
    """Result of a pipeline for one frame; None where the pipeline does not estimate a quantity."""

    @property
    def state(self) -> State | str | None:
        """State: idle, touched or bent."""

    @property
    def probabilities(self) -> Sequence[float] | NDArray[np.floating]:
        """Probabilities of the states, in their order, (3,); NaN for those not told apart."""

    @property
    def bend_angle_deg(self) -> float | None:
        """Bend angle [deg]; NaN where unknown."""

    @property
    def touch_map(self) -> NDArray[np.floating] | None:
        """Touch map, (rows, columns), 0 to 1; rows and columns grow with y and x."""

    @property
    def touches(self) -> Sequence[tuple[float, float, float]] | None:
        """Touches as (x [m], y [m], strength), with attributes force and deviation if known."""

    @property
    def problems(self) -> tuple[str, ...]:
        """Reasons not to trust the estimate; empty without doubts."""


class FramePipeline(typing.Protocol):
    """Pipeline as far as the live loop uses it: one frame in, one estimate out."""

    def process(self, frame: Frame) -> Estimate:
        """Estimate for `frame`."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One turn of the live loop.

    Attributes:
        frame: frame of the board, unchanged.
        estimate: result of the pipeline; None for a frame too damaged for one.
        latency: time from the frame to its estimate [s].
        rate: mean frame rate over the last 20 frames [Hz]; NaN for the first.
        unusable: frames so far that were too damaged for an estimate.
        problem: reason for a missing estimate; empty otherwise.
        wall_time: when the frame came, by the clock of this machine [s since 1970]; NaN where
            unknown.
    """

    frame: Frame
    estimate: Estimate | None
    latency: float
    rate: float
    unusable: int = 0
    problem: str = ""
    wall_time: float = math.nan


class FrameSource(typing.Protocol):
    """A `Board` or a `Connection`, as far as the live loop uses them."""

    def frames(self, newest: bool = False) -> Iterator[Frame]:
        """Frames as they come; with `newest`, older waiting frames are skipped."""


def run_live(
    board: FrameSource,
    pipeline: FramePipeline,
    newest: bool = True,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[Reading]:
    """Estimates of a board's frames, one reading per frame.

    Args:
        board: an open board; a `Connection` where it may go away and come back.
        pipeline: makes an estimate of every frame.
        newest: skip all but the newest waiting frame, so that no queue grows and no reading is
            old; the board counts the skipped frames.
        clock: time for latency and rate [s].

    A damaged frame is counted, and its reading has the reason instead of an estimate. So is any
    other frame by which the pipeline fails.

    Raises:
        DeviceError: where the board falls silent or goes away.
        FrameError: for a board of another sensor. After a first estimate the sensor is the right
            one: later errors count as damaged frames, since the board may recover.
    """
    unusable = 0
    known = False
    arrivals: deque[float] = deque(maxlen=20)
    for frame in board.frames(newest=newest):
        arrivals.append(clock())
        wall_time = time.time()
        estimate, problem = None, ""
        try:
            estimate = pipeline.process(frame)
            known = True
        except FrameError as error:
            if not (known or isinstance(error, UnusableFrameError)):
                raise
            problem, unusable = str(error), unusable + 1
        except Exception as error:  # a session must outlive whatever one frame brings about
            log.debug("frame %d", frame.number, exc_info=True)
            problem, unusable = _failure(error), unusable + 1
        latency = clock() - arrivals[-1]
        yield Reading(frame, estimate, latency, _rate(arrivals), unusable, problem, wall_time)


def _failure(error: Exception) -> str:
    """Sentence on an error of a pipeline, on one line; the log has its traceback."""
    said = printable(" ".join(str(error).split())[:LONGEST_REASON])
    return f"the pipeline failed on this frame ({type(error).__name__}: {said})"


def _rate(arrivals: deque[float]) -> float:
    """Mean frame rate of the arrivals [Hz]; NaN without an interval."""
    if len(arrivals) < 2 or arrivals[-1] <= arrivals[0]:
        return float("nan")
    return (len(arrivals) - 1) / (arrivals[-1] - arrivals[0])
