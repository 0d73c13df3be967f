"""Output of a perception method: state, bend angle, touches and touch map of n frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.training.method.targets import most_probable

Array = NDArray[np.float64]


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

    @property
    def triples(self) -> tuple[tuple[float, float, float], ...]:
        """(x [m], y [m], strength) of each."""
        rows = zip(self.place.tolist(), self.strength.tolist(), strict=True)
        return tuple((x, y, strength) for (x, y), strength in rows)


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


Perceived = Predictions
"""Name of `Predictions` in version 0.1."""
