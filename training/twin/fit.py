"""Readings of labelled scenes from the numbers of a twin, and the fit of these numbers.

The fit is a MAP estimate in standard normal coordinates by Gauss-Newton steps, with a Laplace
posterior.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.specimen import Specimen
from eitskin.geometry import ConfigurationError, EitskinError
from eitskin.simulator import FourTerminalMeter, Scene, Simulator
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.meter import (
    Parameter,
    central_differences,
    meter_from_coordinates,
)
from eitskin.training.twin.labelled_frames import KINDS, LabelledFrames
from eitskin.training.twin.parameters import MECHANICAL, with_numbers

Array = NDArray[np.float64]

STEP = 0.05
"""Step of central differences, in standard deviations of the prior."""
_METER_STEP = 1e-3
_CACHE_SIZE = 4
MAX_STEPS = 25
_MAX_STEP = 1.5  # step of one coordinate, in standard deviations of the prior
_SLOPE_VALIDITY = 0.3  # change of every coordinate within which derivatives are taken again
_HALVINGS = 8
_STEP_TOLERANCE = 0.05  # length of the last step, in standard deviations of the posterior
_FIRST_ERROR = 0.1  # first guess of the unexplained part, over the values
_MIN_FREEDOM = 0.1  # share of the values that counts as free whatever is fitted


@dataclass(frozen=True, slots=True, eq=False)
class Laplace:
    """Normal approximation of a posterior about its maximum, n rows of C channels.

    Attributes:
        x: coordinates of the maximum, (parameters,).
        covariance: covariance of the coordinates, (parameters, parameters); the identity is the
            prior.
        predicted: rows at the maximum, (n, C).
        error: standard deviation of the rows of each kind that is left, (kinds,).
        log_evidence: logarithm of the marginal likelihood, by Laplace's formula.
    """

    x: Array
    covariance: Array
    predicted: Array
    error: Array
    log_evidence: float


class TwinProblem:
    """Readings of labelled scenes as a function of standard normal coordinates, and their fit.

    Attributes:
        nominal: sensor whose mesh and factors all others share.
        parameters: parameters that the coordinates belong to: of the sensor, its gain, terms of the
            meter.
        terms: numbers of the terms of the meter among the parameters.
        frames: measured rows, and the scenes that they show.
        resolution: resolution of the simulator.
    """

    def __init__(
        self,
        nominal: Specimen,
        parameters: Sequence[Parameter],
        frames: LabelledFrames,
        resolution: Resolution,
    ) -> None:
        """Keep the problem; nothing is solved yet."""
        self.nominal, self.parameters = nominal, tuple(parameters)
        self.frames, self.resolution = frames, resolution
        gain = [parameter.name for parameter in parameters].index("gain")
        self._sensor, self.terms = np.arange(gain), np.arange(gain + 1, len(parameters))
        self._solved: dict[tuple[bytes, Scene], Array] = {}

    def for_frames(self, frames: LabelledFrames) -> "TwinProblem":
        """The same for other frames, with the solutions so far."""
        other = TwinProblem(self.nominal, self.parameters, frames, self.resolution)
        other._solved = self._solved
        return other

    def specimen(self, x: Array) -> Specimen:
        """Sensor, fixture and materials at coordinates (parameters,).

        Raises ConfigurationError for a sensor that cannot be.
        """
        numbers = {
            (self.parameters[k].name, self.parameters[k].electrode): self.parameters[k].number(x[k])
            for k in self._sensor.tolist()
        }
        return with_numbers(self.nominal, numbers)

    def meter(self, x: Array) -> FourTerminalMeter:
        """Meter at coordinates (parameters,)."""
        gain = len(self._sensor)
        start = meter_from_coordinates(
            FourTerminalMeter(reads=self.frames.reads),
            self.parameters[gain + 1 :],
            x[self.terms],
            self.frames.protocol.n_electrodes,
        )
        scale = self.parameters[gain].number(float(x[gain]))
        return dataclasses.replace(start, scale=scale, offset=scale * start.offset)

    def readings(self, x: Array) -> Array:
        """Readings of the scenes, (scenes, measurements).

        Raises ConfigurationError for numbers or scenes that cannot be.
        """
        return self._read(self.impedances(x), x)

    def impedances(self, x: Array) -> Array:
        """Electrode impedance matrices [ohm], (scenes, electrodes, electrodes); kept."""
        scenes, key = self.frames.scenes, np.asarray(x)[self._sensor].tobytes()
        absent = [scene for scene in scenes if (key, scene) not in self._solved]
        if absent and len(self._solved) > _CACHE_SIZE * max(len(scenes), 64):
            self._solved.clear()
            absent = list(scenes)
        if absent:
            solved = np.real(self._simulator(x).impedances(absent))
            self._solved |= {(key, scene): Z for scene, Z in zip(absent, solved, strict=True)}
        return np.array([self._solved[key, scene] for scene in scenes])

    def jacobian(self, x: Array) -> Array:
        """Derivatives of the readings by the coordinates, (scenes, measurements, parameters)."""
        Z, slopes = self.impedances(x), self._impedance_slopes(x)
        low, high = np.array([parameter.bounds for parameter in self.parameters]).T
        jacobian = central_differences(partial(self._read, Z), x, (low, high), _METER_STEP)
        for k, slope in slopes.items():
            above, below = (self._read(Z + h * slope, x) for h in (_METER_STEP, -_METER_STEP))
            jacobian[..., k] = (above - below) / (2.0 * _METER_STEP)
        return jacobian

    def _impedance_slopes(self, x: Array) -> dict[int, Array]:
        """Derivatives of the impedances [ohm] by each coordinate of sensor and fixture.

        By the adjoint method for conductivity and contacts, else by central differences. Each has
        the shape (scenes, electrodes, electrodes); numbers are those of the parameters.
        """
        contacts = self._simulator(x).contact_sensitivities(self.frames.scenes)
        by_log_contact = contacts * np.real(self.specimen(x).design.contact_impedance)
        slopes = {}
        for k in self._sensor.tolist():
            each = self.parameters[k]
            if each.name == "contact_impedance":
                slopes[k] = by_log_contact[..., each.electrode] * np.log(each.spread)
            elif each.name == "conductivity":
                # Z (c sigma, z) = Z (sigma, c z) / c.
                slope = by_log_contact.sum(axis=-1) - self.impedances(x)
                slopes[k] = slope * np.log(each.spread)
            else:
                slopes[k] = self._difference(x, k)
        return slopes

    def _difference(self, x: Array, k: int) -> Array:
        """Central difference of the impedances by coordinate k, zero where they do not depend."""
        scenes, n = self.frames.scenes, self.frames.protocol.n_electrodes
        differences = np.zeros((len(scenes), n, n))
        moved = [i for i, scene in enumerate(scenes) if _depends(self.parameters[k], scene)]
        if not moved:
            return differences
        asked = [scenes[i] for i in moved]
        ends = np.clip([x[k] + STEP, x[k] - STEP], *self.parameters[k].bounds)
        one, other = (
            np.real(self._simulator(_replace_entry(x, k, end)).impedances(asked)) for end in ends
        )
        differences[moved] = (one - other) / (ends[0] - ends[1])
        return differences

    def _read(self, Z: Array, x: Array) -> Array:
        meter = self.meter(x)
        reading, _ = meter.reading(meter.transfer_impedance(Z, self.frames.protocol))
        return np.asarray(reading.real)

    def _simulator(self, x: Array) -> Simulator:
        design, protocol = self.nominal.design, self.frames.protocol
        return self.specimen(x).simulator(design, self.resolution, protocol)

    def predict(self, x: Array) -> Array:
        """Rows at coordinates (parameters,), (rows, channels)."""
        return self.frames.changes(self.readings(x))

    def slopes(self, x: Array) -> Array:
        """Derivatives of the rows by the coordinates, (rows, channels, parameters)."""
        J = self.jacobian(x)
        flat = self.frames.changes(J.reshape(len(J), -1))
        return flat.reshape(len(flat), *J.shape[1:])

    def objective(self, x: Array, deviation: Array) -> float:
        """Half of chi^2 plus that of the prior; infinite for numbers that cannot be.

        Args:
            x: coordinates (parameters,).
            deviation: standard deviation of each row's values, (rows,).
        """
        try:
            residuals = (self.frames.values - self.predict(x)) / deviation[:, None]
        except EitskinError:
            return np.inf
        return 0.5 * float((residuals**2).sum() + x @ x)

    def estimate(
        self,
        start: Array,
        steps: int = MAX_STEPS,
        progress: Callable[[int], None] = lambda _: None,
    ) -> Laplace:
        """MAP estimate from a starting point, after a number of steps at most.

        The standard deviation of each kind of row is that of what the twin leaves, at least the
        noise of the frames: residuals over the degrees of freedom, found again before each step.
        `progress` is called before each step with its number.

        Raises ConfigurationError where the starting point itself cannot be.
        """
        error = self._first_error()
        low, high = np.array([parameter.bounds for parameter in self.parameters]).T.astype(float)
        x = np.clip(np.array(start, dtype=float), low, high)
        if not np.isfinite(self.objective(x, self._deviation(error))):
            raise ConfigurationError("the design's own numbers cannot be simulated")
        J = at = None
        for step_number in range(steps):
            progress(step_number)
            residuals = self.frames.values - self.predict(x)
            if J is None or at is None or np.abs(x - at).max() > _SLOPE_VALIDITY:
                J, at = self.slopes(x), x.copy()
            before, error = error, self._error(residuals, J, error)
            deviation = self._deviation(error)
            step, A = _step(residuals, J, deviation, x, low, high)
            length = math.sqrt(max(float(step @ A @ step), 0.0))
            settled = np.allclose(np.log(before), np.log(error), atol=0.05)
            if length < _STEP_TOLERANCE * np.sqrt(len(x)) and settled:
                break
            moved = self._line_search(x, step, deviation, low, high)
            if moved is not None:
                x = moved
            elif not np.array_equal(at, x):
                J = None  # the derivatives may be too old for this step
            elif settled:
                break
        if J is None or at is None or np.abs(x - at).max() > _SLOPE_VALIDITY:
            J = self.slopes(x)
        return self._laplace(x, J, error)

    def _line_search(
        self, x: Array, step: Array, deviation: Array, low: Array, high: Array
    ) -> Array | None:
        """Point along the step where the objective is lower; None where none is."""
        start = self.objective(x, deviation)
        share = min(1.0, _MAX_STEP / max(float(np.abs(step).max()), 1e-300))
        for _ in range(_HALVINGS):
            trial = np.clip(x + share * step, low, high)
            if self.objective(trial, deviation) < start:
                return np.asarray(trial)
            share *= 0.5
        return None

    def _laplace(self, x: Array, J: Array, error: Array) -> Laplace:
        predicted = self.predict(x)
        left = self.frames.values - predicted
        error = self._error(left, J, error)
        deviation = self._deviation(error)
        A = _information(J, deviation)
        covariance = np.asarray(np.linalg.inv(A), np.float64)
        fit = ((left / deviation[:, None]) ** 2).sum() + x @ x
        size = 2.0 * left.shape[1] * np.log(deviation).sum() + left.size * np.log(2.0 * np.pi)
        evidence = -0.5 * (fit + size + np.linalg.slogdet(A)[1])
        return Laplace(x, covariance, predicted, error, float(evidence))

    def _deviation(self, error: Array) -> Array:
        """Standard deviation of each row's values, (rows,), from that of each kind."""
        noise = self.frames.noise * np.sqrt(self.frames.variance)
        return np.maximum(error[self.frames.kind], noise)

    def _first_error(self) -> Array:
        values, kind = self.frames.values, self.frames.kind
        sizes = np.ones(len(KINDS))
        for k in np.unique(kind):
            sizes[k] = max(float(np.sqrt(np.mean(values[kind == k] ** 2))), 1e-12)
        return _FIRST_ERROR * sizes

    def _error(self, left: Array, J: Array, error: Array) -> Array:
        """Standard deviation of each kind's residuals over their degrees of freedom, (kinds,)."""
        deviation = self._deviation(error)
        covariance = np.linalg.inv(_information(J, deviation))
        scaled = J / deviation[:, None, None]
        leverage = np.einsum("rcp,pq,rcq->r", scaled, covariance, scaled, optimize=True)
        error_estimate = error.copy()
        for k in np.unique(self.frames.kind):
            own = self.frames.kind == k
            size = left[own].size
            freedom = max(size - leverage[own].sum(), _MIN_FREEDOM * size)
            error_estimate[k] = max(np.sqrt((left[own] ** 2).sum() / freedom), 1e-12)
        return error_estimate


