"""Adaptation of the joint method to one sensor: bend curve, noise and response to touches.

The posterior of the bend curve by Bayes' rule is that of the sensor's random effects, whose prior
was learned from the training specimens; hinge, layers and contacts act on it together. The response
gets a last layer of its own by presses on a twin, by known touches, or by both.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import DataError
from eitskin.simulator.instrument.drift import DRIFT_TIME
from eitskin.training.joint.bend_curve import BendCurve, BendCurvePrior, mixture_curve
from eitskin.training.joint.combinations import Combinations, CombinedChange, log_change
from eitskin.training.joint.frame_predictions import MATCH_RADIUS
from eitskin.training.joint.objective import whitening_matrix
from eitskin.training.joint.specimen_model import LOG_ODDS, angle_standard_error, estimate_angle
from eitskin.training.joint.touch_response import (
    LOG_STRENGTH_STD,
    MARGIN,
    SpecimenResponse,
    TouchPrior,
)
from eitskin.training.method.interface import Calibration, TwinTrial
from eitskin.training.method.known_frames import FLAT_DEG, KnownFrames, TwinPresses, held_numbers
from eitskin.training.method.observations import UNKNOWN_AGE
from eitskin.training.method.predictions import FoundTouches

Array = NDArray[np.float64]
Combined = Callable[[Array, float, float], CombinedChange]

STATED_ANGLES = 8  # at which standard errors are stated
MAX_MISFIT = 1.5  # of known angles: correct ones have 0.7 to 1, one of five off by ten degrees 6
MAX_SHARE, IMPOSSIBLE_MISFIT = 0.4, 50.0  # without the worst angle; of angles in radians 190
PRIOR_FRAMES = 1.0  # frames with noise as in training, that count next to the known ones
NOISE_SCALE = (0.5, 5.0)  # bounds of the noise relative to that of training
# Growth of the covariance of curves with how strange a sensor is among those learned from
# (`BendCurvePrior.predict_widened`). The usual ones were learned from sensors that differ by a
# tenth as much, so that any other is strange among them.
WIDENING, USUAL_WIDENING = 1.0, 0.2

FLAT_PRESSES, BENT_PRESSES = 240, 30  # on the flat twin, and at each of some bends
BENDS = 3
MISMATCH = 0.05  # error of each change relative to itself, next to the noise of a frame
LATENT_LEFT = 0.5  # of what latent variables describe: the twin shows the rest
RIDGE = 1e-5  # of the largest eigenvalue: combinations of features below are not resolved
FORCE_ERROR, UNKNOWN_FORCE = 0.05, 1.0  # standard deviation of a force, relative to it
PLACE_ERROR = 0.0003  # m, of known places
FORCE_UNITS, MIN_TOUCHES = 50.0, 3  # factor of a force in another unit; single touches to judge by
FORCE_CHANGE_LIMITS = (-0.5, 1.0)  # of an unknown force in one round, relative
SHARES = (1.0, 0.25, 0.06, 0.0)  # of the information of known touches, that are tried
ROUNDS = 3  # of finding latent variables and unknown forces in turn


def adapted_curve(
    curves: BendCurvePrior,
    usual: Sequence[BendCurvePrior],
    features: Array,
    known_frames: KnownFrames,
    combined: Combined,
    drift: float,
    noise_scale: float,
) -> tuple[BendCurve, Calibration]:
    """Bend curve of a sensor given untouched frames at known angles, which are taken to be exact.

    Its mean and covariance are those of the mixture of the posteriors of all priors. Errors before
    are those by the prior that is likeliest given the frames.

    Args:
        curves: prior of the curve of any sensor.
        usual: curves of one in each of the usual clamps.
        features: features of the sensor (P,).
        known_frames: untouched frames at known angles.
        combined: combinations of a change of log V (C,), given the sum of the reciprocal numbers of
            frames in both means that are compared, and the time between these [s].
        drift: standard deviation after `DRIFT_TIME` of the factor common to all measurements.
        noise_scale: noise of a frame relative to that in training.

    Raises DataError for angles that contradict each other, or any sensor learned from.
    """
    priors, odds = [curves.predict_widened(features, WIDENING)], [0.0]
    for each in usual:
        priors.append(each.predict_widened(features, USUAL_WIDENING))
        odds.append(LOG_ODDS)
    seen, static = known_frames.observations, log_change(known_frames.observations.static)
    # A measurement that is bad at one angle is left out of all: they share the flat frames.
    usable = np.where(np.isfinite(static).all(axis=0), static, np.nan)
    changes = [combined(each, 1.0, 0.0) for each in usable]
    # Frames drift together from their reference on. The times of those of one age, as in a dataset,
    # are unknown: what drift they share is not known either, and is taken to be none.
    age, count = seen.age, len(usable)
    others = (age[:, None] == age) & ~np.eye(count, dtype=bool)
    walk = np.where(others, 0.0, np.minimum(age[:, None], age)) / DRIFT_TIME * drift**2
    together = noise_scale**2 * (np.diag(seen.frames**-1) + 1.0 / seen.static_frames[0])
    combinations = changes[0].combinations
    shared, own = combinations.drift, combinations.restrict(changes[0].good)[1]
    noise = np.kron(together, own) + np.kron(walk, np.outer(shared, shared))
    bends = known_frames.angle_deg, np.array([change.change for change in changes]), noise
    _require_agreeing(priors, *bends)
    logs = np.add([curve.log_likelihood(*bends) for curve in priors], odds)
    shares = np.exp(logs - logs.max())
    curve = mixture_curve([prior.condition(*bends) for prior in priors], shares / shares.sum())
    share, residuals = 1.0 + 1.0 / float(seen.static_frames[0]), []
    for change, time, angle in zip(static, age.tolist(), known_frames.angle_deg, strict=True):
        frame = combined(change, share, time)
        residuals.append(estimate_angle(curve, frame.change, frame.noise)[0] - angle)
    before = priors[int(logs.argmax())]
    angles = np.linspace(*before.angle_deg, STATED_ANGLES).tolist()
    unknown = combined(np.zeros_like(static[0]), share, UNKNOWN_AGE).noise
    errors = [
        tuple(angle_standard_error(each, angle, unknown) for angle in angles)
        for each in (before, curve)
    ]
    residual = float(np.sqrt(np.mean(np.square(residuals))))
    return curve, Calibration(tuple(angles), errors[0], errors[1], residual)


def _require_agreeing(
    priors: list[BendCurve], angle_deg: Array, change: Array, noise: Array
) -> None:
    """Refuse an angle that all others contradict, or all; arguments as of `BendCurve.misfit`.

    A clamp unlike those learned from misfits as much with any of its angles left out.
    """
    misfit, curve = min(
        ((each.misfit(angle_deg, change, noise), each) for each in priors), key=itemgetter(0)
    )
    if misfit < MAX_MISFIT:
        return
    distinct, others = np.unique(angle_deg), list[float]()
    for angle in distinct:
        rows = angle_deg != angle
        parts = np.repeat(rows, change.shape[1])
        others.append(curve.misfit(angle_deg[rows], change[rows], noise[np.ix_(parts, parts)]))
    worst = int(np.argmin(others))
    if others[worst] > IMPOSSIBLE_MISFIT:
        raise DataError(
            f"the frames do not fit their angles: the misfit is {misfit:.2g}, expected up to "
            f"{MAX_MISFIT:g}; check that they are in degrees, not radians, and of this sensor"
        )
    if len(distinct) > 2 and others[worst] < MAX_SHARE * misfit:
        raise DataError(
            f"the frames at {distinct[worst]:g} deg contradict those at all other known angles: "
            f"the misfit is {misfit:.2g} with and {others[worst]:.2g} without them, expected up to "
            f"{MAX_MISFIT:g}; check that the sensor was bent by that angle, or leave them out"
        )


def noise_scale(frames: KnownFrames, combinations: Combinations) -> float:
    """Noise of a frame relative to that in training, from untouched frames of one angle.

    A frame with noise as in training counts next to them, so that few show little. Their
    differences count without the part that is common to all measurements, which drifts.
    """
    seen = frames.observations
    alike = np.abs(frames.reference_deg - frames.angle_deg) <= FLAT_DEG
    alike &= frames.told & ~frames.has_touches & (seen.dynamic != seen.static).any(axis=1)
    total = count = PRIOR_FRAMES * (len(combinations.noise) - 1.0)
    for row in np.flatnonzero(alike):
        white = log_change(seen.dynamic[row]) / combinations.noise
        white = white[np.isfinite(white)]
        size = 1.0 / seen.frames[row] + 1.0 / seen.dynamic_frames[row]
        total += float(np.sum((white - white.mean()) ** 2)) / size
        count += len(white) - 1.0
    return float(np.clip(np.sqrt(total / count), *NOISE_SCALE))


def own_output(
    learned: SpecimenResponse,
    prior: TouchPrior,
    radius: float,
    combinations: Combinations,
    twin: TwinPresses,
    bends: bool,
) -> Array:
    """Last layer (K, hidden + 1) with which the response is that of a twin.

    Ridge regression of what the learned response leaves of simulated single presses, spread evenly
    over places, forces and, with `bends`, angles that it was learned for. The layers before stay as
    learned. The radius of the indenters is in m. Raises the errors of `TwinPresses.changes`.
    """
    response, unit = learned.response, np.sqrt(2.0) * combinations.unit
    ranges = response.ranges
    angles = np.linspace(*ranges.angle_deg, BENDS) if bends else np.zeros(0)
    bounds = np.array([prior.low[:2] + MARGIN, prior.high[:2] - MARGIN])
    touches = _spread(bounds, ranges.force, FLAT_PRESSES + BENT_PRESSES * len(angles))
    touches = touches[twin.inside(touches[:, :2])]
    ends = len(touches) - BENT_PRESSES * np.arange(len(angles), -1, -1)
    groups = zip([0.0, *angles.tolist()], [0, *ends[:-1]], ends, strict=True)
    rows, residuals = [], []
    for angle_deg, first, last in groups:
        some = touches[first:last]
        change = twin.changes(some, angle_deg, radius) @ combinations.forward
        # A frame is compared with another one, and the response has an error in proportion to the
        # change.
        error = np.sqrt(np.mean((MISMATCH * change) ** 2 + unit**2, axis=1, keepdims=True))
        rows.append(response.hidden_output(some, angle_deg) / error)
        residuals.append((change - learned(some, angle_deg)) / error)
    inputs = np.concatenate(rows)
    gram = inputs.T @ inputs
    ridge = RIDGE * float(np.linalg.eigvalsh(gram)[-1])
    step = np.linalg.solve(gram + ridge * np.eye(len(gram)), inputs.T @ np.concatenate(residuals))
    output: Array = learned.output + step.T
    return output


def own_response(
    learned: SpecimenResponse, output: Array, latent_output: Array | None = None
) -> SpecimenResponse:
    """Response of a sensor with a last layer of its own (K, hidden + 1).

    And its derivatives by the latent variables (Q, K, hidden + 1): those that a twin leaves when
    omitted.
    """
    if latent_output is None:
        latent_output = LATENT_LEFT * learned.response.latent_output
    return SpecimenResponse(replace(learned.response, latent_output=latent_output), output)


def twin_trial(
    learned: SpecimenResponse, output: Array, touched: KnownFrames, combinations: Combinations
) -> TwinTrial:
    """Residuals of known touches by the learned response and by that with a twin's last layer."""
    if not len(touched):
        return TwinTrial(0)
    responses = (learned, own_response(learned, output))
    residuals = (_relative_residual(each, touched, combinations) for each in responses)
    return TwinTrial(len(touched), *residuals)


