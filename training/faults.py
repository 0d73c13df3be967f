"""Measurements at fault: a wire or a contact that changed looks like a touch, nearly."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.simulator import Protocol
from eitskin.training.touch_problem import Fitted, Point, TouchProblem, excess, refined

Array = NDArray[np.float64]

EVIDENCE = 25.0  # by which one fault must lower the misfit, as a touch must
FITTING = 3.0  # standard deviations that the misfit may be above its expectation with the fault
AMISS = 3.0  # the same, above which a fault is looked for although all touches stay
PLAUSIBLE = 0.5  # share of a touch's gain that a fault must promise to be tried in its place
SPARED = 2.0  # misfit that one fault may leave more than the touches it replaces
STEPS, SETTLED = 6, 0.1  # of Gauss-Newton without the measurements at fault


@dataclass(frozen=True, slots=True, eq=False)
class Fault:
    """One thing that may be wrong, and what it does.

    Attributes:
        name: in words.
        members: the measurements that it changes.
        change: of log V, in any unit (C,).
    """

    name: str
    members: tuple[int, ...]
    change: Array


def possible_faults(protocol: Protocol, flat: Array) -> tuple[Fault, ...]:
    """Of a single measurement, and of a single contact, for a sensor of these magnitudes [ohm].

    A contact that changes is a resistance in series with every measurement whose current and
    voltage both pass through its electrode.
    """
    faults = []
    size = len(flat)
    for i, label in enumerate(protocol.labels):
        alone = np.zeros(size)
        alone[i] = 1.0
        faults.append(Fault(f"measurement {label} does not fit the others", (i,), alone))
    table = np.array(protocol.table)
    for electrode in range(protocol.n_electrodes):
        drive, sense = (table[:, pair] == electrode for pair in (slice(0, 2), slice(2, 4)))
        through = drive.any(axis=1) & sense.any(axis=1)
        if through.sum() > 1:
            change = np.where(through, np.nanmedian(flat) / flat, 0.0)
            members = tuple(np.flatnonzero(through).tolist())
            name = f"the contact of electrode {electrode} has changed"
            faults.append(Fault(name, members, np.nan_to_num(change)))
    return tuple(faults)


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
    problem: TouchProblem, untouched: Fitted, found: Fitted, gains: Array, faults: Sequence[Fault]
) -> Mended | None:
    """The frame explained by one fault and fewer touches, where that explains it as well.

    The simplest comes first: a fault alone, then a fault in place of each touch, then a fault
    beside all touches of a frame that these do not explain.

    Args:
        problem: the frame.
        untouched: its fit without touches.
        found: its best fit.
        gains: of the touches found, to second order (k,).
        faults: that are possible.
    """
    touches = len(found.point.touches)
    changes = np.array([fault.change for fault in faults]).T
    starts: list[tuple[Fitted, Point]] = []
    if touches or untouched.excess > AMISS:
        starts.append((untouched, untouched.point))
    if touches > 1:
        for i in np.argsort(gains)[:2].tolist():
            if _feigned(problem, found, i, changes, faults) > PLAUSIBLE * gains[i]:
                taken_back = refined(problem, found.point.without(i), STEPS, SETTLED)
                starts.append((taken_back, taken_back.point))
    if touches and found.excess > AMISS:
        starts.append((found, found.point))
    for fitted, point in starts:
        quadratic = fitted.quadratic
        directions = fitted.whitening @ changes
        fault, gain = likeliest(quadratic.residual, quadratic.jacobian, directions, faults)
        # A touch has three unknowns and a fault one: it may leave a little more.
        spared = 3 * (touches - len(point.touches)) + SPARED
        if gain < EVIDENCE:
            continue
        rest = fitted.misfit - gain
        if rest > found.misfit + spared or excess(rest, fitted.freedom - 1) > FITTING:
            continue
        fewer = problem.lacking(fault.members)
        if len(fewer.good) < len(problem.change) // 2:
            continue
        again = refined(fewer, point, STEPS, SETTLED)
        if again.excess < FITTING:
            return Mended(fault, fewer, again)
    return None


def _feigned(
    problem: TouchProblem, found: Fitted, touch: int, changes: Array, faults: Sequence[Fault]
) -> float:
    """How much of what one touch explains a fault would, all else staying as it is."""
    point, quadratic = found.point, found.quadratic
    alone = problem.response(point.touches[touch : touch + 1], point.angle_deg)[0]
    others = np.delete(quadratic.jacobian, slice(1 + 3 * touch, 4 + 3 * touch), axis=1)
    left = quadratic.residual + found.whitening @ alone
    return likeliest(left, others, found.whitening @ changes, faults)[1]


def likeliest(
    residual: Array, known: Array, directions: Array, faults: Sequence[Fault]
) -> tuple[Fault, float]:
    """The fault that explains most of a residual (C,), and by how much it lowers the misfit.

    Beside the other unknowns, of Jacobian `known` (C, n), a direction u gains
    (u^T P r)^2 / (u^T P u), with P the projection that takes theirs off; all are whitened, and
    `directions` are (C, faults).
    """
    basis, _ = np.linalg.qr(known)
    free = directions - basis @ (basis.T @ directions)
    size = np.sum(free**2, axis=0)
    gain = (free.T @ residual) ** 2 / np.maximum(size, 1e-9)
    gain[size < 1e-3 * np.sum(directions**2, axis=0)] = 0.0  # the unknowns could do as well
    best = int(gain.argmax())
    return faults[best], float(gain[best])
