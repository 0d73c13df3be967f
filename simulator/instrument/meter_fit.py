"""Fit of a four-terminal meter to frames of a flat, untouched sensor, and choice of its terms."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from eitskin.bounds import require_axes, require_positive, require_seed
from eitskin.errors import ConfigurationError, DataError
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.meter import (
    USUAL,
    FourTerminalMeter,
    Parameter,
    Quantity,
    central_differences,
    meter_from_coordinates,
    meter_parameters,
)

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

STARTS = 12
TRIAL_STARTS = 4
"""Starting points of each fit without one of the terms."""
MAX_STEPS = 80
"""Most steps from one starting point; more are taken only along what readings hardly show."""
UNDETERMINED_DEVIATION = 0.5
"""Standard error of a coordinate (half the range of a load) from which it is not identifiable."""
NULL = 1e-5
"""Singular value, relative to the largest, of directions that no reading depends on."""
ALIKE = 0.005
"""Difference of predicted readings, relative to the largest, below which they are alike."""
MIN_COMPONENT = 0.2
"""Least component of a parameter in a null direction for it to be named."""
_STEP = 1e-6  # of coordinates, for derivatives
_OFF_BOUND = 1e-9  # of a coordinate: at its bound, ground may be somewhere else


@dataclass(frozen=True, slots=True, eq=False)
class MeterFit:
    """Fitted meter, its standard errors, and the flat frame that it explains.

    Standard errors are those of linearised least squares, with a variance estimated from the
    residuals: they hold the error of the sensor's model as far as it varies from channel to
    channel.

    Attributes:
        meter: the fitted meter.
        parameters: the numbers that were fitted, next to the scale.
        values: values of the parameters, (parameters,), in the parameters' units.
        standard_errors: standard errors of the values, (parameters,); infinite for those that are
            not identifiable.
        scale_error: standard error of the scale, relative.
        tied: groups of parameters of which only a combination shows in the readings.
        predicted: the meter's flat frame, (measurements,).
        measured: mean of the frames that were fitted, (measurements,).

    Example:
        >>> import numpy as np
        >>> from eitskin import Protocol, SensorDesign
        >>> from eitskin.simulator import ForwardModel, fit_meter
        >>> protocol = Protocol.adjacent(8)
        >>> impedance = ForwardModel(SensorDesign.reference(), "coarse").impedance()
        >>> fit = fit_meter(impedance, protocol, 2.0 * protocol.measure(impedance)[None].real, ())
        >>> round(float(abs(fit.meter.scale)), 3)
        2.0
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
    values = np.array([predicted, measured], np.complex128)
    p, m = _parts(values) if values.imag.any() else values.real
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
    Fitted loads are relative to the sensor's: a sensor of twice the conductivity with twice the
    loads gives the same frames at half the scale.

    Args:
        impedance: electrode impedance matrix of the flat sensor, (electrodes, electrodes) [ohm].
        protocol: drive and sense electrodes of the channels.
        frames: readings of the flat, untouched sensor, (frames, measurements), in any unit.
        terms: terms to fit next to the scale, of `FITTED`; without any, the meter is ideal but for
            its scale.
        reads: kind of the readings; when omitted "complex" where they have imaginary parts, else
            "signed" where some are negative, else "magnitude".
        seed: seed of the starting points.
        starts: number of starting points; the sum of squares has several minima.

    Raises:
        ConfigurationError: for an unknown term, or as many parameters as readings.
        DataError: for frames of another protocol, or that are not finite.

    Example:
        >>> from eitskin import Protocol, SensorDesign
        >>> from eitskin.simulator import ForwardModel, fit_meter
        >>> protocol = Protocol.adjacent(8)
        >>> impedance = ForwardModel(SensorDesign.reference(), "coarse").impedance()
        >>> fit = fit_meter(impedance, protocol, 2.0 * protocol.measure(impedance)[None].real, ())
        >>> round(float(abs(fit.meter.scale)), 3)
        2.0
    """
    measured = _mean_frame(frames, protocol)
    quantity: Quantity = reads or _quantity(measured)
    is_complex = quantity == "complex"
    require_axes("impedance", impedance, None, None, more=False)
    typical = float(np.median(np.abs(np.diag(impedance))))
    require_positive("the median of the impedance's diagonal", typical, "ohm")
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
        measured,
    )
    require_seed(seed)
    coordinates = problem.minimum(np.random.default_rng(seed), starts)
    meter = problem.meter(coordinates)
    scale = problem.scale(problem.unit_scale_readings(coordinates))
    meter = dataclasses.replace(meter, scale=scale, offset=scale * meter.offset)
    errors, tied = problem.uncertainty(coordinates)
    pairs = list(zip(parameters, coordinates, strict=True))
    slopes = np.array([p.slope(float(x)) for p, x in pairs])
    predicted, _ = meter.reading(meter.transfer_impedance(impedance, protocol))
    return MeterFit(
        meter=meter,
        parameters=parameters,
        values=np.array([p.number(float(x)) for p, x in pairs]),
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

    Example:
        >>> from eitskin import Protocol, SensorDesign
        >>> from eitskin.simulator import ForwardModel, select_meter
        >>> protocol = Protocol.adjacent(8)
        >>> impedance = ForwardModel(SensorDesign.reference(), "coarse").impedance()
        >>> frames = protocol.measure(impedance)[None].real
        >>> fit = select_meter(impedance, protocol, frames, ("sink",))
        >>> fit.meter.sink
        0.0
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
        measured: readings, (measurements,).
    """

    start: FourTerminalMeter
    parameters: tuple[Parameter, ...]
    impedance: NDArray[np.inexact]
    protocol: Protocol
    measured: Complex

    def meter(self, coordinates: Array) -> FourTerminalMeter:
        """Meter of scale 1 for the coordinates (parameters,)."""
        n = self.protocol.n_electrodes
        return meter_from_coordinates(self.start, self.parameters, coordinates, n)

    def unit_scale_readings(self, coordinates: Array) -> Complex:
        """Readings of the meter of scale 1 (measurements,)."""
        meter = self.meter(coordinates)
        return meter.reading(meter.transfer_impedance(self.impedance, self.protocol))[0]

    def scale(self, unscaled: Complex) -> complex:
        """Scale of least squares; real and, for magnitudes, positive where readings are real."""
        square = float(np.vdot(unscaled, unscaled).real) or 1.0
        scale = complex(np.vdot(unscaled, self.measured)) / square
        return scale if self.start.reads == "complex" else scale.real or 1.0

    def residual(self, coordinates: Array) -> Array:
        """Residual over the norm of the readings, at the scale of least squares (readings,)."""
        unscaled = self.unit_scale_readings(coordinates)
        return self._parts(self.scale(unscaled) * unscaled - self.measured)

    def jacobian(self, function: Callable[[Array], Array], coordinates: Array) -> Array:
        """Derivatives of a function of the coordinates, (values, parameters)."""
        low, high = np.array([p.bounds for p in self.parameters]).T
        return central_differences(function, coordinates, (low + _OFF_BOUND, high), _STEP)

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
            solution = least_squares(
                self.residual,
                np.clip(first, low + _OFF_BOUND, high - _OFF_BOUND),
                partial(self.jacobian, self.residual),
                bounds=(low, high),
                max_nfev=MAX_STEPS,
            )
            if solution.cost < least * (1.0 - 1e-9):
                best, least = solution.x, solution.cost
        return np.asarray(best)

    def uncertainty(self, coordinates: Array) -> tuple[Array, tuple[tuple[str, ...], ...]]:
        """Standard errors of coordinates and log scale, and groups of tied parameters.

        A direction of the parameters along which the standard error is beyond
        `UNDETERMINED_DEVIATION` ties its parameters, whose standard errors are infinite.
        """
        unscaled = self.unit_scale_readings(coordinates)
        scale = self.scale(unscaled)
        columns = [self._parts(scale * unscaled)]
        if self.start.reads == "complex":
            columns.append(self._parts(1j * scale * unscaled))  # the phase of the scale
        J = np.array(columns).T
        if self.parameters:
            changes = self.jacobian(
                lambda x: self._parts(scale * self.unit_scale_readings(x)), coordinates
            )
            J = np.hstack([changes, J])
        freedom = max(len(J) - J.shape[1], 1)
        noise = np.linalg.norm(self.residual(coordinates)) / np.sqrt(freedom)
        _, sizes, directions = np.linalg.svd(J, full_matrices=False)
        spread = noise / np.maximum(sizes, np.finfo(float).tiny)
        lost = (spread > UNDETERMINED_DEVIATION) | (sizes < NULL * sizes[0])
        errors = np.sqrt(((spread[~lost, None] * directions[~lost]) ** 2).sum(axis=0))
        names = [*map(str, self.parameters), "scale", "phase of the scale"]
        tied = []
        for direction in directions[lost]:
            involved = np.flatnonzero(np.abs(direction) > MIN_COMPONENT)
            tied.append(tuple(names[k] for k in involved))
            errors[involved] = np.inf
        return errors[: len(self.parameters) + 1], tuple(tied)

    def _parts(self, readings: Complex) -> Array:
        """Readings as real numbers, over the norm of the measured ones."""
        parts = _parts(readings) if self.start.reads == "complex" else readings.real
        return np.asarray(parts / np.linalg.norm(self.measured))


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
