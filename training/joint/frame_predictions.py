"""States that follow from a fit, scales of standard errors, and warnings in words."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial.distance import pdist
from scipy.special import ndtr

from eitskin.datasets.store.schema import State
from eitskin.errors import DataError
from eitskin.training.joint.model_selection import REPORTED_SIGMA, TOUCHED_SIGMA, FrameFit
from eitskin.training.joint.objective import TOUCH_THRESHOLD, misfit_sigma
from eitskin.training.joint.specimen_model import AngleEstimate
from eitskin.training.joint.touch_response import MAX_TOUCHES
from eitskin.training.method.predictions import FoundTouches

# spread of log ratios of two sessions of a sensor; paths have an error by 0.4 %
SPECIMEN_SPREAD = 0.008
Array = NDArray[np.float64]

# Decrease of the misfit by a touch: 1.4 % of idle frames in `bench life` exceed it, 4.2 % exceed 12
FAINT_GAIN = 14.0
FLAT_DEVIATIONS, WIDE_DEG = 2.0, 4.0  # a bend below these, of a standard error above, may be none
OUTSIDE_DEG = 1.5  # beyond the angles learned, from which a bend curve shows a larger bend
DECIDED = 2.0  # least difference of evidence from its threshold, where a fit decides on touches

PRIOR_TOUCHES = 4  # touches with errors as stated, that count next to the known ones
MATCH_RADIUS = 0.015  # m, within which a found touch is a known one
ROUNDS = 5  # of weighted least squares
STRANGEST = 3.0  # mean square of features, beyond which too few specimens show how errors grow

BLUR = 9.0  # standard errors beyond which 1 - Phi is one to the last digit


def fit_problems(
    fit: FrameFit,
    bend: AngleEstimate,
    bends: tuple[float, float] | None,
    touches: bool,
    chances: Array,
) -> tuple[str, ...]:
    """Warnings about one frame, by the probabilities of its states too.

    Whether `touches` were learned: else the poor fit of the angle says all there is to say. Further
    arguments are those of `state_probabilities`.
    """
    problems = [
        f"{fault.name} and was left out: look at its contact and wire" for fault in fit.faults
    ]
    problems += [
        f"{fault.name} since the session began and was left out of the angle: begin a new "
        "session with the flat sensor"
        for fault in bend.faults
    ]
    if rival := fit.rival or (bend.rival if not len(fit.touches) else ""):
        other = "there are touches" if fit.rival else "the sensor is bent"
        problems.append(
            f"{rival}, or {other}, both of which explain this frame: do not rely "
            "on it, and look at contacts and wires"
        )
    if bend.misfit_sigma > REPORTED_SIGMA:
        problems.append(
            f"no angle explains this frame ({bend.misfit_sigma:.0f} standard deviations off): do "
            "not rely on it, and begin a new session with the flat sensor"
        )
    uncertain = bend.deviation_deg > max(WIDE_DEG, abs(bend.angle_deg) / FLAT_DEVIATIONS)
    if uncertain and np.nanargmax(chances) == State.BEND:
        problems.append("the sensor may be flat, as far as this frame shows: do not rely on a bend")
    count = len(fit.touches)
    unexplained = misfit_sigma(fit.misfit, fit.degrees_of_freedom) >= TOUCHED_SIGMA[count]
    if bends is not None and _is_outside(bend, bends, touches and unexplained):
        problems.append(
            f"the sensor may be bent beyond {bends[0]:.0f} to {bends[1]:.0f} deg, the angles "
            "learned: do not rely on its angle"
        )
    if not touches:
        return tuple(problems)
    if unexplained:
        problems.append(
            f"no bend and up to {MAX_TOUCHES} touches explain this frame (misfit "
            f"{fit.misfit:.0f}, expected about {fit.degrees_of_freedom}): touches of another "
            "kind, a bad contact, or a reference that is out of date; do not rely on its touches"
        )
    elif not count and fit.faint > FAINT_GAIN:
        problems.append("something may touch, too faintly to distinguish from noise in this frame")
    elif count and (
        fit.wide
        or (
            count > 2
            and np.sum(pdist(fit.touches[:, :2]) < fit.estimate.objective.prior.separation) > 1
        )
    ):
        middle = fit.wide.centre if fit.wide else fit.touches[:, :2].mean(axis=0)
        x, y = 1e3 * middle
        size = f" of {1e3 * fit.wide.length:.0f} mm" if fit.wide else ""
        problems.append(
            f"more than {count} touches may explain this frame better, or a large contact{size} "
            f"about ({x:.0f}, {y:.0f}) mm: do not rely on their number and places"
        )
    return tuple(problems)


def _is_outside(bend: AngleEstimate, bends: tuple[float, float], unexplained: bool) -> bool:
    """Whether a bend may be outside of the range of angles learned [deg].

    It is near the end of the range, and beyond that by its curve alone, or nothing explains it.
    """
    end, side = (bends[1], 1.0) if bend.angle_deg > 0.0 else (bends[0], -1.0)
    over, curve_over = side * (bend.angle_deg - end), side * (bend.from_flat[0] - end)
    near = over > -FLAT_DEVIATIONS * bend.deviation_deg
    return near and (unexplained or curve_over > OUTSIDE_DEG)


def calibration_problems(
    flat: NDArray[np.float64], calibrated: NDArray[np.float64] | None
) -> tuple[str, ...]:
    """Warning for a sensor that is not the calibrated one; empty otherwise.

    Args:
        flat: magnitudes of the flat, untouched sensor (C,) [ohm].
        calibrated: values of the calibrated sensor; None where no sensor was.
    """
    if calibrated is None:
        return ()
    spread = float(np.nanstd(np.log(flat / calibrated)))
    if spread < SPECIMEN_SPREAD:
        return ()
    return (
        f"the flat sensor differs by {spread:.1%} from the one that this pipeline was calibrated "
        f"for (up to {SPECIMEN_SPREAD:.1%} are expected): calibrate again, or use the pipeline "
        "that was not calibrated",
    )


def state_probabilities(
    fit: FrameFit, bend: AngleEstimate, bends: tuple[float, float] | None, touches: bool
) -> Array:
    """Probabilities of idle, touch and bend (3,); NaN for touch or bend where not learned.

    Touch follows from the evidence of the first touch. Flat or bent by an angle uniform over those
    learned follows from Bayes' rule for one normal measurement: that by the bend curve, which meets
    zero exactly, where there is one.

    Args:
        fit: fit of the frame.
        bend: angle of the sensor, if it is untouched.
        bends: range of the angles learned [deg]; None where no bend was learned.
        touches: whether touches were learned.
    """
    # A rejected touch must not make touch the most probable state, nor one that stayed another.
    limits = (DECIDED, 60.0) if len(fit.touches) else (-60.0, -DECIDED)
    touched = 1.0 / (1.0 + np.exp(-0.5 * np.clip(fit.evidence - TOUCH_THRESHOLD, *limits)))
    if bends is None:
        return np.array([1 - touched, touched, np.nan])
    angle_deg, deviation_deg = bend.from_flat
    bent = deviation_deg * np.sqrt(2 * np.pi) / (bends[1] - bends[0])
    bent *= np.exp(np.minimum(0.5 * (angle_deg / deviation_deg) ** 2, 700.0))
    flat = 1.0 / (1.0 + bent)
    if not touches:
        return np.array([flat, np.nan, 1 - flat])
    return np.array([(1 - touched) * flat, touched, (1 - touched) * (1 - flat)])


def disc_map(
    places: Array,
    deviations: Array,
    radius: float,
    size: tuple[float, float],
    shape: tuple[int, int],
) -> NDArray[np.float32]:
    """Probability of each pixel's centre to lie under an indenter (rows, columns), 0 to 1.

    A centre at distance d from a touch lies under its disc with probability Phi((radius - d) / s),
    where s is the standard error of the position along one axis. That is exact for a straight edge,
    and s is small next to the radius wherever the map is of use.

    Args:
        places: positions of the touches (k, 2) [m].
        deviations: standard errors along one axis (k,) [m].
        radius: radius of the indenters [m].
        size: length and width of the sensor [m].
        shape: rows along y, columns along x.
    """
    rows, columns = shape
    x = (np.arange(columns) + 0.5) * size[0] / columns
    y = (np.arange(rows) + 0.5) * size[1] / rows
    free = np.ones(shape)
    deviations = np.maximum(deviations, 1e-6)
    for (px, py), deviation in zip(places.tolist(), deviations.tolist(), strict=True):
        reach = radius + BLUR * deviation
        across = slice(*np.searchsorted(x, [px - reach, px + reach]))
        along = slice(*np.searchsorted(y, [py - reach, py + reach]))
        distance = np.hypot(x[across] - px, y[along, None] - py)
        free[along, across] *= 1.0 - ndtr((radius - distance) / deviation)
    return (1.0 - free).astype(np.float32)


@dataclass(frozen=True, slots=True)
class ErrorScale:
    """Factor of the standard errors of places, which grows with how strange a sensor is.

    Errors of the response are not as independent as the fit takes them to be, and they are larger
    for sensors far from the middle of those that it was learned from.

    Attributes:
        usual: square of the factor in the middle of the training specimens; one at least where it
            is learned, as known touches are means of several frames, which noise disturbs less.
        strange: its growth with the mean square of a sensor's features, up to `STRANGEST`.
    """

    usual: float = 1.0
    strange: float = 0.0

    @classmethod
    def fit(
        cls, touches: Array, estimates: Sequence[FoundTouches], features: Array
    ) -> "ErrorScale":
        """Learn from the errors of known touches of many sensors.

        The squares of error over standard error are fitted by iterated least squares, in the metric
        of squares of normal errors, whose standard deviation goes with their mean (McCullagh and
        Nelder 1989). Where no touch was found the scale is one.

        Args:
            touches: x [m] and y [m] of n frames (n, k, 2 or more); NaN where absent.
            estimates: touches of each frame, with standard errors that are not scaled.
            features: features of the sensor of each frame (n, P).
        """
        pairs = zip(touches, estimates, strict=True)
        squares = [_squares(true_places, estimates) for true_places, estimates in pairs]
        frame = np.repeat(np.arange(len(squares)), [len(square) for square in squares])
        ratio = np.concatenate([np.zeros(0), *squares])
        if not len(ratio):
            return cls()
        columns = np.column_stack([np.ones(len(ratio)), _strangeness(features)[frame]])
        columns = np.concatenate([columns, np.tile([1.0, 0.0], (PRIOR_TOUCHES, 1))])
        ratio = np.concatenate([ratio, np.ones(PRIOR_TOUCHES)])
        fitted = np.full(len(ratio), np.mean(ratio))
        for _ in range(ROUNDS):
            more, strange = nnls(columns / fitted[:, None], (ratio - 1.0) / fitted)[0].tolist()
            fitted = 1.0 + columns @ [more, strange]
        return cls(1.0 + more, strange)

    @classmethod
    def from_stored(cls, stored: NDArray[Any]) -> "ErrorScale":
        """Scale that a pipeline stores; those of version 0.1 have one for all sensors."""
        values = stored.astype(float)
        if values.shape not in {(), (2,)} or not np.all((values >= 0) & (values < 1e6)):
            raise DataError("expected two factors of standard errors, 0 to 1e6; train it again")
        return cls(*values.tolist()) if values.ndim else cls(float(values) ** 2)

    def evaluate(self, features: Array) -> float:
        """Factor for a sensor with features (P,)."""
        return float(np.sqrt(self.usual + self.strange * _strangeness(features)))


def own_error_scale(touches: Array, estimates: Sequence[FoundTouches]) -> float:
    """Factor of the standard errors of places on one sensor, from the errors of known touches.

    Root mean square of error over stated standard error of the touches that were found; a few
    touches with errors as stated count next to them, so that one touch does not show all.

    Args:
        touches: x [m] and y [m] of those known, and more (n, k, 2 or more); NaN where absent.
        estimates: touches of each frame, with standard errors before.
    """
    pairs = zip(touches, estimates, strict=True)
    squares = np.concatenate([np.zeros(0), *(_squares(places, said) for places, said in pairs)])
    total = PRIOR_TOUCHES + float(squares.sum())
    return float(np.sqrt(total / (PRIOR_TOUCHES + len(squares))))


def _squares(touches: Array, said: FoundTouches) -> list[float]:
    """Squares of error over standard error of the known touches of one frame that were found."""
    squares = []
    for place in touches[np.isfinite(touches[:, 0]), :2]:
        away = np.linalg.norm(said.place - place, axis=1)
        if len(away) and away.min() <= MATCH_RADIUS:
            squares.append(float(away.min() / said.deviation[away.argmin()]) ** 2)
    return squares


def _strangeness(features: Array) -> Array:
    """Mean square (...) of features (..., P), at most `STRANGEST`; 0 without any."""
    square = np.sum(np.square(features), axis=-1) / max(features.shape[-1], 1)
    return np.asarray(np.minimum(square, STRANGEST))
