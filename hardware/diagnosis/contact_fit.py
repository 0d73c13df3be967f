"""Resistances in series with the electrodes, from pairwise resistances, by least squares.

R_ij = g E_ij + r_i + r_j, weighted by the size of each value. Series resistances add exactly, by
Kirchhoff's laws; that all else scales with one g is an approximation, good to the places of the
electrodes and the paths of the board.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.protocol import Protocol

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

MODEL_ERROR = 0.004
"""Of a value, rms, where the model holds: electrode places and paths of the board, 0.3 % each."""
LARGEST_CHI2 = 6.0
"""Largest reduced chi-square of a good fit; nearly all healthy sensors stay below 3.5, swapped
wires begin at 9."""
MOST_SWAPS = 3
_REGULARISATION = 1e-6  # against series resistances that no channel tells apart
_SPARE_MEASUREMENTS = 4  # measurements that there must be beyond the unknowns


@dataclass(frozen=True, slots=True, eq=False)
class ContactFit:
    """What explains the values best.

    Attributes:
        scale: g, between the layer and the expected one.
        series: r, (electrodes,) [ohm], beyond what is expected of each.
        misfit: root mean square of what is left, relative.
    """

    scale: float
    series: Array
    misfit: float

    @property
    def good(self) -> bool:
        """Whether what is left may be that of a healthy sensor."""
        return bool(self.misfit**2 <= LARGEST_CHI2 * MODEL_ERROR**2)


def fit_contacts(
    values: Array, expected: Array, used: Bools, protocol: Protocol
) -> ContactFit | None:
    """Fit the channels `used`, (measurements,); None where they are too few to tell.

    Args:
        values: magnitudes, (measurements,) [ohm].
        expected: of a healthy sensor, (measurements,) [ohm].
        used: channels that take part, (measurements,).
        protocol: that senses where it drives.
    """
    columns = _columns(expected, protocol)
    if used.sum() < _unknowns(columns, used) + _SPARE_MEASUREMENTS:
        return None
    return _least_squares(values[None], used[None], columns)[0]


def corrected_wiring(
    values: Array, expected: Array, used: Bools, protocol: Protocol
) -> tuple[tuple[tuple[int, int], ...], int | None, ContactFit]:
    """The fewest exchanges of two electrodes, or the one channel left out, that make a good fit.

    Nothing, where it is good already. Returns the pairs exchanged, the channel left out or None,
    and the fit, which is not good where neither helps; then nothing is exchanged or left out. The
    arguments are `fit_contacts`'s.
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
    """What each unknown contributes to each value, (measurements, 1 + electrodes)."""
    table = np.array(protocol.table)[:, :2]
    columns = np.zeros((len(expected), 1 + protocol.n_electrodes))
    columns[:, 0] = expected
    columns[np.arange(len(table))[:, None], 1 + table] = np.median(expected)
    return columns


def _unknowns(columns: Array, used: Bools) -> int:
    return int((columns[used] != 0.0).any(axis=0).sum())


def _least_squares(values: Array, used: Bools, columns: Array) -> list[ContactFit]:
    """One fit for each row of values and channels, (fits, measurements)."""
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
    """Which measurement stands in for each where two electrodes are exchanged."""
    a, b = pair
    number = {frozenset(row[:2]): k for k, row in enumerate(protocol.table)}
    turned = {a: b, b: a}
    return [
        number.get(frozenset(turned.get(e, e) for e in row[:2]), k)
        for k, row in enumerate(protocol.table)
    ]
