"""Sensor check: faults of a sensor and its wires in a few frames of it, flat and untouched.

Made for protocols that sense where they drive, every pair once. Their values have the form
R_ij = g E_ij + r_i + r_j with expected resistances E, a factor g common to the layer and
resistances r in series with the electrodes: g and r are separable, and wrong wiring fits no g and r
at all. Series resistances add exactly, by Kirchhoff's laws; the common factor is an approximation,
limited by the electrode positions and the board's paths. Other protocols have no such findings.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.frame import Frame, Status
from eitskin.hardware.diagnosis.checked_frames import (
    SHORT,
    Bools,
    CheckedFrames,
    Finding,
    FindingKind,
    channel_names,
    checked_frames,
    electrodes_at_fault,
    find_frozen,
    finding,
    findings_by_electrode,
    unsteady,
)
from eitskin.protocol import Protocol

# Each limit lies beyond the values of 400 simulated healthy sensors.
FACTOR = 2.0
"""Ratio of all values to the expected ones; gels differ by 1.5, resistors of RTIA by 2 or more."""
BAD_CONTACT = 0.12
"""Resistance in series with one electrode, as a share of the median expected resistance."""
MIN_LAYER = 0.1
"""Share of the layer in the values, below which they are those of contacts or of nothing."""
PHASE_DEG = 10.0
OTHER_VALUES = 1.2
"""Factor that half of the channels of four terminals are off by in another sensor or wiring."""
MODEL_ERROR = 0.004
"""Relative model error of a value, rms: electrode positions and board paths, 0.3 % each."""
MAX_CHI2 = 6.0
"""Largest reduced chi-square of a good fit; nearly all healthy sensors stay below 3.5, swapped
wires begin at 9."""
MAX_SWAPS = 3
_REGULARISATION = 1e-6  # of series resistances that no channel separates
_SPARE_MEASUREMENTS = 4  # least number of measurements beyond the unknowns

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SensorCheck:
    """Findings of a sensor check; none for a healthy sensor.

    Example:
        >>> from itertools import islice
        >>> from eitskin.hardware import check_sensor, open_board
        >>> with open_board("virtual:?speed=max&resolution=coarse") as board:
        ...     frames = list(islice(board.frames(), 8))
        >>> len(check_sensor(frames, abs(frames[0].impedance)).findings)
        0
    """

    findings: tuple[Finding, ...]

    @property
    def healthy(self) -> bool:
        """Whether there are no findings."""
        return not self.findings


def check_sensor(frames: Sequence[Frame], expected: ArrayLike) -> SensorCheck:
    """Findings in frames of a sensor that lies flat and untouched.

    Electrodes permuted by a symmetry of the sensor (its plug turned round) give the frames of a
    healthy one: no check of the untouched sensor can show.

    Args:
        frames: frames of one protocol, in their order; 16 are good, fewer than 8 do not show noise.
        expected: magnitudes of a healthy sensor of this design, (measurements,) [ohm].

    Raises:
        FrameError: for no frames, or frames of several protocols.
        ConfigurationError: for expected values of another shape, or not finite and positive.

    Example:
        >>> from itertools import islice
        >>> from eitskin.hardware import check_sensor, open_board
        >>> faulty = "virtual:?speed=max&resolution=coarse&faults=open_electrode@0:3"
        >>> with open_board(faulty) as board:
        ...     frames = list(islice(board.frames(), 8))
        >>> from eitskin import Scene, SensorDesign, Simulator
        >>> expected = abs(Simulator(SensorDesign.reference(), "coarse").measure(Scene()).impedance)
        >>> [(each.what, each.electrodes) for each in check_sensor(frames, expected).findings]
        [(<FindingKind.OPEN: 'open'>, (3,))]
    """
    checked = checked_frames(tuple(frames), np.asarray(expected, dtype=np.float64))
    opened = checked.open_circuits
    remaining = checked.usable & ~opened
    findings = [*board_flags(checked), *find_frozen(checked)]
    if opened.all():
        text = "no electrode is connected: check the plug between sensor and board"
        electrodes = range(checked.protocol.n_electrodes)
        return SensorCheck((*findings, finding(FindingKind.OPEN, opened, text, *electrodes)))
    loose, channels = electrodes_at_fault(opened, checked.protocol)
    for e in loose:
        text = f"electrode {e} is open: press its wire into the gel, check plug {e}"
        findings.append(finding(FindingKind.OPEN, checked.with_electrode(e), text, e))
    for k in channels:
        text = f"channel {checked.protocol.labels[k]} is open though its electrodes are not: check "
        findings.append(Finding(FindingKind.OPEN, (), (k,), f"{text}its multiplexer path"))
    if remaining.any():
        changing = list(unsteady(checked, remaining & ~checked.short_circuits))
        steady = _channels_without_change(changing, remaining)
        findings += [*changing, *_wrong_values(checked, steady)]
    return SensorCheck(tuple(findings))


def board_flags(checked: CheckedFrames) -> Iterator[Finding]:
    """Findings of values that are not finite and of status bits."""
    wrong = ~checked.finite.all(axis=0) & ~checked.open_circuits
    words = "gives values that are no numbers"
    remedy = "the board divides by a current of zero: check these wires, then the firmware"
    yield from findings_by_electrode(FindingKind.NOT_FINITE, wrong, checked, words, remedy)
    wrong = checked.channels_with_status(Status.CLIPPED) & ~checked.short_circuits
    remedy = "lower the excitation, or RTIA, in the firmware"
    yield from findings_by_electrode(FindingKind.CLIPPED, wrong, checked, "is clipped", remedy)
    words_by_status = {
        Status.UNCALIBRATED: "is not calibrated: calibrate the board",
        Status.DFT_TIMEOUT: "timed out: restart the board",
        Status.FIFO_OVERFLOW: "overran the board's memory: restart the board",
    }
    for bit, words in words_by_status.items():
        if (wrong := checked.channels_with_status(bit)).any():
            text = f"the board says that {channel_names(wrong, checked)} {words}"
            yield finding(FindingKind.BOARD, wrong, text)


def _wrong_values(checked: CheckedFrames, remaining: Bools) -> Iterator[Finding]:
    """Findings of steady values that are not those of this design."""
    shorted = remaining & checked.short_circuits
    for (a, b), channels in _group_by_drive_pair(shorted, checked).items():
        text = (
            f"electrodes {a} and {b} are shorted: look for wires that touch, or a bridge of gel "
            f"or solder between plugs {a} and {b}"
        )
        yield Finding(FindingKind.SHORT, (min(a, b), max(a, b)), tuple(channels), text)
    if (remaining := remaining & ~shorted).any():
        yield from _wrong_phase(checked, remaining)
        # A short changes what all other pairs should be.
        own = not shorted.any() and checked.senses_where_it_drives.all()
        fit = fit_contacts(checked, remaining) if own else None
        ratio = float(np.median(checked.ratio[remaining]))
        scale = fit.scale if fit and fit.good else ratio
        if fit and fit.good and fit.scale < MIN_LAYER * ratio:
            values = np.abs(checked.value[remaining])
            text = (
                f"the values hardly depend on the sensor's layer, {values.min():.4g} to "
                f"{values.max():.4g} ohm for all channels: constant or made-up values, contacts "
                "far above the layer, or another sensor; check what the board measures"
            )
            yield finding(FindingKind.MISFIT, remaining, text)
            return
        if not checked.senses_where_it_drives.any():
            # Small values between neighbours change manifold with the places of electrodes.
            large = checked.expected > SHORT * float(np.sqrt(np.mean(checked.expected**2)))
            own_ratio = checked.ratio[remaining & large & (checked.ratio > 0.0)]
            known = len(own_ratio) and scale
            off = float(np.median(np.abs(np.log(own_ratio / scale)))) if known else 0.0
            if off > np.log(OTHER_VALUES):
                if not shorted.any():
                    yield _other_wiring(off, checked, remaining)
                return
        if not 1.0 / FACTOR <= scale <= FACTOR:
            text = (
                f"all values are {scale:.2g} times what this design gives: check RTIA and RCAL in "
                "the firmware, and that this is the sensor that the model is for"
            )
            yield finding(FindingKind.FACTOR, remaining, text)
        else:
            scale = 1.0
        if fit and scale > 0.0:
            yield from _wrong_contacts(
                dataclasses.replace(checked, impedance=checked.impedance / scale), remaining
            )


def _group_by_drive_pair(wrong: Bools, checked: CheckedFrames) -> dict[tuple[int, int], list[int]]:
    """Wrong channels by the pair that they drive, in the order of the first of each pair."""
    channels_by_pair: dict[frozenset[int], list[int]] = {}
    for k in np.flatnonzero(wrong).tolist():
        channels_by_pair.setdefault(frozenset(checked.protocol.table[k][:2]), []).append(k)
    return {checked.protocol.table[ks[0]][:2]: ks for ks in channels_by_pair.values()}


def _other_wiring(off: float, checked: CheckedFrames, rest: Bools) -> Finding:
    """Finding of channels that no common factor brings to the expected values."""
    text = (
        f"half of the channels are off by more than {100 * (np.exp(off) - 1):.0f} % after one "
        f"common factor, most of all {checked.protocol.labels[int(checked.ratio.argmax())]}: "
        "another sensor or board, or electrodes in another order; compare the order of the plugs "
        "with the model's"
    )
    return finding(FindingKind.MISFIT, rest, text)


def _wrong_contacts(checked: CheckedFrames, rest: Bools) -> Iterator[Finding]:
    """Findings of swapped wires, odd channels and resistances in series."""
    swaps, odd, fit = corrected_wiring(checked, rest)
    for a, b in swaps:
        through = (checked.with_electrode(a) != checked.with_electrode(b)) & rest
        text = f"electrodes {a} and {b} are swapped: exchange plugs {a} and {b}"
        yield finding(FindingKind.SWAPPED, through, text, a, b)
    if odd is not None:
        name = checked.protocol.labels[odd]
        text = f"channel {name} does not fit the others: check its multiplexer path"
        yield Finding(FindingKind.MISFIT, (), (odd,), text)
    if not fit.good:
        text = (
            f"the values are those of another sensor or wiring, off by {100 * fit.misfit:.1f} % "
            "after contacts are allowed for: lay it flat and untouched, compare the order of the "
            "plugs with the model's"
        )
        yield finding(FindingKind.MISFIT, rest, text)
        return
    for e in np.flatnonzero(fit.series > BAD_CONTACT * np.median(checked.expected)).tolist():
        text = (
            f"electrode {e} has a bad contact, {fit.series[e]:.0f} ohm more than usual in series: "
            f"clean it and wet it, press its wire into the gel, check plug {e}"
        )
        yield finding(FindingKind.BAD_CONTACT, checked.with_electrode(e) & rest, text, e)


def _wrong_phase(checked: CheckedFrames, remaining: Bools) -> Iterator[Finding]:
    """Findings of phases that no gel has, where the sign of a value is known."""
    if not (remaining := remaining & checked.senses_where_it_drives).any():
        return
    turned = checked.value / np.maximum(np.abs(checked.value), np.finfo(float).tiny)
    common = np.median(turned.real[remaining]) + 1j * np.median(turned.imag[remaining])
    if abs(angle := float(np.angle(common, deg=True))) > PHASE_DEG:
        text = (
            f"all phases are off by {angle:.0f} deg: calibrate the board against RCAL; near 180 "
            "deg its two sense leads are exchanged"
        )
        yield finding(FindingKind.PHASE, remaining, text)
        turned = turned / common
    wrong = remaining & (np.abs(np.angle(turned, deg=True)) > PHASE_DEG)
    remedy = "a contact without gel acts as a capacitor: wet it, check its wire"
    yield from findings_by_electrode(FindingKind.PHASE, wrong, checked, "has a wrong phase", remedy)


def _channels_without_change(changing: Sequence[Finding], rest: Bools) -> Bools:
    """Channels of `rest` without a finding of change, unless most of them have one."""
    steady = rest.copy()
    for each in changing:
        if 2 * len(each.channels) < len(rest):
            steady[list(each.channels)] = False
    return steady if steady.any() else rest


@dataclass(frozen=True, slots=True, eq=False)
class ContactFit:
    """Least-squares fit of contacts.

    Attributes:
        scale: g, ratio of the layer to the expected one.
        series: r, unexpected resistance in series with each electrode, (electrodes,) [ohm].
        misfit: root mean square of the relative residuals.
    """

    scale: float
    series: Array
    misfit: float

    @property
    def good(self) -> bool:
        """Whether the misfit is that of a healthy sensor."""
        return bool(self.misfit**2 <= MAX_CHI2 * MODEL_ERROR**2)


def fit_contacts(checked: CheckedFrames, usable: Bools) -> ContactFit | None:
    """Fit of contacts to the channels `usable`, (measurements,), which sense where they drive.

    None for too few channels.
    """
    columns = _columns(checked)
    if usable.sum() < _unknowns(columns, usable) + _SPARE_MEASUREMENTS:
        return None
    return _least_squares(np.abs(checked.value)[None], usable[None], columns)[0]


def corrected_wiring(
    checked: CheckedFrames, usable: Bools
) -> tuple[tuple[tuple[int, int], ...], int | None, ContactFit]:
    """Fewest exchanges of two electrodes, or the one channel left out, that make a good fit.

    Returns the pairs exchanged, the channel left out or None, and the fit. Nothing is exchanged or
    left out where the fit is good without, or where neither makes it good.
    """
    values, protocol, columns = np.abs(checked.value), checked.protocol, _columns(checked)
    given_wiring = _least_squares(values[None], usable[None], columns)[0]
    if given_wiring.good:
        return (), None, given_wiring
    one_less = usable & ~np.eye(len(usable), dtype=bool)[usable]
    without_one = _least_squares(np.repeat(values[None], len(one_less), axis=0), one_less, columns)
    best = min(range(len(without_one)), key=lambda k: without_one[k].misfit)
    pairs = tuple(itertools.combinations(range(protocol.n_electrodes), 2))
    orders = np.array([_exchange_electrodes(protocol, pair) for pair in pairs])
    order, swaps = np.arange(len(values)), []
    for _ in range(MAX_SWAPS):
        tried = order[orders]
        fits = _least_squares(values[tried], usable[tried], columns)
        k = min(range(len(pairs)), key=lambda k: fits[k].misfit)
        order = tried[k]
        swaps.append(pairs[k])
        if fits[k].good and not (len(swaps) == 1 and without_one[best].misfit < fits[k].misfit):
            return tuple(swaps), None, fits[k]
        if without_one[best].good:
            return (), int(np.flatnonzero(usable)[best]), without_one[best]
    return (), None, given_wiring


def _columns(checked: CheckedFrames) -> Array:
    """Design matrix of the unknowns g and r, (measurements, 1 + electrodes)."""
    protocol, expected = checked.protocol, checked.expected
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
    used_values = np.where(used, values, np.nan)
    common = np.nanmedian(used_values / expected, axis=1, keepdims=True)
    sizes = np.maximum(values, np.maximum(common, np.finfo(float).eps) * expected)
    weights = np.where(used, 1.0 / sizes**2, 0.0)
    products = (columns[:, :, None] * columns[:, None, :]).reshape(len(expected), -1)
    size = columns.shape[1]
    normal = (weights @ products).reshape(-1, size, size)
    normal += _REGULARISATION * np.diag(np.arange(size) > 0) * normal[:, :1, :1]
    solution = np.linalg.solve(normal, ((weights * values) @ columns)[:, :, None])[:, :, 0]
    square = (weights * (values - solution @ columns.T) ** 2).sum(axis=1)
    freedom = used.sum(axis=1) - _unknowns(columns, np.asarray(used.any(axis=0)))
    rms = np.sqrt(square / np.maximum(freedom, 1))
    return [
        ContactFit(float(x[0]), x[1:] * typical, float(each))
        for x, each in zip(solution, rms, strict=True)
    ]


def _exchange_electrodes(protocol: Protocol, pair: tuple[int, int]) -> list[int]:
    """Number of the measurement in place of each, with two electrodes exchanged."""
    a, b = pair
    number = {frozenset(row[:2]): k for k, row in enumerate(protocol.table)}
    turned = {a: b, b: a}
    return [
        number.get(frozenset(turned.get(e, e) for e in row[:2]), k)
        for k, row in enumerate(protocol.table)
    ]
