"""Touch response of one sensor by presses on its twin: a last layer of its own.

Which layer explains the presses of known frames better, the learned or the twin's, is judged by
those frames where there are any.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from eitskin.training.joint.combinations import Combinations, log_change
from eitskin.training.joint.prior import MARGIN, TouchPrior
from eitskin.training.joint.touch_response import SpecimenResponse
from eitskin.training.method.interface import TwinTrial
from eitskin.training.method.known_frames import KnownFrames, TwinPresses

Array = NDArray[np.float64]

FLAT_PRESSES, BENT_PRESSES = 240, 30  # on the flat twin, and at each of some bends
BENDS = 3
MISMATCH = 0.05  # error of each change relative to itself, beside the noise of a frame
LATENT_LEFT = 0.5  # of what latent variables describe: the twin tells the rest
RIDGE = 1e-5  # of the largest eigenvalue: combinations of features below are not resolved


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
    over places, forces and bends that it was learned for. The layers before stay as learned.

    Args:
        learned: response of the sensor by its features.
        prior: of touches, which bounds the places.
        radius: of the indenters [m].
        combinations: of the measurements.
        twin: that is pressed.
        bends: whether it is pressed while bent, too.

    Raises the errors of `TwinPresses.changes`.
    """
    response, unit = learned.response, np.sqrt(2.0) * combinations.unit
    ranges = response.ranges
    angles = np.linspace(*ranges.angle_deg, BENDS) if bends else np.zeros(0)
    bounds = np.array([prior.low[:2] + MARGIN, prior.high[:2] - MARGIN])
    touches = _spread(bounds, ranges.force, FLAT_PRESSES + BENT_PRESSES * len(angles))
    touches = touches[twin.inside(touches[:, :2])]
    ends = len(touches) - BENT_PRESSES * np.arange(len(angles), -1, -1)
    groups = zip([0.0, *angles.tolist()], [0, *ends[:-1]], ends, strict=True)
    rows, left = [], []
    for angle_deg, first, last in groups:
        some = touches[first:last]
        change = combinations.of(twin.changes(some, angle_deg, radius))
        # A frame is compared with another one, and the response errs in proportion to the change.
        error = np.sqrt(np.mean((MISMATCH * change) ** 2 + unit**2, axis=1, keepdims=True))
        rows.append(response.hidden(some, angle_deg) / error)
        left.append((change - learned(some, angle_deg)) / error)
    inputs = np.concatenate(rows)
    gram = inputs.T @ inputs
    ridge = RIDGE * float(np.linalg.eigvalsh(gram)[-1])
    step = np.linalg.solve(gram + ridge * np.eye(len(gram)), inputs.T @ np.concatenate(left))
    output: Array = learned.output + step.T
    return output


def own_response(
    learned: SpecimenResponse, output: Array, latent_output: Array | None = None
) -> SpecimenResponse:
    """Response of a sensor with a last layer of its own.

    Args:
        learned: response of the sensor by its features.
        output: the last layer (K, hidden + 1).
        latent_output: its derivatives by the latent variables (Q, K, hidden + 1); those that a twin
            leaves when omitted.
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
    both = (learned, own_response(learned, output))
    left = (relative_residual(each, touched, combinations) for each in both)
    return TwinTrial(len(touched), *left)


def _spread(bounds: Array, force: tuple[float, float], count: int) -> Array:
    """Touches (n, 3) spread evenly, by a Halton sequence, between bounds (2, 2) [m] and forces."""
    from scipy.stats import qmc  # takes half a second, which a live session has no use for

    low, high = (np.append(bounds[end], force[end]) for end in (0, 1))
    return np.asarray(low + (high - low) * qmc.Halton(3, seed=0).random(count))


def relative_residual(
    response: SpecimenResponse, touched: KnownFrames, combinations: Combinations
) -> float:
    """Residual of a response in the changes of known touches, relative to these.

    Each frame has a strength of its own, by least squares, since forces are known less well than
    places, or not at all.

    Args:
        response: of the sensor.
        touched: frames with touches at known places.
        combinations: of the measurements.
    """
    left = size = 0.0
    for row, known in enumerate(touched.touches):
        touches = known[np.isfinite(known[:, 0])]
        forces = touches[:, 2]
        touches[:, 2] = np.where(np.isfinite(forces), forces, response.response.ranges.middle_force)
        change = log_change(touched.observations.dynamic[row])
        angle_deg = np.nan_to_num(touched.reference_deg[row])
        modelled = combinations.changes(response(touches, float(angle_deg)).sum(axis=0))
        good = np.isfinite(change)
        change, modelled = change[good], modelled[good]
        strength = float(modelled @ change) / max(float(modelled @ modelled), 1e-300)
        left += float(np.sum((change - strength * modelled) ** 2))
        size += float(change @ change)
    return float(np.sqrt(left / size))
