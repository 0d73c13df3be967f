"""Drift: walks, a gel that warms and dries, and the session of a board that measures it.

Ions of a gel move faster by 2 % a kelvin, as in water (ISO 7888). They stay when water leaves,
and are hindered by the polymer: a share f of it leaves them ((1 - f) / (1 + f))^2 of their
mobility in water (Mackie and Meares, Proc. R. Soc. A 232 (1955) 498-509). A bonded layer loses its
water in thickness, h / h_0 = f_0 / f, in which the ions come closer by the same factor.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import require_in_range
from eitskin.errors import ConfigurationError, FrameError
from eitskin.frame import Status
from eitskin.geometry.design.dispersion import scale_conductivity
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.instrument import ad5940
from eitskin.simulator.instrument.meter import FourTerminalMeter

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

DRIFT_TIME = 4 * 3600.0
"""Time after which drifts are specified [s]: 4 hours."""

STEP = 10.0
"""Time between steps of the walk [s]; 0.2 % in 4 h is 0.005 % per step, a quarter of the noise."""
MAX_SESSION = 365 * 86400.0
"""Longest duration of a session [s]."""
PER_KELVIN = 0.02
"""Relative change of the conductivity [1/K]."""
POLYMER_SHARE = 0.1
"""Share of polymer in the volume of a fresh gel."""
WARMING_TIME = 1800.0
"""Time constant with which a gel takes another temperature [s] (Newton's law of cooling)."""
DAY = 86400.0
_MAX_WARMING = 30.0  # K, either way


@dataclass(frozen=True, slots=True)
class RandomWalk:
    """Random walk from 0 at time 0, with a standard deviation that grows as sqrt(t).

    Steps are normal, every 10 s, with linear interpolation between.

    Attributes:
        deviation: standard deviation after 4 h.
        seed: seed of the steps; the same seed gives the same walk.
    """

    deviation: float
    seed: int

    def __call__(self, times: Array) -> Array:
        """Values of the walk at `times` [s], which are not negative; of the shape of `times`."""
        count = int(np.ceil(np.max(times, initial=0.0) / STEP))
        values = self.deviation * np.sqrt(STEP / DRIFT_TIME) * _walk(self.seed, count.bit_length())
        walk: Array = np.interp(times, STEP * np.arange(len(values)), values)
        return walk


# A board that runs for days evaluates its drift in every frame.
@lru_cache(maxsize=4)
def _walk(seed: int, doublings: int) -> Array:
    """Walk of 2^doublings unit steps from 0; a longer walk begins with the shorter ones."""
    steps = np.random.default_rng(seed).standard_normal(2**doublings)
    walk = np.concatenate(([0.0], np.cumsum(steps)))
    walk.flags.writeable = False
    return walk


def thickness_left(water: ArrayLike) -> Array:
    """Thickness over that of the fresh gel, for the share of its water that is left."""
    return POLYMER_SHARE + (1.0 - POLYMER_SHARE) * np.asarray(water, dtype=np.float64)


def conductance_left(water: ArrayLike) -> Array:
    """Conductivity times thickness over that of the fresh gel, for the water that is left."""
    return np.asarray(_mobility(POLYMER_SHARE / thickness_left(water)) / _mobility(POLYMER_SHARE))


def _mobility(polymer: ArrayLike) -> Array:
    f = np.asarray(polymer)
    return np.asarray(((1.0 - f) / (1.0 + f)) ** 2)


def age_gel(design: SensorDesign, warming: float = 0.0, water: float = 1.0) -> SensorDesign:
    """Design with a gel that is warmer, or has lost water; the encapsulation stays as it is.

    Args:
        design: the sensor with electrodes on its sides over the full thickness, or on its faces.
        warming: temperature above that of the design's conductivity [K].
        water: share of the fresh gel's water that is left, above 0 to 1.

    Raises:
        ConfigurationError: for a temperature or share out of range, and for electrodes at heights
            of their own.

    Example:
        >>> from eitskin import SensorDesign
        >>> from eitskin.simulator import age_gel
        >>> round(age_gel(SensorDesign.reference(), water=0.5).thickness, 5)
        0.00275
    """
    require_in_range("warming", warming, -_MAX_WARMING, _MAX_WARMING, "K")
    require_in_range("water", water, 0.01, 1.0)
    if any(e.z is not None or (e.on == "side" and e.height) for e in design.electrodes):
        raise ConfigurationError(
            "a gel that dries takes electrodes over its full thickness or on its faces, got others"
        )
    thinner = float(thickness_left(water))
    factor = (1.0 + PER_KELVIN * warming) * float(conductance_left(water)) / thinner
    layers = (
        dataclasses.replace(
            layer,
            thickness=thinner * layer.thickness,
            conductivity=scale_conductivity(layer.conductivity, factor),
        )
        for layer in design.layers
    )
    own = design.conductivity
    return dataclasses.replace(
        design,
        thickness=thinner * design.thickness,
        encapsulated_thickness=design.encapsulated_thickness - (1.0 - thinner) * design.thickness,
        conductivity=own if design.layers else scale_conductivity(own, factor),
        layers=tuple(layers),
    )


@dataclass(frozen=True, slots=True)
class GelCourse:
    """Change of the gel in one session, as the logarithm of a factor on all impedances.

    The factor is exact for electrodes over the full thickness whose contacts change as the gel.

    Attributes:
        walk: random drift, as the logarithm of a factor, by the time [s].
        warming: temperature that the gel gains in the session [K].
        drying: share of its water that the gel loses in a day.
    """

    walk: Callable[[Array], Array]
    warming: float = 0.0
    drying: float = 0.0

    def __call__(self, times: Array) -> Array:
        """Logarithms at times since the session's start [s]; of the shape of `times`."""
        logarithm = self.walk(times)
        if self.warming:
            gained = self.warming * -np.expm1(-times / WARMING_TIME)
            logarithm = logarithm - np.log1p(PER_KELVIN * gained)
        if self.drying:
            left = (1.0 - self.drying) ** (times / DAY)
            logarithm = logarithm - np.log(conductance_left(left))
        return np.asarray(logarithm)


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """Errors of an `Instrument` that are constant in a session; `measure` adds noise and drift.

    Attributes:
        pairs: number of one measurement of each measurement's drive pair, the one that senses it
            where there is one, (measurements,).
        unsensed: number of a measurement whose drive pair decides over its reading and is sensed by
            none; None where there is no such one.
        capacitance: stray, across the drive pairs, as large as it acts at 40 kHz, (measurements,)
            [F].
        factor: gain, phase and path errors together, (measurements,) complex.
        drift: drift of the electronics, as the logarithm of a factor.
        gel: change of the gel, as the logarithm of a factor; None without any.
        deviation: standard deviation of the white noise per quadrature [ohm].
        front_end: signal chain from excitation to ADC.
        meter: scale, offset, limits and codes of the readings; None for an ideal meter.

    Example:
        >>> import numpy as np
        >>> from eitskin import SensorDesign, Simulator
        >>> from eitskin.simulator import Instrument
        >>> sim = Simulator(SensorDesign.reference(), "coarse")
        >>> session = Instrument().session(sim.protocol, sim.full_scale, np.random.default_rng(0))
        >>> type(session).__name__
        'Session'
    """

    pairs: NDArray[np.int64]
    unsensed: int | None
    capacitance: Array
    factor: Complex
    drift: RandomWalk
    gel: GelCourse | None
    deviation: float
    front_end: ad5940.FrontEnd
    meter: FourTerminalMeter | None = None

    def measure(
        self, impedance: Complex, times: Array, rng: np.random.Generator
    ) -> tuple[Complex, NDArray[np.uint8]]:
        """Measured impedances [ohm] and `Status` bits, both (frames, measurements).

        Frames of one session may be measured together or one by one, in any order: the drift
        depends on the times alone.

        Args:
            impedance: noise-free, on the circuit of the instrument, transfer and drive-pair
                impedances of `Instrument.terminal_impedances`, (frames, 2, measurements) complex
                [ohm]; or the former alone, (frames, measurements), where the protocol senses its
                drive pairs or no term depends on them.
            times: times of the frames since the session's start, (frames,) [s].
            rng: random generator of the noise.

        Raises:
            FrameError: where the shapes do not fit, or an impedance is not finite.
            ConfigurationError: for a time before the session, or a year after its start, or where
                a term depends on the impedance of a drive pair that is not given.
        """
        both, times = self._checked_arrays(impedance, times)
        white, floor = rng.spawn(2)
        if self.gel is not None:
            both = both * np.exp(self.gel(times))[:, None, None]
        if self.capacitance.any():
            both = ad5940.with_stray_capacitance(both, both[:, 1:], self.capacitance)
        Z, driven = both[:, 0] * self.factor, both[:, 1]
        if self.drift.deviation:
            Z = Z * np.exp(self.drift(times))[:, None]
        if self.deviation:
            noise = self.deviation * white.standard_normal((2, *Z.shape))
            Z = Z + noise[0] + 1j * noise[1]
        sensed, status = self.front_end.convert(Z, driven, floor)
        if self.meter is None:
            return sensed, status
        read, beyond = self.meter.reading(sensed)
        status[beyond] |= np.uint8(Status.CLIPPED)
        return read, status

    def _with_drive(self, transfer: Complex) -> Complex:
        """Transfer impedances (frames, m), and those among them that are of their drive pairs."""
        if self.unsensed is not None:
            raise ConfigurationError(
                f"measurement {self.unsensed} is read by a current over which its drive pair "
                "decides, and no measurement of the protocol senses that pair; give transfer and "
                "drive-pair impedances, as Instrument.terminal_impedances does"
            )
        return np.stack([transfer, transfer[:, self.pairs]], axis=1)

    def _checked_arrays(self, impedance: Complex, times: Array) -> tuple[Complex, Array]:
        Z, times = np.asarray(impedance, np.complex128), np.asarray(times, np.float64)
        frames, m = times.shape, len(self.pairs)
        if Z.shape not in ((*frames, m), (*frames, 2, m)) or times.ndim != 1:
            raise FrameError(
                f"expected impedances of shape (frames, {m}) or (frames, 2, {m}) and a time for "
                f"each frame, got {Z.shape} and {times.shape}"
            )
        if Z.ndim == 2:
            Z = self._with_drive(Z)
        if not np.isfinite(Z).all():
            raise FrameError(
                "expected finite impedances, got NaN or infinity; leave these frames out"
            )
        if not ((times >= 0.0) & (times <= MAX_SESSION)).all():
            raise ConfigurationError(
                f"expected times from 0 to {MAX_SESSION:g} s after the session's start, got "
                f"{times.min():g} to {times.max():g} s; start another session"
            )
        return Z, times
