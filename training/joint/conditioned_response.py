"""Touch response of one sensor given touches at known places, by Bayes' rule.

The changes by a touch are linear in the latent variables of the sensor (`TouchResponse`), whose
distribution was learned from the training specimens; known touches tell them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.combinations import CombinedChange, log_change
from eitskin.training.joint.own_response import own_response
from eitskin.training.joint.prior import TouchPrior
from eitskin.training.joint.touch_response import SpecimenResponse
from eitskin.training.method.known_frames import KnownFrames

Array = NDArray[np.float64]
Combined = Callable[[Array, float, float], CombinedChange]

STRENGTH_STD = 0.15  # of the specimens' log strength, as in training
FORCE_ERROR, UNKNOWN_FORCE = 0.05, 1.0  # standard deviation of a force, relative to it
PLACE_ERROR = 0.0003  # m, of known places
MOST_CHANGE = (-0.5, 1.0)  # of an unknown force in one round, relative
ROUNDS = 3  # of finding latent variables and unknown forces in turn


@dataclass(frozen=True, slots=True, eq=False)
class KnownTouches:
    """Known touches of one frame.

    Attributes:
        seen: combinations of the change by them.
        places: x [m], y [m] and force [N] of each (k, 3); of an unknown force a guess.
        told: whether each force is known (k,).
        angle_deg: of the bend [deg].
    """

    seen: CombinedChange
    places: Array
    told: NDArray[np.bool_]
    angle_deg: float

    @property
    def force_errors(self) -> Array:
        """Standard deviation of each force (k,), relative to it."""
        return np.where(self.told, FORCE_ERROR, UNKNOWN_FORCE)

    def errors(self, response: SpecimenResponse, changes: Array) -> Array:
        """Covariance (K, K) of noise, errors of the response, and of places and forces.

        Args:
            response: of the sensor.
            changes: by each touch, and their derivatives by x, y and force (4, k, K).
        """
        combinations = self.seen.combinations
        each = combinations.changes(changes[0])
        total: Array = self.seen.noise.copy()
        variance = response.response.mismatch**2 * np.einsum("kc,kc->c", each, each)
        combinations.add_independent(total, variance)
        moved = PLACE_ERROR * changes[1:3].reshape(-1, len(total))
        forces = self.force_errors[:, None] * changes[0]
        total += moved.T @ moved + forces.T @ forces
        return total

    def pressed_by(self, more: Array, bounds: tuple[float, float]) -> "KnownTouches":
        """The touches with unknown forces that are larger by shares `more` (k,), in bounds [N]."""
        force = np.clip(self.places[:, 2] * (1.0 + np.clip(more, *MOST_CHANGE)), *bounds)
        force = np.where(self.told, self.places[:, 2], force)
        return replace(self, places=np.column_stack([self.places[:, :2], force]))


def response_given(
    prior: SpecimenResponse,
    touched: KnownFrames,
    combined: Combined,
    touches: TouchPrior,
    forces: bool,
) -> SpecimenResponse:
    """Response of a sensor given frames with known touches.

    Args:
        prior: response before.
        touched: frames with touches at known places.
        combined: combinations of a change of log V (C,), given the sum of the reciprocal numbers of
            frames in both means that are compared, and the time between these [s].
        touches: prior of touches, which bounds forces.
        forces: whether known forces count.
    """
    seen, known = touched.observations, []
    for row, labels in enumerate(touched.touches):
        places = labels[np.isfinite(labels[:, 0])]
        told = np.isfinite(places[:, 2]) & forces
        places[~told, 2] = prior.response.ranges.middle_force
        share = 1.0 / seen.frames[row] + 1.0 / seen.dynamic_frames[row]
        change = combined(log_change(seen.dynamic[row]), share, float(seen.dynamic_age[row]))
        angle_deg = float(np.nan_to_num(touched.reference_deg[row]))
        known.append(KnownTouches(change, places, told, angle_deg))
    return conditioned_response(prior, known, (float(touches.low[2]), float(touches.high[2])))


def conditioned_response(
    prior: SpecimenResponse, known: list[KnownTouches], bounds: tuple[float, float]
) -> SpecimenResponse:
    """Response of a sensor given known touches.

    A touch of a sensor of strength e^s, with latent variables q, changes

        y = e^s (g + L^T q) + errors,   s ~ N(0, STRENGTH_STD^2),   q ~ N(0, 1),

    which is linear in q, and nearly so in s. Their covariance grows by the misfit per degree of
    freedom where that is above one (Birge 1932): a response that explains the touches badly tells
    little of the sensor. Unknown forces are found with them.

    Args:
        prior: response before.
        known: touches.
        bounds: of forces [N].
    """
    latent = prior.response.latent_output
    precision = np.diag(np.append(STRENGTH_STD**-2, np.ones(len(latent))))
    found: Array = np.zeros(1 + len(latent))
    response = prior
    for _ in range(ROUNDS):
        information, told, misfit, size = precision.copy(), 0.0 * found, 0.0, 0
        after = []
        for each in known:
            changes, _ = response.with_derivatives(each.places, each.angle_deg, np.ones(3))
            left = each.seen.change - changes[0].sum(axis=0)
            latent_changes = np.exp(found[0]) * prior.latent_changes(each.places, each.angle_deg)
            rows = np.concatenate([changes[0].sum(axis=0)[None], latent_changes])
            weight = np.linalg.inv(each.errors(response, changes))
            information += rows @ weight @ rows.T
            told += rows @ weight @ (left + found @ rows)
            misfit += float(left @ weight @ left)
            size += each.seen.told - int(np.sum(~each.told))
            more = each.force_errors**2 * (changes[0] @ weight @ left)
            after.append(each.pressed_by(more, bounds))
        known = after
        found = np.asarray(np.linalg.solve(information, told), dtype=np.float64)
        strength = float(np.exp(found[0]))
        output: Array = strength * (prior.output + np.tensordot(found[1:], latent, axes=1))
        response = own_response(prior, output, latent)
    covariance = np.linalg.inv(information)[1:, 1:] * max(misfit / max(size, 1), 1.0)
    spread = strength * np.linalg.cholesky(covariance)
    return own_response(prior, output, np.tensordot(spread.T, latent, axes=1))