def _depends(parameter: Parameter, scene: Scene) -> bool:
    """Whether a number changes the impedances of a scene."""
    if parameter.name not in MECHANICAL:
        return True
    bent = bool(scene.bend.angle_deg)
    return bent or (parameter.name.endswith("modulus") and bool(scene.touches))


def _replace_entry(x: Array, k: int, value: float) -> Array:
    changed = np.array(x, dtype=float)
    changed[k] = value
    return changed


def _information(J: Array, deviation: Array) -> Array:
    """Inverse covariance of the posterior, (parameters, parameters)."""
    scaled = (J / deviation[:, None, None]).reshape(-1, J.shape[-1])
    return scaled.T @ scaled + np.eye(J.shape[-1])


def _step(
    left: Array, J: Array, deviation: Array, x: Array, low: Array, high: Array
) -> tuple[Array, Array]:
    """Gauss-Newton step within the bounds, by the method of active sets, and the information."""
    A = _information(J, deviation)
    weights = deviation[:, None] ** 2
    g = np.einsum("rcp,rc->p", J, left / weights) - x
    free = np.ones(len(x), bool)
    step = np.zeros_like(x)
    for _ in range(len(x)):
        step[:] = 0.0
        step[free] = np.linalg.solve(A[np.ix_(free, free)], g[free])
        beyond = free & (((x <= low) & (step < 0.0)) | ((x >= high) & (step > 0.0)))
        if not beyond.any():
            break
        free &= ~beyond
    return step, A
