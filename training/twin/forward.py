"""Readings of labelled scenes from the numbers of a twin, and their derivatives."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.recipe.specimen import Specimen
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.meter import FourTerminalMeter, Quantity
from eitskin.simulator.instrument.meter_parameters import meter_with
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator
from eitskin.training.twin.parameters import MECHANICAL, TwinParameter
from eitskin.training.twin.sensor import with_numbers

Array = NDArray[np.float64]

STEP = 0.05
"""Step of central differences, in standard deviations of the prior."""
_METER_STEP = 1e-3
_KEPT = 4


class TwinForward:
    """Readings of scenes as a function of standard normal coordinates.

    Attributes:
        nominal: sensor whose mesh and factors all others share.
        parameters: that the coordinates belong to.
        protocol: of the readings.
        reads: what the readings are.
    """

    def __init__(
        self,
        nominal: Specimen,
        parameters: Sequence[TwinParameter],
        protocol: Protocol,
        reads: Quantity,
        resolution: Resolution,
    ) -> None:
        """Keep the problem; nothing is solved yet."""
        self.nominal, self.parameters = nominal, tuple(parameters)
        self.protocol, self.reads, self._resolution = protocol, reads, resolution
        on_sensor = [each.name not in ("gain",) and each.meter is None for each in parameters]
        self._sensor = np.flatnonzero(on_sensor)
        self._solved: dict[tuple[bytes, Scene], Array] = {}

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
        terms = [(each, k) for k, each in enumerate(self.parameters) if each.meter is not None]
        scale = next(
            each.number(float(x[k]))
            for k, each in enumerate(self.parameters)
            if each.name == "gain"
        )
        start = FourTerminalMeter(reads=self.reads)
        if terms:
            start = meter_with(
                start,
                [each.meter for each, _ in terms if each.meter is not None],
                np.array([each.spread * x[k] for each, k in terms]),
                terms[0][0].typical,
                self.protocol.n_electrodes,
            )
        return dataclasses.replace(start, scale=scale, offset=scale * start.offset)

    def readings(self, x: Array, scenes: Sequence[Scene]) -> Array:
        """Readings of the scenes, (scenes, measurements).

        Raises ConfigurationError for numbers or scenes that cannot be.
        """
        return self._read(self.impedances(x, scenes), x)

    def impedances(self, x: Array, scenes: Sequence[Scene]) -> Array:
        """Electrode impedance matrices [ohm], (scenes, electrodes, electrodes); kept."""
        key = np.asarray(x)[self._sensor].tobytes()
        absent = [scene for scene in scenes if (key, scene) not in self._solved]
        if absent:
            found = np.real(self._simulator(x).impedances(absent))
            if len(self._solved) > _KEPT * max(len(scenes), 64):
                self._solved.clear()
                absent, found = list(scenes), np.real(self._simulator(x).impedances(scenes))
            self._solved |= {(key, scene): Z for scene, Z in zip(absent, found, strict=True)}
        return np.array([self._solved[key, scene] for scene in scenes])

    def jacobian(self, x: Array, scenes: Sequence[Scene]) -> Array:
        """Derivatives of the readings by the coordinates, (scenes, measurements, parameters)."""
        Z = self.impedances(x, scenes)
        slopes = self.impedance_slopes(x, scenes)
        found = np.empty((len(scenes), len(self.protocol), len(self.parameters)))
        for k, each in enumerate(self.parameters):
            if k in slopes:
                moved = [self._read(Z + h * slopes[k], x) for h in (_METER_STEP, -_METER_STEP)]
                width = 2.0 * _METER_STEP
            else:
                ends = np.clip([x[k] + _METER_STEP, x[k] - _METER_STEP], *each.bounds)
                moved = [self._read(Z, _with(x, k, end)) for end in ends]
                width = ends[0] - ends[1]
            found[..., k] = (moved[0] - moved[1]) / width
        return found

    def impedance_slopes(self, x: Array, scenes: Sequence[Scene]) -> dict[int, Array]:
        """Derivatives of the impedances [ohm] by each coordinate of sensor and fixture.

        By the adjoint method for conductivity and contacts, else by central differences. Each has
        the shape (scenes, electrodes, electrodes); numbers are those of the parameters.
        """
        contacts = self._simulator(x).contact_sensitivities(scenes)
        z = np.real(self.specimen(x).design.contact_impedance)
        by_log_contact = contacts * z
        found = {}
        for k in self._sensor.tolist():
            each = self.parameters[k]
            if each.name == "contact_impedance":
                found[k] = by_log_contact[..., each.electrode] * np.log(each.spread)
            elif each.name == "conductivity":
                # Z (c sigma, z) = Z (sigma, c z) / c.
                slope = by_log_contact.sum(axis=-1) - self.impedances(x, scenes)
                found[k] = slope * np.log(each.spread)
            else:
                found[k] = self._difference(x, k, scenes)
        return found

    def _difference(self, x: Array, k: int, scenes: Sequence[Scene]) -> Array:
        """Central difference of the impedances by coordinate k, zero where they do not depend."""
        n = self.protocol.n_electrodes
        found = np.zeros((len(scenes), n, n))
        moved = [i for i, scene in enumerate(scenes) if _depends(self.parameters[k], scene)]
        if not moved:
            return found
        asked = [scenes[i] for i in moved]
        ends = np.clip([x[k] + STEP, x[k] - STEP], *self.parameters[k].bounds)
        one, other = (np.real(self._simulator(_with(x, k, end)).impedances(asked)) for end in ends)
        found[moved] = (one - other) / (ends[0] - ends[1])
        return found

    def _read(self, Z: Array, x: Array) -> Array:
        meter = self.meter(x)
        reading, _ = meter.reading(meter.transfer_impedance(Z, self.protocol))
        return np.asarray(reading.real)

    def _simulator(self, x: Array) -> Simulator:
        return self.specimen(x).simulator(self.nominal.design, self._resolution, self.protocol)


def _depends(parameter: TwinParameter, scene: Scene) -> bool:
    """Whether a number changes the impedances of a scene."""
    if parameter.name not in MECHANICAL:
        return True
    bent = bool(scene.bend.angle_deg)
    return bent or (parameter.name.endswith("modulus") and bool(scene.touches))


def _with(x: Array, k: int, value: float) -> Array:
    changed = np.array(x, dtype=float)
    changed[k] = value
    return changed
