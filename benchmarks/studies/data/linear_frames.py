"""Datasets of sensors that are linear in the logarithm of the conductivity: quick to make.

The sensitivities are those of the nominal sensor; specimens differ in smooth fields of
conductivity, in the strength and the shape of their response, and in how bends act on them.
Reciprocal measurements have the same signals and independent noise.
"""

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.state import State
from eitskin.geometry.design.outline import Disc
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.training.reconstruction.linear_model import linear_model

Array = NDArray[np.float64]

PIXELS = (32, 32)  # along y and x
RADIUS = 0.0075  # m, of the indenter
NOISE = 7e-5  # of one frame, of the largest voltage; 83 dB
FORCE = (4.0, 12.0)  # N
SEPARATION = 0.025  # m, of touches in one frame
STRENGTH, SHAPE = 0.15, 0.03  # spread over specimens of the response and of each pixel's share
FLAT_SPREAD = 0.02  # of the logarithm of the conductivity
ANGLES = (-20.0, 50.0)  # deg


class LinearSensors:
    """Specimens of one design, to first order.

    Attributes:
        design: of all of them.
        protocol: of the measurements.
    """

    def __init__(self, design: SensorDesign, protocol: Protocol, specimens: int, seed: int) -> None:
        """Draw `specimens` of them."""
        self.design, self.protocol = design, protocol
        self._round = isinstance(design.outline, Disc)
        model = linear_model(design, protocol, PIXELS, resolution="coarse")
        self._rng = np.random.default_rng(seed)
        size = (design.outline.length, design.outline.width)
        steps = [(np.arange(n) + 0.5) / n * s for n, s in zip(PIXELS[::-1], size, strict=True)]
        self._x, self._y = (axis.ravel() for axis in np.meshgrid(*steps))
        self._jacobian = model.relative
        self._middle, self._reach = 0.5 * np.array(size), 0.5 * np.array(size) - 0.012
        rng = self._rng
        fields = FLAT_SPREAD * rng.standard_normal((specimens, 6)) @ self._modes(rng, 6)
        factor = 0.15 * rng.standard_normal((specimens, 1))
        nominal = np.abs(np.real(model.impedance))
        self.flat = nominal * np.exp(fields @ self._jacobian.T + factor)
        self._own = np.exp(
            STRENGTH * rng.standard_normal((specimens, 1))
            + SHAPE * rng.standard_normal((specimens, 4)) @ self._modes(rng, 4)
        )
        self._bending = (np.abs(self._x - self._middle[0]) < 0.3 * self._middle[0]) * (
            1.0 + 0.1 * rng.standard_normal((specimens, 3)) @ self._modes(rng, 3)
        )

    def _modes(self, rng: np.random.Generator, count: int) -> Array:
        """Smooth fields (count, pixels) of unit size."""
        kx, ky = rng.uniform(-np.pi, np.pi, (2, count, 1)) / self._middle[:, None, None]
        phase = 2.0 * np.pi * rng.uniform(size=(count, 1))
        modes: Array = np.sqrt(2.0) * np.cos(kx * self._x + ky * self._y + phase)
        return modes

    def dataset(self, idle: int, touched: int, bent: int, most_touches: int, seed: int) -> Dataset:
        """Frames idle, touched (on bent sensors where any are bent) and bent, of all specimens."""
        rng, specimens = np.random.default_rng(seed), len(self.flat)
        state = np.repeat([State.IDLE, State.TOUCH, State.BEND], [idle, touched, bent])
        state = state[rng.permutation(len(state))]
        number = rng.integers(0, specimens, len(state))
        angle = np.where(state == State.IDLE, 0.0, rng.uniform(*ANGLES, len(state)))
        angle *= bent > 0
        touches = np.full((3, len(state), 4), np.nan)
        for i in np.flatnonzero(state == State.TOUCH):
            places = self._places(int(rng.integers(1, most_touches + 1)), rng)
            touches[:2, i, : len(places)] = places.T
            touches[2, i, : len(places)] = rng.uniform(*FORCE, len(places))
        bend = self._bending[number] * (-0.004 * angle - 2e-5 * angle**2)[:, None]
        away = np.hypot(touches[0][..., None] - self._x, touches[1][..., None] - self._y)
        dents = touches[2][..., None] * np.exp(-0.5 * (away / (0.7 * RADIUS)) ** 2)
        press = -0.012 * np.nan_to_num(dents).sum(axis=1) * self._own[number]
        free = self.flat[number] * np.exp(bend @ self._jacobian.T)
        values = free * np.exp(press @ self._jacobian.T)
        noise = NOISE * float(self.flat.max())
        values = values + noise * rng.standard_normal(values.shape)
        free = free + noise * rng.standard_normal(values.shape)
        return Dataset.from_arrays(
            values.astype(complex),
            self.flat.astype(complex),
            touch_reference=free.astype(complex),
            specimen=number,
            state=state,
            bend_angle_deg=angle,
            touch_x=touches[0],
            touch_y=touches[1],
            touch_force=touches[2],
            touch_radius=np.where(np.isfinite(touches[0]), RADIUS, np.nan),
            protocol=self.protocol,
            source="simulated",
            design=self.design,
            seed=seed,
        )

    def _places(self, count: int, rng: np.random.Generator) -> Array:
        """Positions (k, 2) [m] of up to `count` touches on the sensor, apart from each other."""
        found: list[Array] = []
        while len(found) < count:
            place = self._middle + self._reach * rng.uniform(-1.0, 1.0, 2)
            away = place - self._middle
            inside = not self._round or np.hypot(*away) < self._reach[0]
            if inside and all(np.hypot(*(place - each)) > SEPARATION for each in found):
                found.append(place)
        return np.array(found)
