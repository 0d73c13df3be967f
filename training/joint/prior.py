"""Prior of touches and of the bend angle, as terms of the least-squares objective.

Training estimates a `TouchPrior` from the touches of its dataset (`TouchPrior.fit`); a saved
pipeline keeps it in the arrays `bounds` and `scalars`. The constants below hold for every pipeline.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.floating]

MOST_TOUCHES = 4  # in one frame
ANGLE_PRIOR_STD_DEG = 15.0  # standard deviation of the motion since the reference was taken
ANGLE_UNIT = 5.0  # deg, the unit step of the angle
TOUCH_UNITS = np.array([0.010, 0.010, 2.0])  # m, m, N, the unit steps of x, y and force
MARGIN = 0.003  # m, by which touches may lie outside of the positions trained with
FORCE_MARGINS = (0.3, 1.3)  # times the smallest and the largest force trained with
SENSITIVITY_STD = 0.15  # relative; specimens respond more or less strongly to the same force


@dataclass(frozen=True, slots=True, eq=False)
class TouchPrior:
    """Prior distribution of position, force and mutual distance of touches.

    Positions are uniform within bounds; a normal distribution of the same variance keeps them
    determined. Forces are normal within bounds. Touches closer than `separation` repel each other.

    Attributes:
        separation: smallest distance of two simultaneous touches [m].
        force: mean and standard deviation [N].
        low, high: bounds of x, y [m] and force [N], (3,).
        mean: of x, y [m] and force [N], (3,); follows from the above.
        stiffness: inverse variances, in unit steps (3,); follows from the above.
    """

    separation: float
    force: tuple[float, float]
    low: Array
    high: Array
    mean: Array = field(init=False)
    stiffness: Array = field(init=False)
    box: Array = field(init=False, repr=False)  # mean, stiffness, low and high, for `fit_kernels`

    def __post_init__(self) -> None:
        """Derive mean and stiffness."""
        mean = 0.5 * (self.low + self.high)
        deviation = (self.high - self.low) / math.sqrt(12.0)
        mean[2], deviation[2] = self.force
        object.__setattr__(self, "mean", mean)
        stiffness = (TOUCH_UNITS / deviation) ** 2
        object.__setattr__(self, "stiffness", stiffness)
        object.__setattr__(self, "box", np.array([mean, stiffness, self.low, self.high]))

    @classmethod
    def fit(
        cls,
        x: Floats,
        y: Floats,
        force: Floats,
        outline: tuple[float, float],
        largest_radius: float,
    ) -> "TouchPrior":
        """Estimate the prior from the touches of n frames.

        Args:
            x: (n, k) [m]; NaN where absent, as are y and force.
            y: (n, k) [m].
            force: (n, k) [N].
            outline: length and width of the sensor [m].
            largest_radius: of the indenters [m]; touches keep its double apart where no frame has
                two touches.
        """
        length, width = outline
        low = [
            max(0.0, np.nanmin(x) - MARGIN),
            max(0.0, np.nanmin(y) - MARGIN),
            FORCE_MARGINS[0] * np.nanmin(force),
        ]
        high = [
            min(length, np.nanmax(x) + MARGIN),
            min(width, np.nanmax(y) + MARGIN),
            FORCE_MARGINS[1] * np.nanmax(force),
        ]
        distances = np.concatenate(
            [
                np.hypot(x[:, i] - x[:, j], y[:, i] - y[:, j])
                for i in range(x.shape[1])
                for j in range(i)
            ]
        )
        distances = distances[np.isfinite(distances)]
        separation = float(distances.min()) if len(distances) else 2 * largest_radius
        mean = float(np.nanmean(force))
        deviation = float(np.hypot(np.nanstd(force), SENSITIVITY_STD * mean))
        return cls(
            separation, (mean, deviation), np.array(low, dtype=float), np.array(high, dtype=float)
        )

    @classmethod
    def anywhere(cls, outline: tuple[float, float], radius: float) -> "TouchPrior":
        """Prior of unit touches anywhere on a sensor, for a method that never saw one.

        Args:
            outline: length and width of the sensor [m].
            radius: of the indenters [m].
        """
        low, high = (0.0, 0.0, FORCE_MARGINS[0]), (*outline, FORCE_MARGINS[1])
        return cls(2 * radius, (1.0, SENSITIVITY_STD), np.array(low), np.array(high))