def _spread(bounds: Array, force: tuple[float, float], count: int) -> Array:
    """Touches (n, 3) spread evenly, by a Halton sequence, between bounds (2, 2) [m] and forces."""
    from scipy.stats import qmc  # takes half a second, which a live session has no use for

    low, high = (np.append(bounds[end], force[end]) for end in (0, 1))
    return np.asarray(low + (high - low) * qmc.Halton(3, seed=0).random(count))


def _relative_residual(
    response: SpecimenResponse, touched: KnownFrames, combinations: Combinations
) -> float:
    """Residual of a response in the changes of known touches, relative to these.

    Each frame has a strength of its own, by least squares, since forces are known less well than
    places, or not at all.
    """
    residual = size = 0.0
    for row, known_touch in enumerate(touched.touches):
        touches = known_touch[np.isfinite(known_touch[:, 0])]
        forces = touches[:, 2]
        touches[:, 2] = np.where(np.isfinite(forces), forces, response.response.ranges.middle_force)
        change = log_change(touched.observations.dynamic[row])
        angle_deg = np.nan_to_num(touched.reference_deg[row])
        modelled = response(touches, float(angle_deg)).sum(axis=0) @ combinations.back
        good = np.isfinite(change)
        change, modelled = change[good], modelled[good]
        strength = float(modelled @ change) / max(float(modelled @ modelled), 1e-300)
        residual += float(np.sum((change - strength * modelled) ** 2))
        size += float(change @ change)
    return float(np.sqrt(residual / size))


