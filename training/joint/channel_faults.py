"""Detection of faulty measurements and electrode contacts, whose changes resemble touches."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from eitskin.protocol import Protocol
from eitskin.training.joint.combinations import CombinedChange
from eitskin.training.joint.objective import (
    MapEstimate,
    levenberg_marquardt,
    misfit_sigma,
    whitening_matrix,
)
from eitskin.training.joint.touch_search import prune

Array = NDArray[np.float64]

FAULT_THRESHOLD = 25.0  # least decrease of the misfit by a fault, the same as by a touch
GROSS_GAIN = 4.0 * FAULT_THRESHOLD  # the same of one by which most of a frame's change is
ACCEPTED_SIGMA = 3.0  # highest misfit with the fault, in standard deviations above expectation
SUSPICIOUS_SIGMA = 3.0  # misfit above its expectation from which a fault is considered
MAX_FAULTS = 2  # in one frame
MIN_SHARE = 0.5  # of a touch's gain that a fault must promise to be tried instead
ALLOWANCE = 2.0  # misfit by which a fault may fit worse than the touches it replaces
FAULT_SIZE = 0.01  # standard deviation of the log of a measurement with a fault, before it is seen
FAULT_PRICE = 2.0 * math.log(36 / 0.05)
"""Decrease of minus twice the log density that is asked of each fault: any of some three dozen has
odds of 0.05 before a frame is seen."""
MAX_CONTACTS = 3  # that are taken to have changed together
AGEING = (0.03, 0.1, 0.3, 1.0)  # changes of all contacts, in those of one; `alone` bounds up to 1
STEPS, TOLERANCE = 6, 0.1  # of Levenberg-Marquardt without the faulty measurements


@dataclass(frozen=True, slots=True, eq=False)
class ChannelFault:
    """One possible fault.

    Attributes:
        name: name in words.
        members: numbers of the measurements that it changes.
    """

    name: str
    members: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FaultyChange:
    """A frame whose change is that of some faults, and of nothing else but noise.

    Attributes:
        faults: faults of one measurement, or of up to `MAX_CONTACTS` contacts.
        improbability: minus twice the log of its density with the faults' prices, but for a
            constant.
        rest: the frame less these faults, as far as they are known.
    """

    faults: tuple[ChannelFault, ...]
    improbability: float
    rest: CombinedChange

    @property
    def names(self) -> str:
        """The faults in words."""
        return " and ".join(fault.name for fault in self.faults)


@dataclass(frozen=True, eq=False)
class PossibleFaults:
    """All single faults of one sensor, and their signatures.

    Attributes:
        faults: n of them.
        changes: changes of log V by each fault, in any unit (C, n).
    """

    faults: tuple[ChannelFault, ...]
    changes: Array
    _whole: list[tuple[Array, Array]] = field(default_factory=list, init=False, repr=False)

    @cached_property
    def contacts(self) -> list[int]:
        """Numbers of the faults that are of contacts."""
        return [i for i, fault in enumerate(self.faults) if len(fault.members) > 1]

    @cached_property
    def sets(self) -> tuple[NDArray[np.intp], ...]:
        """Numbers of the faults (n, k) that may be there together, for k = 1, 2, ..."""
        several = (list(combinations(self.contacts, k)) for k in range(2, MAX_CONTACTS + 1))
        singles = [(i,) for i in range(len(self.faults))]
        return tuple(np.array(each) for each in (singles, *several) if each)

    def signatures(self, combined: CombinedChange) -> tuple[Array, Array]:
        """Combinations (K, n) and remainders (C, n) of all faults; those of all measurements stay.

        A sensor has one set of combinations, so only the measurements left out change them.
        """
        if not combined.good.all():
            return combined.project_observed(self.changes), combined.remainder(self.changes)
        if not self._whole:
            parts = combined.project_observed(self.changes), combined.remainder(self.changes)
            self._whole.append(parts)
        return self._whole[0]

    def alone(
        self, combined: CombinedChange, slopes: Array, worth: float = math.inf, ages: bool = False
    ) -> FaultyChange | None:
        """The likeliest faults, should they be all that changed, by their evidence.

        The size of each is normal before it is measured.

        Args:
            combined: change of the frame.
            slopes: changes (n, K) of unit variance that there may be besides.
            worth: improbability above which faults do not matter; None is returned for these.
            ages: whether all contacts may have changed together, as they do with time.
        """
        scale = math.sqrt(combined.frames)
        whitening = whitening_matrix(combined.noise + slopes.T @ slopes)
        seen, rest = (FAULT_SIZE * each for each in self.signatures(combined))
        shown = np.concatenate([whitening @ seen, rest / scale])
        residual = np.concatenate([whitening @ combined.change, combined.rest / scale])
        gram, on = shown.T @ shown, shown.T @ residual
        width = 2.0 * float(np.sum(np.log(np.diagonal(whitening))))
        nothing = float(residual @ residual) - width
        least, every = nothing - worth, np.array(self.contacts, np.intp)
        given = 1.0 + np.diagonal(gram)
        gains = on**2 / given - np.log(given) - FAULT_PRICE
        best, gain, stiffness = self.sets[0][gains.argmax()], float(gains.max()), 1.0
        # All contacts together, by their principal changes, gain more than any few.
        sizes, axes = np.linalg.eigh(gram[np.ix_(every, every)])
        square = (on[every] @ axes) ** 2
        most = float(np.sum(square / (1.0 + sizes)))
        for sets in self.sets[1:] if most - 2.0 * FAULT_PRICE > least else ():
            count = sets.shape[1]
            several = gram[sets[:, :, None], sets[:, None]] + np.eye(count)
            shares = np.linalg.solve(several, on[sets][..., None])[..., 0]
            gains = np.einsum("nk,nk->n", shares, on[sets]) - np.linalg.slogdet(several)[1]
            gains -= FAULT_PRICE * count
            if gains.max() > gain:
                best, gain = sets[gains.argmax()], float(gains.max())
        if ages and len(every) > MAX_CONTACTS and most - FAULT_PRICE > least:
            variances = np.square(AGEING)[:, None]
            gains = np.sum(square / (sizes + 1.0 / variances), axis=1) - FAULT_PRICE
            gains -= np.sum(np.log1p(sizes * variances), axis=1)
            if gains.max() > gain:
                best, gain = every, float(gains.max())
                stiffness = AGEING[int(gains.argmax())] ** -2
        if gain <= least:
            return None
        inverse = np.linalg.inv(gram[np.ix_(best, best)] + stiffness * np.eye(len(best)))
        mine = FAULT_SIZE * self.changes[:, best]
        spread = seen[:, best] @ np.linalg.cholesky(inverse)
        further = spread @ spread.T + (0.0 if combined.further is None else combined.further)
        cleaned = replace(
            combined,
            measured=np.where(combined.good, combined.measured - mine @ (inverse @ on[best]), 0.0),
            further=further,
        )
        faults = tuple(self.faults[i] for i in best)
        if len(best) > MAX_CONTACTS:
            members = np.flatnonzero(mine.any(axis=1)).tolist()
            faults = (ChannelFault("contacts of several electrodes have changed", tuple(members)),)
        return FaultyChange(faults, nothing - gain, cleaned)

    def likeliest(
        self,
        combined: CombinedChange,
        whitening: Array,
        scale: Array | float,
        residual: Array,
        jacobian: Array,
    ) -> tuple[ChannelFault, float]:
        """The fault that explains most of a residual, and its decrease of the misfit.

        With P the projection orthogonal to the Jacobian's columns, a fault of signature u lowers
        the misfit of a residual r by (u^T P r)^2 / (u^T P u).

        Args:
            combined: change of the frame, of which some measurements may be left out.
            whitening: whitening of the combinations (K, K).
            scale: standard deviation of the remainder, which they leave (C,).
            residual: residual of the combinations, then the remainder, whitened (K + C,).
            jacobian: jacobian of the other unknowns, whitened (K, n); none explains the remainder.
        """
        seen, rest = self.signatures(combined)
        seen, rest = whitening @ seen, (rest.T / scale).T
        factors, tau, _, _ = lapack.dgeqrf(jacobian)
        basis = lapack.dorgqr(factors[:, : len(tau)], tau)[0]  # orthonormal, of its columns
        free = seen - basis @ (basis.T @ seen)
        left = np.einsum("cn,cn->n", rest, rest)
        size, most = (np.einsum("cn,cn->n", each, each) + left for each in (free, seen))
        gain = (residual[: len(seen)] @ free + residual[len(seen) :] @ rest) ** 2
        # A fault that the other unknowns explain as well gains nothing.
        gain = np.where(size < 1e-3 * most, 0.0, gain / np.maximum(size, 1e-9))
        best = int(gain.argmax())
        return self.faults[best], float(gain[best])

    def most_likely(
        self, estimate: MapEstimate, replaced: int | None = None
    ) -> tuple[ChannelFault, float]:
        """The fault that explains most of what an estimate leaves, and its decrease of the misfit.

        Or in place of one touch, `replaced`, the others unchanged.
        """
        residual, jacobian = estimate.white[0], estimate.white[1:].T
        if replaced is not None:
            residual = residual + estimate.whitening @ estimate.at.changes[replaced]
            jacobian = np.delete(jacobian, slice(1 + 3 * replaced, 4 + 3 * replaced), axis=1)
        scale = estimate.objective.remainder_scale(estimate.at)
        residual = np.concatenate([residual, estimate.whole[0]])
        combined = estimate.objective.combined
        return self.likeliest(combined, estimate.whitening, scale, residual, jacobian)


def possible_faults(protocol: Protocol, flat: Array) -> PossibleFaults:
    """Faults of every measurement and every contact of a sensor of flat magnitudes (C,) [ohm].

    A contact that changes is a resistance in series with every measurement whose current and
    voltage both pass through its electrode.
    """
    faults, through = _faults_and_members(protocol)
    share = np.nan_to_num(np.nanmedian(flat) / flat)[:, None]
    return PossibleFaults(faults, np.concatenate([np.eye(len(flat)), through * share], axis=1))


@lru_cache(maxsize=4)
def _faults_and_members(protocol: Protocol) -> tuple[tuple[ChannelFault, ...], Array]:
    """The faults of a protocol, and which measurements (C, n) each contact among them is in."""
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
    return tuple(faults), through[:, shared].astype(float)


def gross_fault(
    untouched: MapEstimate, estimate: MapEstimate, possible: PossibleFaults
) -> ChannelFault | None:
    """The fault that most of a frame's change is by, which hides touches; None if there is none.

    Where `estimate` explains the frame, or the measurements that are left would be too few.
    """
    _, misfit, degrees_of_freedom = untouched.whole
    if estimate.whole_sigma < SUSPICIOUS_SIGMA:
        return None
    fault, gain = possible.most_likely(untouched)
    left = untouched.objective.combined.count - len(fault.members)
    few = left < len(untouched.objective.combined.good) // 2
    least = max(GROSS_GAIN, MIN_SHARE * (misfit - degrees_of_freedom))
    return None if few or gain < least else fault


def fit_with_fault(
    untouched: MapEstimate, estimate: MapEstimate, possible: PossibleFaults
) -> tuple[ChannelFault, MapEstimate] | None:
    """One fault and the estimate without its measurements; None where `estimate` fits better.

    The fault takes the place of touches, or is next to all of them; `untouched` has none.
    """
    touches = len(estimate.at.touches)
    for alternative in _alternatives(untouched, estimate, possible):
        _, misfit, degrees_of_freedom = alternative.whole
        fault, gain = possible.most_likely(alternative)
        if gain < FAULT_THRESHOLD:
            continue
        if alternative is estimate:
            likely = gain > MIN_SHARE * (misfit - degrees_of_freedom)
        else:
            # A touch has three unknowns, a fault one: the fault may fit a little worse.
            allowance = 3 * (touches - len(alternative.at.touches)) + ALLOWANCE
            sigma = misfit_sigma(misfit - gain, degrees_of_freedom - 1)
            likely = misfit - gain <= estimate.whole[1] + allowance and sigma <= ACCEPTED_SIGMA
        combined = estimate.objective.combined.drop(fault.members)
        if not likely or combined.count < len(combined.good) // 2:
            continue
        fewer = replace(estimate.objective, combined=combined)
        again = prune(levenberg_marquardt(fewer, alternative.unknowns, STEPS, TOLERANCE))
        if again.whole_sigma < ACCEPTED_SIGMA:
            return fault, again
    return None


def _alternatives(
    untouched: MapEstimate, estimate: MapEstimate, possible: PossibleFaults
) -> Iterator[MapEstimate]:
    """Estimates to which a fault may be added, the simplest first.

    No touch; one touch less; all touches, where their misfit is suspicious.
    """
    touches = len(estimate.at.touches)
    if touches or untouched.whole_sigma > SUSPICIOUS_SIGMA:
        yield untouched
    if touches > 1:
        gains = estimate.gains
        for i in np.argsort(gains)[:2].tolist():
            if possible.most_likely(estimate, i)[1] > MIN_SHARE * gains[i]:
                others = estimate.unknowns.without_touch(i)
                yield levenberg_marquardt(estimate.objective, others, STEPS, TOLERANCE)
    if touches and estimate.whole_sigma > SUSPICIOUS_SIGMA:
        yield estimate
