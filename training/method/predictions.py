"""Output of a method for n frames, and of a pipeline for one: state, bend angle, touches, map."""

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import require_axes, require_count
from eitskin.datasets import UNKNOWN_STATE, State, touch_maps
from eitskin.errors import ConfigurationError
from eitskin.extras import old_names
from eitskin.simulator import Frame
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.targets import NOMINAL_RADIUS, STATE_NAMES, Targets, most_probable

Array = NDArray[np.float64]

PROBABILITY_ERROR = 1e-3  # of their sum; networks compute in single precision


class TouchEstimate(tuple[float, float, float]):
    """One touch; unpacks as x, y and strength.

    Attributes:
        x, y: position in coordinates of the flat sensor [m].
        force: normal force [N]; NaN where the method does not estimate it.
        deviation: standard error of the position, sqrt(var x + var y) [m]; NaN where the method
            does not estimate it.
        strength: confidence or relative strength, 0 to 1.

    Example:
        >>> from eitskin.training import TouchEstimate
        >>> x, y, strength = TouchEstimate(0.050, 0.020, force=8.0)
        >>> x, y
        (0.05, 0.02)
    """

    x: float
    y: float
    force: float
    deviation: float
    strength: float

    def __new__(
        cls,
        x: float,
        y: float,
        force: float = math.nan,
        deviation: float = math.nan,
        strength: float = 1.0,
    ) -> "TouchEstimate":
        """A touch, as the tuple (x, y, strength) with two more attributes."""
        touch = super().__new__(cls, (x, y, strength))
        touch.x, touch.y, touch.strength = x, y, strength
        touch.force, touch.deviation = force, deviation
        return touch

    def __getnewargs__(self) -> tuple[float, float, float, float, float]:
        """Arguments of a copy."""
        return self.x, self.y, self.force, self.deviation, self.strength

    def __repr__(self) -> str:
        """All attributes."""
        return (
            f"TouchEstimate(x={self.x}, y={self.y}, force={self.force}, "
            f"deviation={self.deviation}, strength={self.strength})"
        )


@old_names(of="from_arrays")
@dataclass(frozen=True, slots=True, eq=False)
class FoundTouches:
    """The k touches of one frame, strongest first.

    Attributes:
        place: position x and y in coordinates of the flat sensor (k, 2) [m].
        strength: confidence or relative strength, 0 to 1, (k,).
        force: (k,) [N]; NaN where the method does not estimate it.
        deviation: standard error of the position, sqrt(var x + var y), (k,) [m]; NaN where the
            method does not estimate it.

    Example:
        >>> import numpy as np
        >>> from eitskin.training import FoundTouches
        >>> place, one = np.array([[0.05, 0.02]]), np.array([1.0])
        >>> len(FoundTouches(place, one, 8.0 * one, 1e-3 * one).place)
        1
    """

    place: Array
    strength: Array
    force: Array
    deviation: Array

    @classmethod
    def from_arrays(
        cls,
        place: ArrayLike,
        strength: ArrayLike,
        force: ArrayLike | None = None,
        deviation: ArrayLike | None = None,
    ) -> "FoundTouches":
        """Sort touches by strength; force and deviation are NaN where not given."""
        size = np.asarray(strength, dtype=float).reshape(-1)
        order = np.argsort(-size, kind="stable")

        def sorted_or_unknown(name: str, values: ArrayLike | None, *axes: int) -> Array:
            if values is None:
                return np.full((len(size), *axes), np.nan)
            made = np.asarray(values, dtype=float)
            if made.size != math.prod((len(size), *axes)):
                raise ConfigurationError(f"{name}: expected one for each strength, {len(size)}")
            return made.reshape(-1, *axes)[order]

        return cls(
            sorted_or_unknown("place", place, 2),
            size[order],
            sorted_or_unknown("force", force),
            sorted_or_unknown("deviation", deviation),
        )

    def __len__(self) -> int:
        """Number of touches."""
        return len(self.strength)

    def __iter__(self) -> Iterator[TouchEstimate]:
        """Each touch, strongest first."""
        rows = np.column_stack([self.place, self.force, self.deviation, self.strength])
        return (TouchEstimate(*row) for row in rows.tolist())

    @property
    def triples(self) -> tuple[TouchEstimate, ...]:
        """(x [m], y [m], strength) of each."""
        return tuple(self)


