"""Fit of a four-terminal meter to frames of a flat, untouched sensor, and choice of its terms."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from eitskin.errors import ConfigurationError, DataError
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.fit_parameters import (
    USUAL,
    Parameter,
    meter_parameters,
    meter_with,
)
from eitskin.simulator.instrument.meter import FourTerminalMeter, Quantity, electrodes_by_role

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

STARTS = 12
TRIAL_STARTS = 4
"""Starting points of each fit without one of the terms."""
MOST_STEPS = 80
"""Most steps from one starting point; more are taken only along what readings hardly show."""
UNDETERMINED = 0.5
"""Standard error of a coordinate (half the range of a load) from which it is not identifiable."""
NULL = 1e-5
"""Singular value, relative to the largest, of directions that no reading depends on."""
ALIKE = 0.005
"""Difference of predicted readings, relative to the largest, below which they are alike."""
INVOLVED = 0.2
"""Least component of a parameter in a null direction for it to be named."""


@dataclass(frozen=True, slots=True, eq=False)
class MeterFit:
    """Fitted meter, its standard errors, and the flat frame that it explains.

    Standard errors are those of linearised least squares, with a variance estimated from the
    residuals: they hold the error of the sensor's model as far as it varies from channel to
    channel.

    Attributes:
        meter: the fitted meter.
        parameters: the numbers that were fitted, beside the scale.
        values: of the parameters, (parameters,), in the parameters' units.
        standard_errors: of the values, (parameters,); infinite for those that are not identifiable.
        scale_error: standard error of the scale, relative.
        tied: groups of parameters of which only a combination shows in the readings.
        predicted: the meter's flat frame, (measurements,).
        measured: mean of the frames that were fitted, (measurements,).
    """

    meter: FourTerminalMeter
    parameters: tuple[Parameter, ...]
    values: Array
    standard_errors: Array
    scale_error: float
    tied: tuple[tuple[str, ...], ...]
    predicted: Complex
    measured: Complex

    @property
    def unidentifiable(self) -> tuple[Parameter, ...]:
        """Parameters that the frames do not determine."""
        lost = ~np.isfinite(self.standard_errors)
        return tuple(p for p, gone in zip(self.parameters, lost, strict=True) if gone)

    @property
    def distinct_readings(self) -> int:
        """Number of different predicted readings; symmetry of the sensor makes many alike.

        As many parameters explain any such readings, whatever the board.
        """
        sizes = np.sort(
            _parts(self.predicted) if self.predicted.imag.any() else self.predicted.real
        )
        return 1 + int((np.diff(sizes) > ALIKE * np.abs(sizes).max()).sum())


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of a predicted flat frame with a measured one.

    Attributes:
        r: correlation coefficient over the channels.
        residual: norm of the difference over the norm of the measured frame.
    """

    r: float
    residual: float


def agreement(predicted: ArrayLike, measured: ArrayLike) -> Agreement:
    """Agreement of two frames, (measurements,) each; imaginary parts, where any, count alike."""
    both = np.array([predicted, measured], np.complex128)
    p, m = _parts(both) if both.imag.any() else both.real
    spread = np.std(p) * np.std(m)
    r = float(np.mean((p - p.mean()) * (m - m.mean())) / spread) if spread else 0.0
    return Agreement(r, float(np.linalg.norm(p - m) / np.linalg.norm(m)))


