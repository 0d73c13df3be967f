"""Detection of faulty measurements and electrode contacts, whose changes resemble touches."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from eitskin.protocol import Protocol
from eitskin.training.joint.combinations import Combinations, CombinedChange
from eitskin.training.joint.objective import (
    MapEstimate,
    TouchObjective,
    levenberg_marquardt,
    misfit_sigma,
)
from eitskin.training.joint.touch_search import gains_of, pruned

Array = NDArray[np.float64]

FAULT_THRESHOLD = 25.0  # least decrease of the misfit by a fault, the same as by a touch
ACCEPTED_SIGMA = 3.0  # highest misfit with the fault, in standard deviations above expectation
SUSPICIOUS_SIGMA = 3.0  # misfit above its expectation from which a fault is considered
MOST_FAULTS = 2  # in one frame
LEAST_SHARE = 0.5  # of a touch's gain that a fault must promise to be tried instead
ALLOWANCE = 2.0  # misfit by which a fault may fit worse than the touches it replaces
STEPS, TOLERANCE = 6, 0.1  # of Levenberg-Marquardt without the faulty measurements


@dataclass(frozen=True, slots=True, eq=False)
class ChannelFault:
    """One possible fault.

    Attributes:
        name: in words.
        members: numbers of the measurements that it changes.
    """

    name: str
    members: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PossibleFaults:
    """All single faults of one sensor, and their signatures.

    Attributes:
        faults: n of them.
        changes: of log V by each fault, in any unit (C, n).
        whole: the changes with no measurement left out; see `seen_by`.
    """

    faults: tuple[ChannelFault, ...]
    changes: Array
    whole: tuple[Array, Array]

    def seen_by(self, combined: CombinedChange) -> tuple[Array, Array]:
        """Combinations of the changes (K, n), and what these leave of them (C or 0, n)."""
        if combined.good.all():
            return self.whole
        return combined.seen(self.changes), combined.remainder(self.changes)


def possible_faults(protocol: Protocol, flat: Array, combinations: Combinations) -> PossibleFaults:
    """Faults of every measurement and every contact of a sensor.

    A contact that changes is a resistance in series with every measurement whose current and
    voltage both pass through its electrode.

    Args:
        protocol: of the measurements.
        flat: magnitudes of the flat, untouched sensor (C,) [ohm].
        combinations: of the measurements.
    """
    faults = [
        ChannelFault(f"measurement {label} does not fit the others", (i,))
        for i, label in enumerate(protocol.labels)
    ]
    table = np.array(protocol.table)[:, :, None] == np.arange(protocol.n_electrodes)
    through = table[:, :2].any(axis=1) & table[:, 2:4].any(axis=1)
    shared = np.flatnonzero(through.sum(axis=0) > 1)
    faults += [
        ChannelFault(
            f"the contact of electrode {i} has changed", tuple(np.flatnonzero(row).tolist())
        )
        for i, row in zip(shared.tolist(), through[:, shared].T, strict=True)
    ]
    share = np.nan_to_num(np.nanmedian(flat) / flat)[:, None]
    changes = np.concatenate([np.eye(len(flat)), through[:, shared] * share], axis=1)
    whole = combinations.combined(np.zeros(len(flat)), 1.0, 0.0)
    return PossibleFaults(tuple(faults), changes, (whole.seen(changes), whole.remainder(changes)))


def fit_with_fault(
    objective: TouchObjective,
    untouched: MapEstimate,
    found: MapEstimate,
    possible: PossibleFaults,
) -> tuple[ChannelFault, TouchObjective, MapEstimate] | None:
    """Explain the frame by one fault and fewer touches; None where that fits worse.

    Args:
        objective: of the frame.
        untouched: its estimate without touches.
        found: its best estimate.
        possible: faults that are considered.

    Returns:
        the fault, the objective without its measurements, and the estimate by that.
    """
    touches = len(found.unknowns.touches)
    for alternative in _alternatives(objective, untouched, found, possible):
        rest, misfit, degrees_of_freedom = alternative.whole()
        fault, gain = most_likely_fault(
            np.concatenate([alternative.quadratic.residual, rest]),
            _padded(alternative.quadratic.jacobian, len(rest)),
            _directions(alternative, possible),
            possible,
        )
        if gain < FAULT_THRESHOLD:
            continue
        if alternative is found:
            likely = gain > LEAST_SHARE * (misfit - degrees_of_freedom)
        else:
            # A touch has three unknowns, a fault one: the fault may fit a little worse.
            allowance = 3 * (touches - len(alternative.unknowns.touches)) + ALLOWANCE
            sigma = misfit_sigma(misfit - gain, degrees_of_freedom - 1)
            likely = misfit - gain <= found.whole()[1] + allowance and sigma <= ACCEPTED_SIGMA
        if not likely:
            continue
        fewer = objective.without_measurements(fault.members)
        if fewer.combined.count < len(fewer.combined.good) // 2:
            continue
        again = levenberg_marquardt(fewer, alternative.unknowns, STEPS, TOLERANCE)
        again = pruned(fewer, again)
        if again.whole_sigma < ACCEPTED_SIGMA:
            return fault, fewer, again
    return None


def _alternatives(
    objective: TouchObjective,
    untouched: MapEstimate,
    found: MapEstimate,
    possible: PossibleFaults,
) -> Iterator[MapEstimate]:
    """Estimates to which a fault may be added, the simplest first.

    No touch; one touch less; all touches, where their misfit is suspicious.
    """
    touches = len(found.unknowns.touches)
    if touches or untouched.whole_sigma > SUSPICIOUS_SIGMA:
        yield untouched
    if touches > 1:
        directions, gains = _directions(found, possible), gains_of(found)
        for i in np.argsort(gains)[:2].tolist():
            if _gain_instead(found, i, directions, possible) > LEAST_SHARE * gains[i]:
                others = found.unknowns.without_touch(i)
                yield levenberg_marquardt(objective, others, STEPS, TOLERANCE)
    if touches and found.whole_sigma > SUSPICIOUS_SIGMA:
        yield found


def _gain_instead(
    found: MapEstimate, touch: int, directions: Array, possible: PossibleFaults
) -> float:
    """Decrease of the misfit by a fault in place of one touch, the other touches unchanged."""
    quadratic = found.quadratic
    jacobian, first = quadratic.jacobian, 1 + 3 * touch
    others = np.concatenate([jacobian[:, :first], jacobian[:, first + 3 :]], axis=1)
    residual = quadratic.residual + found.whitening @ found.at.changes[touch]
    rest = found.whole()[0]
    return most_likely_fault(
        np.concatenate([residual, rest]), _padded(others, len(rest)), directions, possible
    )[1]


def _directions(found: MapEstimate, possible: PossibleFaults) -> Array:
    """Signatures of the faults, whitened, above what the combinations leave of them, whitened."""
    seen, rest = possible.seen_by(found.objective.combined)
    scale = found.objective.remainder_scale(found.at)
    return np.concatenate([found.whitening @ seen, rest / scale[:, None]])


def _padded(jacobian: Array, rows: int) -> Array:
    """A Jacobian with further rows of zeros: no unknown explains what the combinations leave."""
    return np.pad(jacobian, ((0, rows), (0, 0))) if rows else jacobian


def most_likely_fault(
    residual: Array, jacobian: Array, directions: Array, possible: PossibleFaults
) -> tuple[ChannelFault, float]:
    """The fault that explains most of a residual, and its decrease of the misfit.

    With P the projection orthogonal to the Jacobian's columns, a fault of signature u lowers the
    misfit of a residual r by (u^T P r)^2 / (u^T P u).

    Args:
        residual: whitened (m,), any remainder included.
        jacobian: of the other unknowns, whitened (m, n).
        directions: signatures of the faults, whitened (m, faults).
        possible: the faults.
    """
    factors, tau, _, _ = lapack.dgeqrf(jacobian)
    basis = lapack.dorgqr(factors[:, : len(tau)], tau)[0]  # orthonormal, of its columns
    free = directions - basis @ (basis.T @ directions)
    size = np.einsum("cn,cn->n", free, free)
    gain = (residual @ free) ** 2 / np.maximum(size, 1e-9)
    # The other unknowns explain such a fault as well.
    gain[size < 1e-3 * np.einsum("cn,cn->n", directions, directions)] = 0.0
    best = int(gain.argmax())
    return possible.faults[best], float(gain[best])