@old_names(joined="concatenate", of="from_arrays", touched="is_touched")
@dataclass(frozen=True, slots=True, eq=False)
class Predictions:
    """Predictions of a method for n frames; `Method.targets` shows which it estimates.

    Attributes:
        probabilities: probabilities of the three states, in the order of `State` (n, 3); NaN for a
            state that is not distinguished.
        bend_angle_deg: (n,) [deg]; NaN where the method does not estimate it.
        bend_deviation_deg: standard error of the angle (n,) [deg]; NaN where the method does not
            estimate it.
        touch_map: (n, rows, columns), 0 to 1; zero in frames that are not touched, NaN where the
            method does not estimate touches; no pixels for a method without a map.
        touches: touches of each frame; none where the method does not estimate touches.
        problems: problems of each frame, reasons to doubt its predictions, in words.

    Example:
        >>> from eitskin import Pipeline
        >>> from eitskin.training import Predictions
        >>> layout = Pipeline.load("reference.eitmodel").layout
        >>> Predictions.from_arrays(2, layout, bend_angle_deg=[0.0, 10.0]).bend_angle_deg
        array([ 0., 10.])
    """

    probabilities: Array
    bend_angle_deg: Array
    bend_deviation_deg: Array
    touch_map: NDArray[np.float32]
    touches: tuple[FoundTouches, ...]
    problems: tuple[tuple[str, ...], ...]

    @classmethod
    def from_arrays(
        cls,
        count: int,
        spec: InputSpec,
        *,
        probabilities: ArrayLike | None = None,
        bend_angle_deg: ArrayLike | None = None,
        places: ArrayLike | None = None,
        strength: ArrayLike | None = None,
        force: ArrayLike | None = None,
        radius: float = NOMINAL_RADIUS,
    ) -> "Predictions":
        """Predictions from tables of numbers; what is not given is not estimated.

        Frames whose most probable state is not touch have no touches. The touch map shows a disc
        at every touch.

        Args:
            count: number of frames n.
            spec: sensor, whose outline and pixels the map has.
            probabilities: probabilities of the three states (n, 3).
            bend_angle_deg: (n,) [deg].
            places: positions x and y of up to N touches (n, N, 2) [m]; NaN where fewer.
            strength: 0 to 1, (n, N); 1 when omitted.
            force: (n, N) [N].
            radius: radius of the discs in the map [m].
        """
        require_count("count", count, 0, 1 << 20)
        unknown = np.full(count, np.nan)
        state = np.full((count, len(State)), np.nan)
        if probabilities is not None:
            state = np.asarray(probabilities, dtype=float)
        angle = unknown if bend_angle_deg is None else np.asarray(bend_angle_deg, dtype=float)
        none = FoundTouches.from_arrays((), ())
        predictions = cls(
            state,
            angle,
            unknown,
            np.full((count, *spec.pixels), np.nan, np.float32),
            (none,) * count,
            ((),) * count,
        )
        if places is None:
            return predictions
        xy = np.array(places, dtype=float)
        require_axes("places", xy, count, None, 2, more=False)
        if probabilities is not None:
            xy[most_probable(state) != State.TOUCH] = np.nan
        there = np.isfinite(xy).all(axis=2)
        size = np.ones(there.shape) if strength is None else np.asarray(strength, dtype=float)
        newton = np.full(there.shape, np.nan) if force is None else np.asarray(force, dtype=float)
        for name, values in (("strength", size), ("force", newton)):
            require_axes(name, values, *there.shape, more=False)
        discs = np.where(there, radius, np.nan)
        x, y = (np.where(there, xy[..., axis], np.nan) for axis in (0, 1))
        return replace(
            predictions,
            touch_map=touch_maps(x, y, discs, spec.outline, spec.pixels),
            touches=tuple(
                FoundTouches.from_arrays(xy[row, mine], size[row, mine], newton[row, mine])
                for row, mine in enumerate(there)
            ),
        )

    @classmethod
    def concatenate(cls, parts: "Sequence[Predictions]") -> "Predictions":
        """Concatenate the frames of all parts, at least one, in their order."""
        if not parts:
            raise ConfigurationError("parts: expected at least one, got none")
        if len(parts) == 1:
            return parts[0]
        joined = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("probabilities", "bend_angle_deg", "bend_deviation_deg", "touch_map")
        }
        touches = tuple(touches for part in parts for touches in part.touches)
        return cls(**joined, touches=touches, problems=sum((p.problems for p in parts), ()))

    @property
    def state(self) -> NDArray[np.int64]:
        """The most probable `State` of each frame (n,); `UNKNOWN_STATE` where none is estimated."""
        return most_probable(self.probabilities)

    def is_touched(self, targets: Targets) -> bool:
        """Whether the first frame is touched: by its state, or by its touches without states."""
        if targets.states or not targets.touches:
            return int(self.state[0]) == State.TOUCH
        return len(self.touches[0]) > 0

    def faults(self, targets: Targets, count: int, pixels: tuple[int, int]) -> Iterator[str]:
        """Differences, in words, from what a method with these `targets` gives for n frames.

        Args:
            targets: quantities that the method says it estimates.
            count: number of frames n.
            pixels: rows and columns of touch maps.
        """
        shapes: dict[str, tuple[int, ...]] = {
            "probabilities": (count, len(State)),
            "bend_angle_deg": (count,),
            "bend_deviation_deg": (count,),
            "touch_map": (count, *pixels),
        }
        for name, expected in shapes.items():
            if np.shape(getattr(self, name)) != expected:
                yield f"{name} of shape {np.shape(getattr(self, name))}, expected {expected}"
                return
        if not len(self.touches) == len(self.problems) == count:
            yield f"touches of {len(self.touches)} frames, expected those of {count}"
        told_apart = np.array([name in targets.states for name in STATE_NAMES])
        finite = np.isfinite(self.probabilities)
        if not (finite == told_apart).all():
            yield (
                "probabilities that are not finite for the states that targets names "
                f"({', '.join(targets.states) or 'none'}), and NaN for all others"
            )
        elif targets.states:
            p = self.probabilities[:, told_apart]
            if p.min() < 0.0 or np.abs(p.sum(axis=1) - 1.0).max() > PROBABILITY_ERROR:
                yield "probabilities that are negative or do not add up to 1"
        if not (np.isfinite(self.bend_angle_deg) == targets.angle).all():
            expected_text = "finite" if targets.angle else "NaN"
            yield f"bend angles that are not {expected_text}, as targets has them"
        if not targets.touches and any(map(len, self.touches)):
            yield "touches, which targets does not have"


