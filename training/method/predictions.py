"""What a pipeline's method says of frames, whichever method it is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class FoundTouches:
    """The k touches of one frame, strongest first.

    Attributes:
        place: x and y in coordinates of the flat sensor (k, 2) [m].
        strength: how sure or how strong, 0 to 1, (k,).
        force: (k,) [N]; NaN where the method does not say.
        deviation: standard error of the place, sqrt(var x + var y), (k,) [m]; NaN where the
            method does not say.
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
        """Touches in any order; what is left out is not known."""
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
        """How many."""
        return len(self.strength)

    @property
    def triples(self) -> tuple[tuple[float, float, float], ...]:
        """(x [m], y [m], strength) of each."""
        rows = zip(self.place.tolist(), self.strength.tolist(), strict=True)
        return tuple((x, y, strength) for (x, y), strength in rows)


NO_TOUCHES = FoundTouches.of((), ())


@dataclass(frozen=True, slots=True, eq=False)
class Perceived:
    """What a method says of n frames.

    Attributes:
        probabilities: of `State` (n, 3).
        bend_angle_deg: (n,) [deg].
        bend_deviation_deg: its standard error (n,) [deg]; NaN where the method does not say.
        touch_map: (n, rows, columns), 0 to 1; zero in frames that are not touched.
        touches: of each frame.
        problems: of each frame, in words; what makes its estimate doubtful.
    """

    probabilities: Array
    bend_angle_deg: Array
    bend_deviation_deg: Array
    touch_map: NDArray[np.float32]
    touches: tuple[FoundTouches, ...]
    problems: tuple[tuple[str, ...], ...]

    @classmethod
    def joined(cls, parts: "Sequence[Perceived]") -> "Perceived":
        """The frames of all parts, in their order."""
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
        """The most probable `State` of each frame (n,)."""
        state: NDArray[np.int64] = self.probabilities.argmax(axis=1)
        return state
