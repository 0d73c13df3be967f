"""Standard errors of places beside the errors of known touches."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from eitskin.training.method.predictions import FoundTouches

Array = NDArray[np.float64]

PRIOR_TOUCHES = 4  # touches with errors as stated, that count beside the known ones
NEAREST = 0.015  # m, within which a found touch is a known one
ROUNDS = 5  # of weighted least squares
STRANGEST = 3.0  # mean square of features, beyond which too few specimens tell how errors grow


@dataclass(frozen=True, slots=True)
class ErrorScale:
    """Factor of the standard errors of places, which grows with how strange a sensor is.

    Errors of the response are not as independent as the fit takes them to be, and they are larger
    for sensors far from the middle of those that it was learned from.

    Attributes:
        usual: square of the factor in the middle of the training specimens.
        strange: its growth with the mean square of a sensor's features, up to `STRANGEST`.
    """

    usual: float = 1.0
    strange: float = 0.0

    @classmethod
    def fit(cls, touches: Array, found: Sequence[FoundTouches], features: Array) -> "ErrorScale":
        """Learn from the errors of known touches of many sensors.

        The squares of error over standard error are fitted by iterated least squares, in the metric
        of squares of normal errors, whose standard deviation goes with their mean (McCullagh and
        Nelder 1989). Where no touch was found the scale is one.

        Args:
            touches: x [m] and y [m] of n frames (n, k, 2 or more); NaN where absent.
            found: touches of each frame, with standard errors that are not scaled.
            features: of the sensor of each frame (n, P).
        """
        pairs = zip(touches, found, strict=True)
        squares = [_squares(known, said) for known, said in pairs]
        frame = np.repeat(np.arange(len(squares)), [len(each) for each in squares])
        ratio = np.concatenate([np.zeros(0), *squares])
        if not len(ratio):
            return cls()
        columns = np.column_stack([np.ones(len(ratio)), _strangeness(features)[frame]])
        # Keeps the scale of a sensor in the middle above zero.
        columns = np.concatenate([columns, np.tile([1.0, 0.0], (PRIOR_TOUCHES, 1))])
        ratio = np.concatenate([ratio, np.ones(PRIOR_TOUCHES)])
        fitted = np.full(len(ratio), np.mean(ratio))
        for _ in range(ROUNDS):
            usual, strange = nnls(columns / fitted[:, None], ratio / fitted)[0].tolist()
            fitted = columns @ [usual, strange]
        return cls(usual, strange)

    def of(self, features: Array) -> float:
        """Factor for a sensor with features (P,)."""
        return float(np.sqrt(self.usual + self.strange * _strangeness(features)))


def own_error_scale(touches: Array, found: Sequence[FoundTouches]) -> float:
    """Factor of the standard errors of places on one sensor, from the errors of known touches.

    Root mean square of error over stated standard error of the touches that were found; a few
    touches with errors as stated count beside them, so that one touch does not tell all.

    Args:
        touches: x [m] and y [m] of those known, and more (n, k, 2 or more); NaN where absent.
        found: touches of each frame, with standard errors before.
    """
    pairs = zip(touches, found, strict=True)
    squares = np.concatenate([np.zeros(0), *(_squares(known, said) for known, said in pairs)])
    total = PRIOR_TOUCHES + float(squares.sum())
    return float(np.sqrt(total / (PRIOR_TOUCHES + len(squares))))


def _squares(touches: Array, said: FoundTouches) -> list[float]:
    """Squares of error over standard error of the known touches of one frame that were found."""
    squares = []
    for place in touches[np.isfinite(touches[:, 0]), :2]:
        away = np.linalg.norm(said.place - place, axis=1)
        if len(away) and away.min() <= NEAREST:
            squares.append(float(away.min() / said.deviation[away.argmin()]) ** 2)
    return squares


def _strangeness(features: Array) -> Array:
    """Mean square (...) of features (..., P), at most `STRANGEST`; 0 without any."""
    square = np.sum(np.square(features), axis=-1) / max(features.shape[-1], 1)
    return np.asarray(np.minimum(square, STRANGEST))