Perceived = Predictions
"""Name of `Predictions` in version 0.1."""


class Zero(StrEnum):
    """State of the sensor that estimates are relative to.

    Example:
        >>> from eitskin.training import Zero
        >>> str(Zero.MOUNTED)
        'as mounted'
    """

    FIRST_FRAMES = "first frames"
    FLAT = "flat"
    MOUNTED = "as mounted"


@old_names(of="from_predictions", of_unknown_start="for_unknown_start")
@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """State, bend angle and touches of one frame; None where a pipeline does not estimate them.

    Attributes:
        state: idle, touch or bend; touch for a bent sensor that is touched.
        probabilities: probabilities of the three states, in the order of `State`, (3,); NaN for a
            state that the pipeline does not show apart.
        bend_angle_deg: bend angle [deg], positive convex on the touched side; in a touched frame
            the paper's method gives the angle just before the touch.
        bend_deviation_deg: standard error of the angle [deg]; None for a method without one.
        touch_map: estimated share of each pixel that is touched, (rows, columns), 0 to 1; rows
            and columns grow with y and x. Zero unless the state is touch.
        touches: strongest first, with forces and standard errors where the method gives them.
        problems: faults of the frame or the references, in words; empty without any.
        number: number of the frame.
        time: time of the frame [s].
        zero: state of the sensor that angle and touches are relative to.

    Example:
        >>> from eitskin import Pipeline, Scene, SensorDesign, Simulator
        >>> frame = Simulator(SensorDesign.reference(), "coarse").measure(Scene())
        >>> estimate = Pipeline.load("reference.eitmodel").process(frame)
        >>> estimate.state.name, len(estimate.touches)
        ('IDLE', 0)
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
    def from_predictions(
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
            _number_or_none(predictions.bend_angle_deg[0]),
            _number_or_none(predictions.bend_deviation_deg[0]),
            predictions.touch_map[0] if targets.touches and predictions.touch_map.size else None,
            tuple(predictions.touches[0]) if targets.touches else None,
            problems,
            frame.number,
            frame.time,
            zero,
        )

    def for_unknown_start(self) -> "Estimate":
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
        return FoundTouches.from_arrays([t[:2] for t in self.touches], strength, force, deviation)


def _number_or_none(value: float) -> float | None:
    """`value`, None where it is not a number."""
    return float(value) if math.isfinite(value) else None
