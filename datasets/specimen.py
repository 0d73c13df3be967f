"""Sensors of one design that differ as hand-cast ones do."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from eitskin.datasets.schema import LIMITS
from eitskin.geometry import Hinge, SensorDesign


@dataclass(frozen=True, slots=True)
class Specimens:
    """How many sensors a recipe has and how much they differ from the design.

    Attributes:
        count: of specimens; frame i is of specimen i modulo count.
        conductivity: relative standard deviation of the layer's conductivity, lognormal.
        contact_impedance: the same of each electrode's contact impedance.
        hinge_offset: standard deviation of the hinge axis' place, normal [m].
    """

    count: int = 1
    conductivity: float = 0.0
    contact_impedance: float = 0.0
    hinge_offset: float = 0.0

    def problems(self) -> Iterator[str]:
        """Everything that cannot be."""
        if not 1 <= self.count <= LIMITS["specimen"]:
            yield f"specimens: count must be from 1 to {LIMITS['specimen']}, got {self.count}"
        for name, limit in (("conductivity", 1.0), ("contact_impedance", 1.0)):
            if not 0.0 <= getattr(self, name) <= limit:
                yield f"specimens: {name} must be from 0 to {limit:g}, got {getattr(self, name)}"
        if not 0.0 <= self.hinge_offset <= 0.01:
            yield f"specimens: hinge_offset must be from 0 to 0.01 m, got {self.hinge_offset}"


@dataclass(frozen=True, slots=True)
class Specimen:
    """One sensor on its fixture."""

    design: SensorDesign
    hinge: Hinge


def draw_specimen(
    spread: Specimens, design: SensorDesign, hinge: Hinge, rng: np.random.Generator
) -> Specimen:
    """A sensor that differs from `design` and `hinge` by `spread`; itself where that is zero."""
    design = _conducting(design, _factor(spread.conductivity, rng))
    electrodes = tuple(
        dataclasses.replace(
            electrode,
            contact_impedance=electrode.contact_impedance * _factor(spread.contact_impedance, rng),
        )
        for electrode in design.electrodes
    )
    offset = hinge.offset + spread.hinge_offset * float(rng.standard_normal())
    return Specimen(
        design=dataclasses.replace(design, electrodes=electrodes),
        hinge=dataclasses.replace(hinge, offset=offset),
    )


def _conducting(design: SensorDesign, factor: float) -> SensorDesign:
    """`design` with every conductivity times `factor`."""
    if not design.layers:
        return dataclasses.replace(design, conductivity=factor * design.conductivity)
    layers = (dataclasses.replace(x, conductivity=factor * x.conductivity) for x in design.layers)
    return dataclasses.replace(design, layers=tuple(layers))


def _factor(relative_deviation: float, rng: np.random.Generator) -> float:
    """A lognormal factor of median one and of the given relative standard deviation.

    With s^2 the variance of its logarithm, (deviation / mean)^2 = exp(s^2) - 1.
    """
    s = np.sqrt(np.log1p(relative_deviation**2))
    return float(np.exp(s * rng.standard_normal()))