def require_plausible(
    touched: KnownFrames, estimates: Sequence[FoundTouches], force: float | None
) -> None:
    """Refuse known touches in other units, or of which most are found elsewhere or not at all.

    Args:
        touched: frames with known touches.
        estimates: touches that the adapted method finds in each.
        force: usual force [N]; None where forces do not count.
    """
    forces = touched.touches[np.isfinite(touched.touches[..., 2]), 2]
    if force and len(forces) and abs(math.log(np.median(forces) / force)) > math.log(FORCE_UNITS):
        raise DataError(
            f"expected forces of touches in newtons, about {force:.2g} N, got {np.median(forces):g}"
        )
    single = np.isfinite(touched.touches[..., 0]).sum(axis=1) == 1
    pairs = [
        (place, min(estimate.place, key=lambda other: math.dist(place, other)))
        for known, estimate, one in zip(touched.touches, estimates, single, strict=True)
        if one and len(estimate)
        for place in known[np.isfinite(known[:, 0]), :2]
    ]
    missed = sum(not len(estimate) for estimate, one in zip(estimates, single, strict=True) if one)
    away = np.array([math.dist(*pair) for pair in pairs])
    everywhere = np.append(away, np.full(missed, np.inf))
    elsewhere = len(everywhere) >= MIN_TOUCHES and np.median(everywhere) > MATCH_RADIUS
    if elsewhere and away.max(initial=0.0) > MATCH_RADIUS:
        (x, y), (u, v) = 1e3 * np.array(pairs[int(away.argmax())])
        raise DataError(
            f"most of the known touches are found elsewhere, such as that at ({x:.0f}, {y:.0f}) mm "
            f"at ({u:.0f}, {v:.0f}) mm; check the axes and the corner that positions count from, "
            "and the order of labels and electrodes"
        )


