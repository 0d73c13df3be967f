"""Measurements at fault: a wire or a contact that changed looks like a touch, nearly."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.protocol import Protocol
from eitskin.training.joint.lapack import orthonormal
from eitskin.training.joint.objective import Fitted, TouchProblem, excess, refined

Array = NDArray[np.float64]

EVIDENCE = 25.0  # by which one fault must lower the misfit, as a touch must
FITTING = 3.0  # standard deviations that the misfit may be above its expectation with the fault
AMISS = 3.0  # the same, above which a fault is looked for although all touches stay
PLAUSIBLE = 0.5  # share of a touch's gain that a fault must promise to be tried in its place
SPARED = 2.0  # misfit that one fault may leave more than the touches it replaces
STEPS, SETTLED = 6, 0.1  # of Gauss-Newton without the measurements at fault


@dataclass(frozen=True, slots=True, eq=False)
class Fault:
    """One thing that may be wrong.

    Attributes:
        name: in words.
        members: the measurements that it changes.
    """

    name: str
    members: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PossibleFaults:
    """All that may be wrong with one sensor, one at a time.

    Attributes:
        faults: n of them.
        changes: of log V, in any unit (C, n).
    """

    faults: tuple[Fault, ...]
    changes: Array


def possible_faults(protocol: Protocol, flat: Array) -> PossibleFaults:
    """Of a single measurement, and of a single contact, for a sensor of these magnitudes [ohm].

    A contact that changes is a resistance in series with every measurement whose current and
    voltage both pass through its electrode.
    """
    faults = [
        Fault(f"measurement {label} does not fit the others", (i,))
        for i, label in enumerate(protocol.labels)
    ]
    table = np.array(protocol.table)[:, :, None] == np.arange(protocol.n_electrodes)
    through = table[:, :2].any(axis=1) & table[:, 2:4].any(axis=1)
    shared = np.flatnonzero(through.sum(axis=0) > 1)
    faults += [
        Fault(f"the contact of electrode {i} has changed", tuple(np.flatnonzero(row).tolist()))
        for i, row in zip(shared.tolist(), through[:, shared].T, strict=True)
    ]
    share = np.nan_to_num(np.nanmedian(flat) / flat)[:, None]
    changes = np.concatenate([np.eye(len(flat)), through[:, shared] * share], axis=1)
    return PossibleFaults(tuple(faults), changes)


@dataclass(frozen=True, slots=True, eq=False)
class Mended:
    """A frame without the measurements at fault.

    Attributes:
        fault: what is at fault.
        problem: the frame without its measurements.
        found: what explains that.
    """

    fault: Fault
    problem: TouchProblem
    found: Fitted


def mended(
    problem: TouchProblem, untouched: Fitted, found: Fitted, gains: Array, possible: PossibleFaults
) -> Mended | None:
    """The frame explained by one fault and fewer touches, where that explains it as well.

    Args:
        problem: the frame.
        untouched: its fit without touches.
        found: its best fit.
        gains: of the touches found, to second order (k,).
        possible: faults.
    """
    touches = len(found.point.touches)
    for fitted in _suspects(problem, untouched, found, gains, possible):
        quadratic = fitted.quadratic
        fault, gain = likeliest(
            quadratic.residual, quadratic.jacobian, fitted.whitening @ possible.changes, possible
        )
        # A touch has three unknowns and a fault one: it may leave a little more.
        spared = 3 * (touches - len(fitted.point.touches)) + SPARED
        if gain < EVIDENCE:
            continue
        rest = fitted.misfit - gain
        if rest > found.misfit + spared or excess(rest, fitted.freedom - 1) > FITTING:
            continue
        fewer = problem.lacking(fault.members)
        if len(fewer.good) < len(problem.change) // 2:
            continue
        again = refined(fewer, fewer.tangent(fitted.point), STEPS, SETTLED)
        if again.excess < FITTING:
            return Mended(fault, fewer, again)
    return None


def _suspects(
    problem: TouchProblem, untouched: Fitted, found: Fitted, gains: Array, possible: PossibleFaults
) -> Iterator[Fitted]:
    """Fits beside which a fault may stand, the simplest first.

    That without touches, then without one of the touches, then with all of them where these do not
    explain the frame.
    """
    touches = len(found.point.touches)
    if touches or untouched.excess > AMISS:
        yield untouched
    if touches > 1:
        directions = found.whitening @ possible.changes
        for i in np.argsort(gains)[:2].tolist():
            if _feigned(found, i, directions, possible) > PLAUSIBLE * gains[i]:
                others = problem.tangent(found.point.without(i))
                yield refined(problem, others, STEPS, SETTLED)
    if touches and found.excess > AMISS:
        yield found


def _feigned(found: Fitted, touch: int, directions: Array, possible: PossibleFaults) -> float:
    """How much of what one touch explains a fault would, all else staying as it is."""
    quadratic = found.quadratic
    others = np.delete(quadratic.jacobian, slice(1 + 3 * touch, 4 + 3 * touch), axis=1)
    left = quadratic.residual + found.whitening @ found.at.changes[touch]
    return likeliest(left, others, directions, possible)[1]


def likeliest(
    residual: Array, known: Array, directions: Array, possible: PossibleFaults
) -> tuple[Fault, float]:
    """The fault that explains most of a residual (C,), and by how much it lowers the misfit.

    Beside the other unknowns, of Jacobian `known` (C, n), a direction u gains
    (u^T P r)^2 / (u^T P u), with P the projection that takes theirs off; all are whitened, and
    `directions` are (C, faults).
    """
    basis = orthonormal(known)
    free = directions - basis @ (basis.T @ directions)
    size = np.einsum("cn,cn->n", free, free)
    gain = (residual @ free) ** 2 / np.maximum(size, 1e-9)
    # The unknowns could do as well.
    gain[size < 1e-3 * np.einsum("cn,cn->n", directions, directions)] = 0.0
    best = int(gain.argmax())
    return possible.faults[best], float(gain[best])
