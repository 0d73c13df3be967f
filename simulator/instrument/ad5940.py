"""How the AD5940 turns a current and a voltage into numbers.

Phasors are peak amplitudes; a voltage is held across the drive pair, the current that it sends
comes back through a transimpedance amplifier, and both go through a programmable amplifier, an ADC
and a discrete Fourier transform of 2048 points. Their ratio is the impedance. All numbers are those
of the data sheet.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.frame import Status

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

FREQUENCY = 40e3
"""Of the excitation [Hz]."""

MEASUREMENT_TIME = 10.6e-3
"""One pair of transforms, of voltage and current, at an oversampling ratio of 2 [s]."""

EXCITATIONS = (0.607, 0.121, 0.075, 0.015)
"""Amplitudes that the excitation amplifier has [V]."""

PGA_RANGES = (0.133, 0.3, 0.6, 0.9)
"""Amplitudes that the ADC takes at the gains of its programmable amplifier [V]."""

TIA_LIMIT = 3e-3
"""Largest current amplitude of the transimpedance amplifier [A]."""

TRANSIMPEDANCES = (200.0, 1e3, 5e3, 10e3, 20e3, 40e3, 80e3, 160e3)
"""Resistors of the transimpedance amplifier, RTIA [ohm]."""

CODES = 2**17
"""Codes from zero to full range: a transform gives 18 bits, of which one is the sign."""

SHORT = 1e-3
"""Anything below is a short circuit [ohm], so that no current is infinite."""


@dataclass(frozen=True, slots=True)
class FrontEnd:
    """What happens between the sensor and the numbers; the attributes are `Instrument`'s.

    Attributes:
        floor: sd of the noise, per quadrature of the voltage [V].
        quantisation: whether voltage and current are rounded to codes.
        clipping: whether they are cut off.
        excitation: amplitude [V]; 0 for the largest that fits.
        pga_range: of the ADC [V]; 0 for the smallest that fits.
        rtia: resistor that turns the current into a voltage [ohm].
    """

    floor: float
    quantisation: bool
    clipping: bool
    excitation: float
    pga_range: float
    rtia: float

    def convert(
        self, impedance: Complex, driven: Complex, rng: np.random.Generator
    ) -> tuple[Complex, NDArray[np.uint8]]:
        """Impedances [ohm] as they are read, and their status.

        A current that rounds to nothing counts as one code, so that an open pair reads as the
        largest impedance that there is, with LOW_CURRENT, and not as infinity.

        Args:
            impedance: V / I of each measurement, of any shape, complex [ohm].
            driven: impedance of the pair that is driven for it [ohm].
            rng: of the noise floor.
        """
        status = np.zeros(impedance.shape, np.uint8)
        if not (self.floor or self.quantisation or self.clipping):
            return impedance, status
        widest = self.pga_range or PGA_RANGES[-1]
        through = current(impedance, driven, self.rtia, self.excitation, widest)
        # Both are converted as voltages, each at a gain of its own: V, then I RTIA.
        pair = [through * impedance, through * self.rtia]
        if self.floor:
            noise = self.floor * rng.standard_normal((2, *impedance.shape))
            pair[0] = pair[0] + noise[0] + 1j * noise[1]
        ranges = [pga_range(each, self.pga_range) for each in pair]
        if self.clipping:
            limits = [ranges[0], np.minimum(ranges[1], TIA_LIMIT * self.rtia)]
            for each, limit in zip(pair, limits, strict=True):
                status[np.abs(each) > limit] |= np.uint8(Status.CLIPPED)
            pair = [clipped(*each) for each in zip(pair, limits, strict=True)]
        if self.quantisation:
            pair = [quantised(*each) for each in zip(pair, ranges, strict=True)]
            lost = pair[1] == 0.0
            status[lost] |= np.uint8(Status.LOW_CURRENT)
            pair[1] = np.where(lost, ranges[1] / CODES, pair[1])
        read: Complex = pair[0] / pair[1] * self.rtia
        return read, status


def shunted(impedance: Complex, driven: Complex, capacitance: Array) -> Complex:
    """Impedances [ohm] with a stray capacitance [F] across the pair that is driven.

    Of the current I, the part 1 / (1 + j w C Z_d) flows through the sensor, whose drive pair has
    the impedance Z_d = `driven` [ohm]; what a measurement V / I shows is smaller by that. Where the
    drive pair is the sense pair that is the parallel connection Z / (1 + j w C Z).
    """
    shown: Complex = impedance / (1.0 + 2j * np.pi * FREQUENCY * capacitance * driven)
    return shown


def current(
    impedance: Complex,
    driven: Complex,
    rtia: float,
    excitation: float = 0.0,
    widest: float = PGA_RANGES[-1],
) -> Complex:
    """The current [A] through drive pairs of impedance `driven` [ohm].

    The excitation is a fixed one [V], or with 0 the largest at which neither the current, through
    `rtia` [ohm], nor the voltage across the sense pair, of transfer `impedance` [ohm], is beyond
    the `widest` range [V]; the smallest, where none is small enough.
    """
    size = np.abs(driven)
    driven = np.where(size < SHORT, SHORT, driven)
    if excitation:
        chosen: Array = np.array(excitation)
    else:
        through = np.divide.outer(EXCITATIONS, np.abs(driven))
        fits = through <= min(TIA_LIMIT, widest / rtia)
        fits &= through * np.abs(impedance) <= widest
        first = np.where(fits.any(axis=0), fits.argmax(axis=0), len(EXCITATIONS) - 1)
        chosen = np.array(EXCITATIONS)[first]
    phasor: Complex = chosen / driven
    return phasor


def pga_range(voltage: Complex, fixed: float = 0.0) -> Array:
    """A fixed range, or with 0 the smallest that takes each phasor, else the largest [V]."""
    if fixed:
        return np.full(voltage.shape, fixed)
    place = np.searchsorted(PGA_RANGES, np.abs(voltage))
    chosen: Array = np.array(PGA_RANGES)[np.minimum(place, len(PGA_RANGES) - 1)]
    return chosen


def clipped(phasor: Complex, limit: Array) -> Complex:
    """What the transform shows of a sine that is cut off at -+`limit`; unchanged within it.

    The fundamental of a clipped sine of amplitude A is (2 / pi) (asin r + r sqrt(1 - r^2)) A with
    r = limit / A, the describing function of saturation (Gelb and Vander Velde 1968). It rises to
    that of a square wave, 4 / pi times the limit.
    """
    size = np.abs(phasor)
    r = np.divide(limit, size, out=np.ones(size.shape), where=size > limit)
    part = 2.0 / np.pi * (np.arcsin(r) + r * np.sqrt(1.0 - r * r))
    shown: Complex = np.where(size > limit, part, 1.0) * phasor
    return shown


def quantised(phasor: Complex, full_range: Array) -> Complex:
    """Real and imaginary part each rounded to a code: multiples of `full_range` / 2^17."""
    step = full_range / CODES
    codes: Complex = np.round(phasor.real / step) + 1j * np.round(phasor.imag / step)
    return codes * step