def response_given(
    prior: SpecimenResponse,
    touched: KnownFrames,
    combined: Combined,
    touches: TouchPrior,
    forces: bool,
) -> SpecimenResponse:
    """Response of a sensor given frames with known touches.

    A touch of a sensor of strength e^s, with latent variables q, changes

        y = e^s (g + L^T q) + errors,   s ~ N(0, LOG_STRENGTH_STD^2),   q ~ N(0, 1),

    which is linear in q, and nearly so in s. Their covariance grows by the misfit per degree of
    freedom where that is above one (Birge 1932): a response that explains the touches badly shows
    little of the sensor. Unknown forces are found with them. Errors that touches share are larger
    than the response has them, so the touches count by the share that lets them show each other
    best (`_trusted_share`).

    Args:
        prior: response before.
        touched: frames with touches at known places.
        combined: combinations as of `adapted_curve`.
        touches: prior of touches, which bounds forces.
        forces: whether known forces count.
    """
    observations, known = touched.observations, []
    for rows in _group_held_touches(touched):
        labels = touched.touches[rows[0]]
        places = labels[np.isfinite(labels[:, 0])]
        free = ~(np.isfinite(places[:, 2]) & forces)
        places[free, 2] = prior.response.ranges.middle_force
        share = 1.0 / observations.frames[rows].sum() + 1.0 / observations.dynamic_frames[rows[0]]
        age = float(observations.dynamic_age[rows].mean())
        change = combined(_mean_change(observations.dynamic[rows]), float(share), age)
        angle_deg = float(np.nan_to_num(touched.reference_deg[rows[0]]))
        known.append(KnownTouches(change, places, free, angle_deg))
    latent = prior.response.latent_output
    precision = np.diag(np.append(LOG_STRENGTH_STD**-2, np.ones(len(latent))))
    share = _trusted_share(precision, [each.regression(prior, prior, 1.0) for each in known])
    correction: Array = np.zeros(1 + len(latent))
    response, strength = prior, 1.0
    for _ in range(ROUNDS):
        told = [each.regression(prior, response, strength) for each in known]
        rows, left = (np.concatenate(parts, axis=-1) for parts in zip(*told, strict=True))
        information = precision + share * rows @ rows.T
        gradient = share * rows @ (left + correction @ rows)
        correction = np.asarray(np.linalg.solve(information, gradient), dtype=np.float64)
        for each, (_, own) in zip(known, told, strict=True):
            each.adjust_forces(own, touches)
        strength = float(np.exp(correction[0]))
        output = strength * (prior.output + np.tensordot(correction[1:], latent, axes=1))
        response = own_response(prior, output, latent)
    size = sum(each.seen.rank - int(each.free.sum()) for each in known)
    growth = max(share * float(left @ left) / max(size, 1), 1.0)
    spread = strength * np.linalg.cholesky(growth * np.linalg.inv(information)[1:, 1:])
    return own_response(prior, response.output, np.tensordot(spread.T, latent, axes=1))