def fit_meter(
    impedance: NDArray[np.inexact],
    protocol: Protocol,
    frames: ArrayLike,
    terms: Sequence[str] = USUAL,
    reads: Quantity | None = None,
    seed: int = 0,
    starts: int = STARTS,
) -> MeterFit:
    """Meter that explains frames of the flat, untouched sensor, by nonlinear least squares.

    The scale is a linear parameter and is eliminated (variable projection, Golub and Pereyra 1973).
    The loads found are relative to the sensor's: a sensor of twice the conductivity with twice the
    loads gives the same frames at half the scale.

    Args:
        impedance: electrode impedance matrix of the flat sensor, (electrodes, electrodes) [ohm].
        protocol: drive and sense electrodes of the channels.
        frames: readings of the flat, untouched sensor, (frames, measurements), in any unit.
        terms: terms to fit beside the scale, of `FITTED`; without any, the meter is ideal but for
            its scale.
        reads: what the readings are; when omitted "complex" where they have imaginary parts, else
            "signed" where some are negative, else "magnitude".
        seed: seed of the starting points.
        starts: number of starting points; the sum of squares has several minima.

    Raises:
        ConfigurationError: for an unknown term, or as many parameters as readings.
        DataError: for frames of another protocol, or that are not finite.
    """
    measured = _mean_frame(frames, protocol)
    quantity: Quantity = reads or _quantity(measured)
    is_complex = quantity == "complex"
    typical = float(np.median(np.abs(np.diag(impedance))))
    parameters = meter_parameters(terms, protocol.n_electrodes, typical, complex_terms=is_complex)
    readings = len(measured) * (1 + is_complex)
    if len(parameters) + 2 >= readings:
        raise ConfigurationError(
            f"{len(parameters) + 1} parameters cannot be fitted to {readings} readings; fit fewer "
            "terms"
        )
    problem = MeterProblem(
        FourTerminalMeter(reads=quantity),
        parameters,
        np.asarray(impedance),
        protocol,
        _parts(measured) if is_complex else measured.real,
    )
    coordinates = problem.minimum(np.random.default_rng(seed), starts)
    meter = problem.meter(coordinates)
    scale = problem.scale(problem.unscaled(coordinates))
    meter = dataclasses.replace(meter, scale=scale, offset=scale * meter.offset)
    errors, tied = problem.uncertainty(coordinates)
    both = list(zip(parameters, coordinates, strict=True))
    slopes = np.array([p.slope(float(x)) for p, x in both])
    predicted, _ = meter.reading(meter.transfer_impedance(impedance, protocol))
    return MeterFit(
        meter=meter,
        parameters=parameters,
        values=np.array([p.number(float(x)) for p, x in both]),
        standard_errors=errors[:-1] * slopes,
        scale_error=float(errors[-1]),
        tied=tied,
        predicted=predicted,
        measured=measured,
    )


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
    fit = partial(fit_meter, impedance, protocol, frames, reads=reads, seed=seed)
    best = fit(terms, starts=starts)
    left, starts = list(dict.fromkeys(terms)), min(starts, TRIAL_STARTS)
    while left:
        trials = {
            term: fit([each for each in left if each != term], starts=starts) for term in left
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


@dataclass(frozen=True, slots=True, eq=False)
class MeterProblem:
    """Least-squares problem in the coordinates of the parameters.

    Attributes:
        start: meter with the terms that are not fitted.
        parameters: numbers that are fitted.
        impedance: electrode impedance matrix of the flat sensor [ohm].
        protocol: drive and sense electrodes of the channels.
        target: measured readings, real and imaginary parts one after the other where complex.
    """

    start: FourTerminalMeter
    parameters: tuple[Parameter, ...]
    impedance: NDArray[np.inexact]
    protocol: Protocol
    target: Array

    def meter(self, coordinates: Array) -> FourTerminalMeter:
        """Meter of scale 1 for the coordinates (parameters,)."""
        n = self.protocol.n_electrodes
        return meter_with(self.start, self.parameters, coordinates, n)

    def unscaled(self, coordinates: Array) -> Complex:
        """Readings of the meter of scale 1 (measurements,)."""
        meter = self.meter(coordinates)
        return meter.reading(meter.transfer_impedance(self.impedance, self.protocol))[0]

    def scale(self, unscaled: Complex) -> complex:
        """Scale of least squares; real and, for magnitudes, positive where readings are real."""
        square = float(np.vdot(unscaled, unscaled).real) or 1.0
        if self.start.reads != "complex":
            return float(unscaled.real @ self.target) / square or 1.0
        return complex(np.vdot(unscaled, self._readings) / square)

    def residual(self, coordinates: Array) -> Array:
        """Residual over the norm of the target, at the scale of least squares (readings,)."""
        unscaled = self.unscaled(coordinates)
        difference = self._as_target(self.scale(unscaled) * unscaled) - self.target
        return np.asarray(difference / np.linalg.norm(self.target))

    def minimum(self, rng: np.random.Generator, starts: int) -> Array:
        """Coordinates of the least minimum found from several starting points."""
        if not self.parameters:
            return np.zeros(0)
        low, high = np.array([p.bounds for p in self.parameters]).T
        share = np.array([p.is_share for p in self.parameters])
        best, least = np.zeros(len(share)), np.inf
        for number in range(starts):
            # Loads over decades: most of them are far from the sensor's own impedance.
            drawn = 10.0 ** rng.uniform(-4.0, 3.0 if number else -3.0, len(share))
            first = np.where(
                share, drawn / (1.0 + drawn), rng.normal(size=len(share)) * (number > 0)
            )
            first = np.clip(first, low + 1e-9, high - 1e-9)
            found = least_squares(
                self.residual, first, self.jacobian, bounds=(low, high), max_nfev=MOST_STEPS
            )
            if found.cost < least * (1.0 - 1e-9):
                best, least = found.x, found.cost
        return np.asarray(best)

    def uncertainty(self, coordinates: Array) -> tuple[Array, tuple[tuple[str, ...], ...]]:
        """Standard errors of coordinates and log scale, and groups of tied parameters.

        A direction of the parameters along which the standard error is beyond `UNDETERMINED` ties
        its parameters, whose standard errors are infinite.
        """
        unscaled = self.unscaled(coordinates)
        reading = self.scale(unscaled) * unscaled
        scale = self.scale(unscaled)
        columns = [*(scale * each for each in self._changes(coordinates)), reading]
        if self.start.reads == "complex":
            columns.append(1j * reading)  # the phase of the scale
        norm = float(np.linalg.norm(self.target))
        J = np.array([self._as_target(column) / norm for column in columns]).T
        freedom = max(len(self.target) - J.shape[1], 1)
        noise = np.linalg.norm(self.residual(coordinates)) / np.sqrt(freedom)
        _, sizes, directions = np.linalg.svd(J, full_matrices=False)
        spread = noise / np.maximum(sizes, np.finfo(float).tiny)
        lost = (spread > UNDETERMINED) | (sizes < NULL * sizes[0])
        errors = np.sqrt(((spread[~lost, None] * directions[~lost]) ** 2).sum(axis=0))
        names = [*map(str, self.parameters), "scale", "phase of the scale"]
        tied = []
        for direction in directions[lost]:
            involved = np.flatnonzero(np.abs(direction) > INVOLVED)
            tied.append(tuple(names[k] for k in involved))
            errors[involved] = np.inf
        return errors[: len(self.parameters) + 1], tuple(tied)

    def jacobian(self, coordinates: Array) -> Array:
        """Derivatives of `residual` by the coordinates, (readings, parameters)."""
        unscaled = self.unscaled(coordinates)
        scale, square = self.scale(unscaled), np.vdot(unscaled, unscaled).real
        columns = []
        for change in self._changes(coordinates):
            # d (u^H t / u^H u) with the readings u at scale 1 and the measured ones t.
            turn = (
                np.vdot(change, self._readings) - 2.0 * scale * np.vdot(unscaled, change).real
            ) / square
            columns.append(self._as_target(scale * change + turn * unscaled))
        return np.asarray(np.transpose(columns) / np.linalg.norm(self.target))

    def _changes(self, coordinates: Array) -> list[Complex]:
        """Derivatives of the readings at scale 1 by each coordinate, (measurements,) each."""
        meter = self.meter(coordinates)
        sensed = meter.transfer_impedance(self.impedance, self.protocol) + meter.offset
        by_admittance, by_lead = meter.derivatives(self.impedance, self.protocol)
        roles = electrodes_by_role(self.protocol)
        found = []
        for parameter, x in zip(self.parameters, coordinates, strict=True):
            if parameter.name == "common_mode":
                change = self._common_mode(meter)
            elif parameter.name == "offset":
                change = np.ones(len(sensed), np.complex128)
            elif parameter.electrode is None:
                change = (by_admittance * roles[parameter.name]).sum(axis=1)
            else:
                by = by_lead if parameter.name == "leads" else by_admittance
                change = by[:, parameter.electrode]
            slope = parameter.slope(float(x)) * (1j if parameter.imaginary else 1.0)
            found.append(self._read(slope * change, sensed))
        return found

    def _common_mode(self, meter: FourTerminalMeter) -> Complex:
        """Common-mode voltage per unit current [ohm], (measurements,)."""
        both = (dataclasses.replace(meter, common_mode=mode) for mode in (1.0, 0.0))
        with_mode, without = (
            each.transfer_impedance(self.impedance, self.protocol) for each in both
        )
        return with_mode - without

    def _read(self, change: Complex, sensed: Complex) -> Complex:
        """Change of the readings for a change of the sensed voltages."""
        if self.start.reads == "complex":
            return change
        if self.start.reads == "magnitude":
            size = np.maximum(np.abs(sensed), np.finfo(float).tiny)
            change = change * np.conj(sensed) / size
        return change.real.astype(complex)

    @property
    def _readings(self) -> Complex:
        """Measured readings (measurements,)."""
        if self.start.reads != "complex":
            return self.target.astype(complex)
        half = len(self.target) // 2
        return np.asarray(self.target[:half] + 1j * self.target[half:])

    def _as_target(self, readings: Complex) -> Array:
        return _parts(readings) if self.start.reads == "complex" else readings.real


def _mean_frame(frames: ArrayLike, protocol: Protocol) -> Complex:
    """Mean of the frames (measurements,); raises DataError."""
    values = np.atleast_2d(np.asarray(frames, np.complex128))
    if values.ndim != 2 or values.shape[1] != len(protocol) or not len(values):
        raise DataError(
            f"expected flat frames of {len(protocol)} channels, got shape {values.shape}; name the "
            "protocol of the frames"
        )
    if not np.isfinite(values).all():
        raise DataError("expected finite readings, got NaN or infinity; leave these frames out")
    mean: Complex = values.mean(axis=0)
    if not mean.any():
        raise DataError("every reading is zero: a dead board explains any meter")
    return mean


def _quantity(measured: Complex) -> Quantity:
    if measured.imag.any():
        return "complex"
    return "signed" if (measured.real < 0.0).any() else "magnitude"


def _parts(values: Complex) -> Array:
    return np.concatenate((values.real, values.imag), axis=-1)
