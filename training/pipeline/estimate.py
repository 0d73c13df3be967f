"""Estimate of one frame: state, bend angle and touches, as far as they are estimated."""

import math
import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.schema import UNKNOWN_STATE, State
from eitskin.frame import Frame
from eitskin.training.method.predictions import FoundTouches, Predictions, TouchEstimate
from eitskin.training.method.targets import Targets
from eitskin.training.pipeline.stored_reference import Zero


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """State, bend angle and touches of one frame; None where a pipeline does not estimate them.

    Attributes:
        state: idle, touch or bend; touch for a bent sensor that is touched.
        probabilities: of the three states, in the order of `State`, (3,); NaN for a state that the
            pipeline does not tell apart.
        bend_angle_deg: bend angle [deg], positive convex on the touched side; in a touched frame
            the paper's method gives the angle just before the touch.
        bend_deviation_deg: standard error of the angle [deg]; None for a method without one.
        touch_map: how much of each pixel is touched, as estimated, (rows, columns), 0 to 1; rows
            and columns grow with y and x. Zero unless the state is touch.
        touches: strongest first, with forces and standard errors where the method gives them.
        problems: faults of the frame or the references, in words; empty without any.
        number: number of the frame.
        time: time of the frame [s].
        zero: state of the sensor that angle and touches are relative to.
    """

    state: State | None
    probabilities: NDArray[np.float64]
    bend_angle_deg: float | None
    bend_deviation_deg: float | None
    touch_map: NDArray[np.float32] | None
    touches: tuple[TouchEstimate, ...] | None
    problems: tuple[str, ...]
    number: int
    time: float
    zero: Zero = Zero.FIRST_FRAMES

    @classmethod
    def of(
        cls,
        predictions: Predictions,
        targets: Targets,
        problems: tuple[str, ...],
        frame: Frame,
        zero: Zero = Zero.FIRST_FRAMES,
    ) -> "Estimate":
        """The first of some predictions, made for `frame` by a method with these targets."""
        state = int(predictions.state[0])
        return cls(
            None if state == UNKNOWN_STATE else State(state),
            predictions.probabilities[0],
            _known(predictions.bend_angle_deg[0]),
            _known(predictions.bend_deviation_deg[0]),
            predictions.touch_map[0] if targets.touches else None,
            tuple(predictions.touches[0]) if targets.touches else None,
            problems,
            frame.number,
            frame.time,
            zero,
        )

    def of_unknown_start(self) -> "Estimate":
        """The estimate where it is unknown whether the session began flat and untouched.

        A touch since then is known; idle, bend and the angle are not.
        """
        unknown = np.where(np.arange(len(State)) == State.TOUCH, self.probabilities, np.nan)
        return replace(
            self,
            state=self.state if self.state is State.TOUCH else None,
            probabilities=unknown,
            bend_angle_deg=None,
            bend_deviation_deg=None,
        )

    @property
    def found(self) -> FoundTouches | None:
        """The touches as arrays; deprecated, use `touches`."""
        warnings.warn("use Estimate.touches for Estimate.found", DeprecationWarning, stacklevel=2)
        if self.touches is None:
            return None
        rows = [(t.strength, t.force, t.deviation) for t in self.touches]
        strength, force, deviation = np.reshape(rows, (-1, 3)).T
        return FoundTouches.of([t[:2] for t in self.touches], strength, force, deviation)


def _known(value: float) -> float | None:
    """`value`, None where it is not a number."""
    return float(value) if math.isfinite(value) else None