def likeliest_response(
    priors: Sequence[SpecimenResponse],
    touched: KnownFrames,
    combinations: Combinations,
    combined: Combined,
    touches: TouchPrior,
    forces: bool,
) -> tuple[int, SpecimenResponse]:
    """Response given known touches that comes closest to them, and the number of the one before.

    The other arguments are those of `response_given`.
    """
    given = [response_given(each, touched, combined, touches, forces) for each in priors]
    residuals = [_relative_residual(each, touched, combinations) for each in given]
    best = int(np.argmin(residuals))
    return best, given[best]


def _group_held_touches(touched: KnownFrames) -> list[NDArray[np.intp]]:
    """Rows of frames in succession that see the same touches from the same reference."""
    places = touched.touches.reshape(len(touched), -1)
    numbers = held_numbers(np.column_stack([places, np.nan_to_num(touched.reference_deg)]))
    return np.split(np.arange(len(touched)), 1 + np.flatnonzero(np.diff(numbers)))


def _mean_change(dynamic: Array) -> Array:
    """Mean of log(V / reference) (C,) of frames dV (n, C); NaN where no frame has it."""
    changes = log_change(dynamic)
    good = np.isfinite(changes)
    total = np.where(good, changes, 0.0).sum(axis=0)
    return np.where(good.any(axis=0), total / np.maximum(good.sum(axis=0), 1), np.nan)


@dataclass(slots=True, eq=False)
class KnownTouches:
    """Known touches of one frame.

    Attributes:
        seen: combinations of the change by them.
        places: x [m], y [m] and force [N] of each (k, 3); of a free force a guess.
        free: whether each force is unknown (k,).
        angle_deg: angle of the bend [deg].
    """

    seen: CombinedChange
    places: Array
    free: NDArray[np.bool_]
    angle_deg: float
    _by_force: Array = field(init=False, repr=False)  # of `regression`: share of what is left

    def regression(
        self, prior: SpecimenResponse, now: SpecimenResponse, strength: float
    ) -> tuple[Array, Array]:
        """Regression of the touches on strength and latent variables, to first order, whitened.

        Errors are those of the noise, of the response, and of places and forces.

        Args:
            prior: response before.
            now: response about which it is linear.
            strength: strength of that next to the prior one.

        Returns:
            derivatives of the change by the unknowns (n, K).
            change that the response leaves of the measured one (K,).
        """
        changes = now.with_derivatives(self.places, self.angle_deg)
        errors = np.where(self.free, UNKNOWN_FORCE, FORCE_ERROR)[:, None]
        forward, back = self.seen.combinations.forward, self.seen.combinations.back
        variance = now.response.mismatch**2 * np.sum((changes[0] @ back) ** 2, axis=0)
        moved = np.concatenate([PLACE_ERROR * changes[1], PLACE_ERROR * changes[2]])
        moved = np.concatenate([moved, errors * changes[0]])
        covariance = self.seen.noise + forward.T * variance @ forward + moved.T @ moved
        whitening = whitening_matrix(covariance)
        latent_changes = strength * prior.latent_changes(self.places, self.angle_deg)
        rows = np.concatenate([changes[0].sum(axis=0)[None], latent_changes])
        self._by_force = errors**2 * (changes[0] @ whitening.T)
        return rows @ whitening.T, whitening @ (self.seen.change - changes[0].sum(axis=0))

    def adjust_forces(self, residuals: Array, touches: TouchPrior) -> None:
        """Change free forces, within bounds, as the change `residuals` by a `regression` asks."""
        more = np.clip(self._by_force @ residuals, *FORCE_CHANGE_LIMITS)
        force = np.clip(self.places[:, 2] * (1.0 + more), touches.low[2], touches.high[2])
        self.places[:, 2] = np.where(self.free, force, self.places[:, 2])


def _trusted_share(precision: Array, regressions: list[tuple[Array, Array]]) -> float:
    """Share of the information of touches by which the others show each of them best.

    From the precision of the unknowns (n, n) and regressions by the response before.
    """
    information = [rows @ rows.T for rows, _ in regressions]
    gradients = [rows @ residuals for rows, residuals in regressions]
    total, gradient = sum(information), sum(gradients)

    def leave_one_out_misfit(share: float) -> float:
        """Misfit of the touches, each by what all others show."""
        misfit = 0.0
        for (rows, residuals), own, pull in zip(regressions, information, gradients, strict=True):
            others = precision + share * (total - own)
            step: Array = np.asarray(np.linalg.solve(others, share * (gradient - pull)), float)
            misfit += float(np.sum((residuals - step @ rows) ** 2))
        return misfit

    return min(SHARES, key=leave_one_out_misfit)
