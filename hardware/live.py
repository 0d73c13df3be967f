"""The live loop: from a board's frames to what the pipeline makes of them."""

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


class Estimate(typing.Protocol):
    """What a pipeline says of one frame."""

    @property
    def state(self) -> State | str:
        """Idle, touched or bent."""

    @property
    def probabilities(self) -> Sequence[float] | NDArray[np.floating]:
        """Of the states, in their order, summing to one, (3,)."""

    @property
    def bend_angle_deg(self) -> float:
        """Bend angle; NaN where it is unknown."""

    @property
    def touch_map(self) -> NDArray[np.floating]:
        """Picture of the touches, (32, 80), 0 to 1; rows and columns grow with y and x."""

    @property
    def touches(self) -> Sequence[tuple[float, float, float]]:
        """Each touch as x [m], y [m] and strength."""

    @property
    def problems(self) -> tuple[str, ...]:
        """Why not to trust this estimate; empty when all is well."""


class FramePipeline(typing.Protocol):
    """Anything that makes an estimate of a frame."""

    def process(self, frame: Frame) -> Estimate:
        """The estimate for `frame`."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One turn of the live loop.

    Attributes:
        frame: as the board gave it.
        estimate: what the pipeline makes of it; None where the frame is too damaged for one.
        latency: from having the frame to having the estimate [s].
        rate: frames per second over the last seconds; NaN for the first.
        unusable: frames so far that were too damaged for an estimate.
        problem: why there is no estimate.
    """

    frame: Frame
    estimate: Estimate | None
    latency: float
    rate: float
    unusable: int = 0
    problem: str = ""


class FrameSource(typing.Protocol):
    """A `Board`, or a `Connection` to one."""

    def frames(self, newest: bool = False) -> Iterator[Frame]:
        """The frames, as they come."""


def run_live(
    board: FrameSource,
    pipeline: FramePipeline,
    newest: bool = True,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[Reading]:
    """Read, process and hand out, frame by frame.

    Args:
        board: an open board; a `Connection` where it may go away and come back.
        pipeline: makes an estimate of every frame.
        newest: skip frames that another has overtaken, so that what is shown is never old and no
            queue grows; the board counts them.
        clock: seconds, for latency and rate.

    A damaged frame is counted, and handed out with the reason instead of an estimate.

    Raises:
        DeviceError: where the board falls silent or goes away.
        FrameError: for a board of another sensor; not once there was an estimate, for then it is
            the board that has gone wrong, and it may come round.
    """
    unusable = 0
    known = False
    arrivals: deque[float] = deque(maxlen=20)
    for frame in board.frames(newest=newest):
        arrivals.append(clock())
        estimate, problem = None, ""
        try:
            estimate = pipeline.process(frame)
            known = True
        except FrameError as error:
            if not (known or isinstance(error, UnusableFrameError)):
                raise
            problem, unusable = str(error), unusable + 1
        latency = clock() - arrivals[-1]
        yield Reading(frame, estimate, latency, _rate(arrivals), unusable, problem)


def _rate(arrivals: deque[float]) -> float:
    """Frames per second [Hz]; NaN where there is no interval yet."""
    if len(arrivals) < 2 or arrivals[-1] <= arrivals[0]:
        return float("nan")
    return (len(arrivals) - 1) / (arrivals[-1] - arrivals[0])
