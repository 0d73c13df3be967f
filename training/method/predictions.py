"""Output of a perception method: state, bend angle, touches and touch map of n frames."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.datasets.store.schema import State
from eitskin.datasets.store.touch_map import touch_maps
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


@dataclass(frozen=True, slots=True, eq=False)
class FoundTouches:
    """The k touches of one frame, strongest first.

    Attributes:
        place: x and y in coordinates of the flat sensor (k, 2) [m].
        strength: confidence or relative strength, 0 to 1, (k,).
        force: (k,) [N]; NaN where the method does not estimate it.
        deviation: standard error of the position, sqrt(var x + var y), (k,) [m]; NaN where the
            method does not estimate it.
    """

    place: Array
    strength: Array
    force: Array
    deviation: Array

    @classmethod
    def of(
        cls,
        place: ArrayLike,
        strength: ArrayLike,
        force: ArrayLike | None = None,
        deviation: ArrayLike | None = None,
    ) -> "FoundTouches":
        """Sort touches by strength; force and deviation are NaN where not given."""
        size = np.asarray(strength, dtype=float).reshape(-1)
        order = np.argsort(-size, kind="stable")

        def sorted_or_unknown(values: ArrayLike | None) -> Array:
            if values is None:
                return np.full(len(size), np.nan)
            return np.asarray(values, dtype=float).reshape(-1)[order]

        return cls(
            np.asarray(place, dtype=float).reshape(-1, 2)[order],
            size[order],
            sorted_or_unknown(force),
            sorted_or_unknown(deviation),
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


@dataclass(frozen=True, slots=True, eq=False)
class Predictions:
    """Predictions of a method for n frames; `Method.targets` tells which it estimates.

    Attributes:
        probabilities: of the three states, in the order of `State` (n, 3); NaN for a state that is
            not told apart.
        bend_angle_deg: (n,) [deg]; NaN where the method does not estimate it.
        bend_deviation_deg: standard error of the angle (n,) [deg]; NaN where the method does not
            estimate it.
        touch_map: (n, rows, columns), 0 to 1; zero in frames that are not touched, NaN where the
            method does not estimate touches.
        touches: of each frame; none where the method does not estimate touches.
        problems: of each frame, reasons to doubt its predictions, in words.
    """

    probabilities: Array
    bend_angle_deg: Array
    bend_deviation_deg: Array
    touch_map: NDArray[np.float32]
    touches: tuple[FoundTouches, ...]
    problems: tuple[tuple[str, ...], ...]

    @classmethod
    def of(
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
            probabilities: of the three states (n, 3).
            bend_angle_deg: (n,) [deg].
            places: x and y of up to N touches (n, N, 2) [m]; NaN where there are fewer.
            strength: 0 to 1, (n, N); 1 when omitted.
            force: (n, N) [N].
            radius: of the discs in the map [m].
        """
        unknown = np.full(count, np.nan)
        state = np.full((count, len(State)), np.nan)
        if probabilities is not None:
            state = np.asarray(probabilities, dtype=float)
        angle = unknown if bend_angle_deg is None else np.asarray(bend_angle_deg, dtype=float)
        none = FoundTouches.of((), ())
        said = cls(
            state,
            angle,
            unknown,
            np.full((count, *spec.pixels), np.nan, np.float32),
            (none,) * count,
            ((),) * count,
        )
        if places is None:
            return said
        xy = np.array(places, dtype=float).reshape(count, -1, 2)
        if probabilities is not None:
            xy[most_probable(state) != State.TOUCH] = np.nan
        there = np.isfinite(xy).all(axis=2)
        size = np.ones(there.shape) if strength is None else np.asarray(strength, dtype=float)
        newton = np.full(there.shape, np.nan) if force is None else np.asarray(force, dtype=float)
        discs = np.where(there, radius, np.nan)
        x, y = (np.where(there, xy[..., axis], np.nan) for axis in (0, 1))
        return replace(
            said,
            touch_map=touch_maps(x, y, discs, spec.outline, spec.pixels),
            touches=tuple(
                FoundTouches.of(xy[row, mine], size[row, mine], newton[row, mine])
                for row, mine in enumerate(there)
            ),
        )

    @classmethod
    def joined(cls, parts: "Sequence[Predictions]") -> "Predictions":
        """Concatenate the frames of all parts, in their order."""
        return cls(
            np.concatenate([part.probabilities for part in parts]),
            np.concatenate([part.bend_angle_deg for part in parts]),
            np.concatenate([part.bend_deviation_deg for part in parts]),
            np.concatenate([part.touch_map for part in parts]),
            tuple(touches for part in parts for touches in part.touches),
            tuple(problems for part in parts for problems in part.problems),
        )

    @property
    def state(self) -> NDArray[np.int64]:
        """The most probable `State` of each frame (n,); `UNKNOWN_STATE` where none is estimated."""
        return most_probable(self.probabilities)

    def touched(self, targets: Targets) -> bool:
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
        known = np.isfinite(self.probabilities)
        if not (known == told_apart).all():
            yield (
                "probabilities that are not finite for the states that targets names "
                f"({', '.join(targets.states) or 'none'}), and NaN for all others"
            )
        elif targets.states:
            p = self.probabilities[:, told_apart]
            if p.min() < 0.0 or np.abs(p.sum(axis=1) - 1.0).max() > PROBABILITY_ERROR:
                yield "probabilities that are negative or do not add up to 1"
        if not (np.isfinite(self.bend_angle_deg) == targets.angle).all():
            wanted = "finite" if targets.angle else "NaN"
            yield f"bend angles that are not {wanted}, as targets has them"
        if not targets.touches and any(map(len, self.touches)):
            yield "touches, which targets does not have"


Perceived = Predictions
"""Name of `Predictions` in version 0.1."""
