"""Choice of the terms of a four-terminal meter that flat frames call for."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.protocol import Protocol
from eitskin.simulator.instrument.meter import Quantity
from eitskin.simulator.instrument.meter_fit import STARTS, MeterFit, fit_meter
from eitskin.simulator.instrument.meter_parameters import USUAL

TRIAL_STARTS = 4
"""Starting points of each fit without one of the terms."""


def select_meter(
    impedance: NDArray[np.inexact],
    protocol: Protocol,
    frames: ArrayLike,
    terms: Sequence[str] = USUAL,
    reads: Quantity | None = None,
    seed: int = 0,
    starts: int = STARTS,
) -> MeterFit:
    """Fit with the terms that the frames call for, by backward elimination.

    From all `terms` on, the term that costs least is left out as long as Akaike's information
    criterion falls: n log(RSS) + 2 p for n readings, p parameters and the residual sum of squares
    (Akaike 1974). Terms left out have no effect: no load, no common mode.

    Arguments and errors as for `fit_meter`.
    """
    best = fit_meter(impedance, protocol, frames, terms, reads, seed, starts)
    left = list(dict.fromkeys(terms))
    while left:
        trials = {
            term: fit_meter(
                impedance,
                protocol,
                frames,
                [each for each in left if each != term],
                reads,
                seed,
                min(starts, TRIAL_STARTS),
            )
            for term in left
        }
        term = min(left, key=lambda each: _information(trials[each]))
        if _information(trials[term]) > _information(best):
            break
        best = trials[term]
        left.remove(term)
    return best


def _information(fit: MeterFit) -> float:
    """Akaike's information criterion of a fit, without its constant."""
    readings = len(fit.measured) * (2 if fit.meter.reads == "complex" else 1)
    residual = np.linalg.norm(fit.predicted - fit.measured) / np.linalg.norm(fit.measured)
    square = max(float(residual) ** 2, np.finfo(float).eps)
    return readings * float(np.log(square)) + 2.0 * len(fit.parameters)
