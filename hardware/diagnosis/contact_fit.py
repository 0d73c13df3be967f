"""Resistances in series with the electrodes, by least squares from pairwise resistances.

R_ij = g E_ij + r_i + r_j, each value weighted by its inverse square. Series resistances add
exactly, by Kirchhoff's laws; the common factor g is an approximation, limited by the electrode
positions and the paths of the board.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.protocol import Protocol

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

MODEL_ERROR = 0.004
"""Relative model error of a value, rms: electrode positions and board paths, 0.3 % each."""
LARGEST_CHI2 = 6.0
"""Largest reduced chi-square of a good fit; nearly all healthy sensors stay below 3.5, swapped
wires begin at 9."""
MOST_SWAPS = 3
_REGULARISATION = 1e-6  # of series resistances that no channel separates
_SPARE_MEASUREMENTS = 4  # least number of measurements beyond the unknowns


@dataclass(frozen=True, slots=True, eq=False)
class ContactFit:
    """Least-squares fit of contacts.

    Attributes:
        scale: g, ratio of the layer to the expected one.
        series: r, resistance in series with each electrode beyond the expected one, (electrodes,)
            [ohm].
        misfit: root mean square of the relative residuals.
    """

    scale: float
    series: Array
    misfit: float

    @property
    def good(self) -> bool:
        """Whether the misfit is that of a healthy sensor."""
        return bool(self.misfit**2 <= LARGEST_CHI2 * MODEL_ERROR**2)


def fit_contacts(
    values: Array, expected: Array, used: Bools, protocol: Protocol
) -> ContactFit | None:
    """Fit of contacts to the channels `used`; None for too few channels.

    Args:
        values: magnitudes, (measurements,) [ohm].
        expected: of a healthy sensor, (measurements,) [ohm].
        used: channels of the fit, (measurements,).
        protocol: a protocol that senses where it drives.
    """
    columns = _columns(expected, protocol)
    if used.sum() < _unknowns(columns, used) + _SPARE_MEASUREMENTS:
        return None
    return _least_squares(values[None], used[None], columns)[0]


def corrected_wiring(
    values: Array, expected: Array, used: Bools, protocol: Protocol
) -> tuple[tuple[tuple[int, int], ...], int | None, ContactFit]:
    """Fewest exchanges of two electrodes, or the one channel left out, that make a good fit.

    Returns the pairs exchanged, the channel left out or None, and the fit. Nothing is exchanged or
    left out where the fit is good without, or where neither makes the fit good. The arguments are
    those of `fit_contacts`.
    """
    columns = _columns(expected, protocol)
    given = _least_squares(values[None], used[None], columns)[0]
    if given.good:
        return (), None, given
    one_less = used & ~np.eye(len(used), dtype=bool)[used]
    without_one = _least_squares(np.repeat(values[None], len(one_less), axis=0), one_less, columns)
    best = min(range(len(without_one)), key=lambda k: without_one[k].misfit)
    pairs = tuple(itertools.combinations(range(protocol.n_electrodes), 2))
    orders = np.array([_exchanged(protocol, pair) for pair in pairs])
    order, swaps = np.arange(len(values)), []
    for _ in range(MOST_SWAPS):
        tried = order[orders]
        fits = _least_squares(values[tried], used[tried], columns)
        k = min(range(len(pairs)), key=lambda k: fits[k].misfit)
        order = tried[k]
        swaps.append(pairs[k])
        if fits[k].good and not (len(swaps) == 1 and without_one[best].misfit < fits[k].misfit):
            return tuple(swaps), None, fits[k]
        if without_one[best].good:
            return (), int(np.flatnonzero(used)[best]), without_one[best]
    return (), None, given


def _columns(expected: Array, protocol: Protocol) -> Array:
    """Design matrix of the unknowns g and r, (measurements, 1 + electrodes)."""
    table = np.array(protocol.table)[:, :2]
    columns = np.zeros((len(expected), 1 + protocol.n_electrodes))
    columns[:, 0] = expected
    columns[np.arange(len(table))[:, None], 1 + table] = np.median(expected)
    return columns


def _unknowns(columns: Array, used: Bools) -> int:
    return int((columns[used] != 0.0).any(axis=0).sum())


def _least_squares(values: Array, used: Bools, columns: Array) -> list[ContactFit]:
    """Fits of the rows of `values` and `used`, (fits, measurements), by weighted least squares."""
    expected, typical = columns[:, 0], float(np.median(columns[:, 0]))
    kept = np.where(used, values, np.nan)
    common = np.nanmedian(kept / expected, axis=1, keepdims=True)
    sizes = np.maximum(values, np.maximum(common, np.finfo(float).eps) * expected)
    weights = np.where(used, 1.0 / sizes**2, 0.0)
    products = (columns[:, :, None] * columns[:, None, :]).reshape(len(expected), -1)
    size = columns.shape[1]
    normal = (weights @ products).reshape(-1, size, size)
    normal += _REGULARISATION * np.diag(np.arange(size) > 0) * normal[:, :1, :1]
    found = np.linalg.solve(normal, ((weights * values) @ columns)[:, :, None])[:, :, 0]
    square = (weights * (values - found @ columns.T) ** 2).sum(axis=1)
    freedom = used.sum(axis=1) - _unknowns(columns, np.asarray(used.any(axis=0)))
    rms = np.sqrt(square / np.maximum(freedom, 1))
    return [
        ContactFit(float(x[0]), x[1:] * typical, float(each))
        for x, each in zip(found, rms, strict=True)
    ]


def _exchanged(protocol: Protocol, pair: tuple[int, int]) -> list[int]:
    """Number of the measurement in place of each, with two electrodes exchanged."""
    a, b = pair
    number = {frozenset(row[:2]): k for k, row in enumerate(protocol.table)}
    turned = {a: b, b: a}
    return [
        number.get(frozenset(turned.get(e, e) for e in row[:2]), k)
        for k, row in enumerate(protocol.table)
    ]
