"""Changes of a hydrogel with time: random drift, temperature and drying.

Ions of a gel move faster by 2 % a kelvin, as in water (ISO 7888). They stay when water leaves,
and are hindered by the polymer: a share f of it leaves them ((1 - f) / (1 + f))^2 of their
mobility in water (Mackie and Meares, Proc. R. Soc. A 232 (1955) 498-509). A bonded layer loses its
water in thickness, h / h_0 = f_0 / f, in which the ions come closer by the same factor.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.bounds import require_in_range
from eitskin.errors import ConfigurationError
from eitskin.geometry.design.dispersion import scale_conductivity
from eitskin.geometry.design.sensor import SensorDesign

Array = NDArray[np.float64]

PER_KELVIN = 0.02
"""Relative change of the conductivity [1/K]."""
POLYMER_SHARE = 0.1
"""Share of polymer in the volume of a fresh gel."""
WARMING_TIME = 1800.0
"""Time constant with which a gel takes another temperature [s] (Newton's law of cooling)."""
DAY = 86400.0
_MAX_WARMING = 30.0  # K, either way


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
