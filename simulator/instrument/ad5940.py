"""Signal chain of the AD5940: excitation, amplifiers, clipping and quantisation.

Phasors are peak amplitudes. A voltage is applied across the drive pair, and the resulting current
returns through a transimpedance amplifier. Voltage and current both pass a programmable-gain
amplifier (PGA), an ADC and a discrete Fourier transform of 2048 points; the ratio of the two
transforms is the impedance. All numbers are those of the data sheet.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.frame import Status
from eitskin.geometry.design.dispersion import FREQUENCY

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

MEASUREMENT_TIME = 10.6e-3
"""Duration of one measurement: transforms of voltage and current, at an oversampling of 2 [s]."""

EXCITATIONS = (0.607, 0.121, 0.075, 0.015)
"""Amplitudes of the excitation amplifier [V]."""

PGA_RANGES = (0.133, 0.3, 0.6, 0.9)
"""Full-scale amplitudes of the ADC at the gains of the programmable-gain amplifier [V]."""

TIA_LIMIT = 3e-3
"""Largest current amplitude of the transimpedance amplifier [A]."""

TRANSIMPEDANCES = (200.0, 1e3, 5e3, 10e3, 20e3, 40e3, 80e3, 160e3)
"""Feedback resistors of the transimpedance amplifier, RTIA [ohm]."""

CODES = 2**17
"""Number of codes from zero to full scale: a transform has 18 bits, one of them the sign."""

SHORT_CIRCUIT = 1e-3
"""Smallest impedance of a drive pair [ohm], so that no current is infinite."""


@dataclass(frozen=True, slots=True)
class FrontEnd:
    """Excitation, amplifiers and ADC, with the settings of an `Instrument`.

    Attributes:
        floor: standard deviation of the noise, per quadrature of the voltage [V].
        quantisation: whether voltage and current are rounded to codes.
        clipping: whether voltage and current are clipped to their ranges.
        excitation: amplitude [V]; 0 for the largest that fits.
        pga_range: full scale of the ADC [V]; 0 for the smallest that fits.
        rtia: feedback resistor of the transimpedance amplifier [ohm].
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
        """Impedances as read [ohm], and their status bits, both of the shape of `impedance`.

        A current that rounds to zero counts as one code, so that an open pair reads as the largest
        finite impedance, with LOW_CURRENT, and not as infinity.

        Args:
            impedance: V / I of each measurement, of any shape, complex [ohm].
            driven: impedance of each measurement's drive pair [ohm].
            rng: random generator of the noise floor.
        """
        status = np.zeros(impedance.shape, np.uint8)
        if not (self.floor or self.quantisation or self.clipping):
            return impedance, status
        widest = self.pga_range or PGA_RANGES[-1]
        through = drive_current(impedance, driven, self.rtia, self.excitation, widest)
        # Voltage and current are both converted as voltages, V and I RTIA, each at its own gain.
        pair = [through * impedance, through * self.rtia]
        if self.floor:
            noise = self.floor * rng.standard_normal((2, *impedance.shape))
            pair[0] = pair[0] + noise[0] + 1j * noise[1]
        ranges = [pga_range(each, self.pga_range) for each in pair]
        if self.clipping:
            limits = [ranges[0], np.minimum(ranges[1], TIA_LIMIT * self.rtia)]
            for each, limit in zip(pair, limits, strict=True):
                status[np.abs(each) > limit] |= np.uint8(Status.CLIPPED)
            pair = [clipped_fundamental(*each) for each in zip(pair, limits, strict=True)]
        if self.quantisation:
            pair = [quantise(*each) for each in zip(pair, ranges, strict=True)]
            lost = pair[1] == 0.0
            status[lost] |= np.uint8(Status.LOW_CURRENT)
            pair[1] = np.where(lost, ranges[1] / CODES, pair[1])
        read: Complex = pair[0] / pair[1] * self.rtia
        return read, status


def with_stray_capacitance(impedance: Complex, driven: Complex, capacitance: Array) -> Complex:
    """Impedances [ohm] with a stray capacitance [F] in parallel to the drive pair.

    The part 1 / (1 + j w C Z_d) of the current I flows through the sensor, whose drive pair has the
    impedance Z_d = `driven` [ohm]; a measured V / I is smaller by this factor. Where drive and
    sense pair are the same, the result is the parallel connection Z / (1 + j w C Z).
    """
    measured: Complex = impedance / (1.0 + 2j * np.pi * FREQUENCY * capacitance * driven)
    return measured


def drive_current(
    impedance: Complex,
    driven: Complex,
    rtia: float,
    excitation: float = 0.0,
    widest: float = PGA_RANGES[-1],
) -> Complex:
    """Current phasors [A] through drive pairs of impedance `driven` [ohm].

    With an `excitation` of 0 the largest amplitude is chosen at which the current stays within the
    transimpedance amplifier's limit, and I RTIA and the voltage across the sense pair within
    `widest`; the smallest amplitude where none satisfies these limits.

    Args:
        impedance: transfer impedance from drive to sense pair [ohm].
        driven: impedance of the drive pair [ohm].
        rtia: feedback resistor of the transimpedance amplifier [ohm].
        excitation: fixed amplitude [V], or 0.
        widest: largest full scale of the ADC [V].
    """
    size = np.abs(driven)
    driven = np.where(size < SHORT_CIRCUIT, SHORT_CIRCUIT, driven)
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
    """Full scale of the ADC [V]: a fixed one, or with 0 the smallest that holds each phasor."""
    if fixed:
        return np.full(voltage.shape, fixed)
    index = np.searchsorted(PGA_RANGES, np.abs(voltage))
    chosen: Array = np.array(PGA_RANGES)[np.minimum(index, len(PGA_RANGES) - 1)]
    return chosen


def clipped_fundamental(phasor: Complex, limit: Array) -> Complex:
    """Fundamental of a sine clipped at -+`limit`; the sine's own phasor within the limit.

    The fundamental of a clipped sine of amplitude A is (2 / pi) (asin r + r sqrt(1 - r^2)) A with
    r = limit / A, the describing function of saturation (Gelb and Vander Velde 1968). For large A
    the fundamental tends to that of a square wave, 4 / pi times the limit.
    """
    size = np.abs(phasor)
    r = np.divide(limit, size, out=np.ones(size.shape), where=size > limit)
    part = 2.0 / np.pi * (np.arcsin(r) + r * np.sqrt(1.0 - r * r))
    fundamental: Complex = np.where(size > limit, part, 1.0) * phasor
    return fundamental


def quantise(phasor: Complex, full_range: Array) -> Complex:
    """Phasors with real and imaginary part rounded to codes, multiples of `full_range` / 2^17."""
    step = full_range / CODES
    codes: Complex = np.round(phasor.real / step) + 1j * np.round(phasor.imag / step)
    return codes * step
