"""Wide contacts that explain a frame about as well as several touches: bars and discs."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.fit_kernels import ANGLE_UNIT, OPTIMISM, TOUCH_UNITS
from eitskin.training.joint.objective import MapEstimate, Unknowns, solution

Array = NDArray[np.float64]

ALLOWANCE = (6.0, 30.0, 50.0)
"""Most that a wide contact, of five or six unknowns, may raise the misfit of 2, 3, ... touches to
be a rival: each touch that it spares has three unknowns, and a wide contact less odds."""
STEPS, TOLERANCE = 7, 0.5  # of Levenberg-Marquardt, and promise of the misfit at which it ends
DAMPING, LIGHTER, HEAVIER = 1e-2, 0.2, 6.0  # of its steps, and its factors after good and bad ones
SIZE_UNIT, LEAST_SIZE = 0.010, 0.005  # m, unit step of half lengths and radii, and the least first
# m, spread of touches across that may be a bar, and that may be a disc
WIDTH, RADIUS = 0.010, 0.025
WEAKEST = 0.1  # times the least force of a touch: least of each point of a wide contact
_TURNS = np.arange(6) * np.pi / 3.0
_RING = np.column_stack([np.cos(_TURNS), np.sin(_TURNS)])
BAR = np.linspace(-1.0, 1.0, 5)[:, None, None] * np.eye(2)
DISC = np.concatenate([np.zeros((1, 2)), _RING])[:, :, None]
"""Places of n points by the size of a contact, a half length (2,) or a radius (1,), (n, 2, m)."""


@dataclass(frozen=True, slots=True, eq=False)
class WideContact:
    """A bar or disc of even pressure.

    Attributes:
        misfit: rise of the misfit that it makes in place of the touches of an estimate.
        centre: x and y [m].
        length: length of the bar, or diameter of the disc [m].
    """

    misfit: float
    centre: Array
    length: float


def wide_rival(found: MapEstimate) -> WideContact | None:
    """The likelier of a bar and a disc in place of all touches of an estimate; None if unlikely.

    Next to a single touch chance alone makes one likely.
    """
    touches = found.at.touches
    if len(touches) < 2:
        return None
    share = touches[:, 2] / touches[:, 2].sum()
    centre = share @ touches[:, :2]
    spread = touches[:, :2] - centre
    values, vectors = np.linalg.eigh((share[:, None] * spread).T @ spread)
    half, radius = np.sqrt(np.maximum([2.0 * values[1], 1.2 * values.sum()], LEAST_SIZE**2))
    starts = []
    if values[0] < WIDTH**2:
        starts.append((BAR, half * vectors[:, 1]))
    if values.sum() < RADIUS**2:
        starts.append((DISC, np.array([radius])))
    rivals = [_fit_contact(found, shape, centre, size) for shape, size in starts]
    return min(filter(None, rivals), key=lambda each: each.misfit, default=None)


def _fit_contact(
    found: MapEstimate, shape: Array, centre: Array, size: Array
) -> WideContact | None:
    """Contact of points centre + shape (n, 2, m) size (m,) of equal forces, by least squares.

    None where it cannot become a rival.
    """
    objective, count = found.objective, len(shape)
    prior, residual = objective.prior, found.white[0]
    limit = float(residual @ residual) + ALLOWANCE[len(found.at.touches) - 2]
    units = np.concatenate([[ANGLE_UNIT], TOUCH_UNITS, np.full(len(size), SIZE_UNIT)])

    def rows(unknowns: Array) -> Array:
        points = unknowns[1:3] + shape @ unknowns[4:]
        touches = np.empty((count, 3))
        touches[:, :2] = np.minimum(np.maximum(points, prior.low[:2]), prior.high[:2])
        touches[:, 2] = unknowns[3]
        each = objective.linearise(Unknowns(touches, float(unknowns[0]))).rows
        by_point = each[2:].reshape(count, 3, -1)
        by_size = np.tensordot(shape, by_point[:, :2], axes=((0, 1), (0, 1)))
        return np.concatenate([each[:2], by_point.sum(axis=0), by_size]) @ found.whitening.T

    unknowns = np.array([found.at.angle_deg, *centre, found.at.touches[:, 2].sum() / count, *size])
    white, damping = rows(unknowns), DAMPING
    for _ in range(STEPS):
        products = white @ white.T
        information = products[1:, 1:] * (1.0 + damping * np.eye(len(units)))
        information += 1e-3 * np.eye(len(units))
        step = solution(information, products[0, 1:])
        promised = float(step @ products[0, 1:])
        if promised < TOLERANCE or products[0, 0] - OPTIMISM * promised > limit:
            break
        trial = unknowns + units * step / max(1.0, float(np.abs(step).max()))
        trial[3] = max(trial[3], WEAKEST * prior.low[2])
        tried = rows(trial)
        if tried[0] @ tried[0] < products[0, 0]:
            unknowns, white = trial, tried
            damping *= LIGHTER
        else:
            damping *= HEAVIER
    misfit = float(white[0] @ white[0])
    if misfit > limit:
        return None
    rise = misfit - float(residual @ residual)
    return WideContact(rise, unknowns[1:3], 2.0 * float(np.linalg.norm(unknowns[4:])))
