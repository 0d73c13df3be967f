"""Frames of sensors with one fault each, at every place where it can be."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.frame import Frame, Status
from eitskin.hardware.diagnosis.checked_frames import FindingKind
from eitskin.hardware.diagnosis.sensor_check import SensorCheck
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME
from eitskin.simulator.instrument.instrument import Instrument

FRAMES = 16
STRAY = -39.8e3j
"""What an open lead measures: 100 pF at 40 kHz [ohm]."""
SERIES = (100.0, 150.0, 300.0, 2000.0)
"""Of bad contacts [ohm]; a good one has about 60."""

Complex = NDArray[np.complex128]
PROTOCOL = Protocol.pairwise(8)
PAIRS = tuple(itertools.combinations(range(8), 2))


@dataclass(frozen=True, slots=True, eq=False)
class FaultCase:
    """Frames with one fault.

    Attributes:
        name: of the fault.
        what: must be found.
        electrodes, channels: where, those that are not empty.
        truth: noise-free impedances, (frames, pairs) [ohm].
        status: (frames, pairs).
        after: what the board does to the values.
        factor: that it gets them wrong by.
    """

    name: str
    what: FindingKind
    truth: Complex
    electrodes: tuple[int, ...] = ()
    channels: tuple[int, ...] = ()
    status: NDArray[np.uint8] | None = None
    after: str = ""
    factor: float = 1.0

    def alone(self, check: SensorCheck) -> bool:
        """Whether the fault, at its place, is the only finding."""
        if len(check.findings) != 1:
            return False
        (found,) = check.findings
        same = (found.what, found.electrodes) == (self.what, self.electrodes)
        return same and (not self.channels or found.channels == self.channels)


def touching(electrode: int) -> NDArray[np.bool_]:
    """Pairs that an electrode takes part in."""
    return np.array([electrode in pair for pair in PAIRS])


def shorted(flat: Complex, pair: tuple[int, int], wire: float = 0.5) -> Complex:
    """Pairwise impedances when `wire` [ohm] joins two electrodes.

    Pairwise resistances R fix the impedance matrix Z = -(1/2) C R C, with C the centring matrix;
    by Sherman and Morrison it loses Z e e^T Z / (wire + e^T Z e), with e = 1 at one, -1 at the
    other electrode.
    """
    R = np.zeros((8, 8), dtype=complex)
    for (a, b), value in zip(PAIRS, flat, strict=True):
        R[a, b] = R[b, a] = value
    C = np.eye(8) - 1.0 / 8.0
    Z = -0.5 * C @ R @ C
    difference = Z[:, pair[0]] - Z[:, pair[1]]
    Z = Z - np.outer(difference, difference) / (wire + difference[pair[0]] - difference[pair[1]])
    return PROTOCOL.measure(Z).astype(complex)


def cases(flat: Complex, rng: np.random.Generator) -> Iterator[FaultCase]:
    """Cases of every fault at every position, on a sensor of noise-free values (pairs,)."""
    still = np.repeat(flat[None], FRAMES, axis=0)
    for e in range(8):
        yield from _at_electrode(still, e)
    for k, pair in enumerate(PAIRS):
        a, b = pair
        turned = {a: b, b: a}
        order = [PAIRS.index(tuple(sorted(turned.get(e, e) for e in each))) for each in PAIRS]
        yield FaultCase("swapped electrodes", FindingKind.SWAPPED, still[:, order], pair)
        joined = np.repeat(shorted(flat, pair)[None], FRAMES, axis=0)
        yield FaultCase("shorted pair", FindingKind.SHORT, joined, pair)
        yield from _at_channel(still, k, rng)
    for factor in (0.2, 5.0, 50.0):
        yield FaultCase("wrong RTIA or RCAL", FindingKind.FACTOR, still, factor=factor)
    yield FaultCase("phase off by 30 deg", FindingKind.PHASE, still * np.exp(1j * np.deg2rad(30.0)))
    yield FaultCase("frozen", FindingKind.FROZEN, still, after="frozen")


def _at_electrode(still: Complex, e: int) -> Iterator[FaultCase]:
    opened, status = still.copy(), np.zeros(still.shape, np.uint8)
    opened[:, touching(e)] = STRAY
    yield FaultCase("open electrode, not marked", FindingKind.OPEN, opened, (e,))
    status[:, touching(e)] = Status.OPEN
    yield FaultCase("open electrode, marked", FindingKind.OPEN, opened, (e,), status=status)
    for ohm in SERIES:
        worse = still + ohm * touching(e)
        yield FaultCase(f"bad contact, {ohm:g} ohm", FindingKind.BAD_CONTACT, worse, (e,))


def _at_channel(still: Complex, k: int, rng: np.random.Generator) -> Iterator[FaultCase]:
    one = np.arange(len(PAIRS)) == k
    status = np.zeros(still.shape, np.uint8)
    status[:, k] = Status.CLIPPED
    yield FaultCase("stuck channel", FindingKind.STUCK, still, channels=(k,), after="stuck")
    yield FaultCase(
        "channel not finite", FindingKind.NOT_FINITE, still, channels=(k,), after="not finite"
    )
    yield FaultCase(
        "clipped channel", FindingKind.CLIPPED, still * (1 - 0.3 * one), (), (k,), status
    )
    noisy = still * (1 + 0.01 * one * rng.standard_normal(still.shape))
    yield FaultCase("noisy channel, 1 %", FindingKind.NOISY, noisy, channels=(k,))
    yield FaultCase(
        "channel off by 10 %", FindingKind.MISFIT, still * (1 + 0.1 * one), channels=(k,)
    )


def measured(case: FaultCase, rng: np.random.Generator, full_scale: float) -> list[Frame]:
    """Frames of a case as the board gives them."""
    session = Instrument.ad5940().session(PROTOCOL, full_scale, rng)
    times = len(PAIRS) * MEASUREMENT_TIME * np.arange(FRAMES, dtype=np.float64)
    impedance, status = session.measure(case.truth, times, rng)
    impedance = impedance * case.factor
    if case.status is not None:
        status = status | case.status
    if case.after == "frozen":
        impedance[:] = impedance[0]
    elif case.after == "stuck":
        impedance[:, case.channels] = impedance[0, case.channels]
    elif case.after == "not finite":
        impedance[:, case.channels] = complex(np.nan, np.nan)
    return [
        Frame(each, PROTOCOL, time, number, status=bits)
        for number, (each, time, bits) in enumerate(zip(impedance, times, status, strict=True))
    ]
