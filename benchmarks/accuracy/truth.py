"""Reference values of a flat sensor and of small changes in it, to compare models with."""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.accuracy.cases import REFERENCES, ModelCase
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.forward_model import ForwardModel

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Drop:
    """Conductivity that falls smoothly, by 30 % at most, about the position of a touch.

    sigma = sigma_0 (1 - depth exp(-r^2 / radius^2)), r the distance from (x, y, z).

    Attributes:
        x, y, z: where the drop is largest [m].
        background: sigma_0 [S/m].
        depth: largest relative drop.
        radius: at which the drop is 1/e of the largest [m].
    """

    x: float
    y: float
    z: float
    background: float = 1.0
    depth: float = 0.3
    radius: float = 0.008

    def __call__(self, points: Array) -> Array:
        """Conductivity [S/m], (...), at points (..., 3) [m]."""
        away = points - np.array([self.x, self.y, self.z])
        square = np.einsum("...i,...i->...", away, away)
        sigma: Array = self.background * (1.0 - self.depth * np.exp(-square / self.radius**2))
        return sigma


Frame: TypeAlias = Callable[[Drop | None], Array]


def drops(design: SensorDesign, seed: int, count: int = 5) -> tuple[Drop, ...]:
    """Drops at random positions on top of the layer."""
    outline = design.outline
    rng = np.random.default_rng(seed)
    places = rng.uniform((0.0, 0.0), (outline.length, outline.width), (count, 2))
    return tuple(Drop(float(x), float(y), design.thickness) for x, y in places)


def model_frame(model: ForwardModel) -> Frame:
    """Function from a conductivity to the 28 resistances [ohm] of `model`."""
    protocol = Protocol.pairwise(len(model.design.electrodes))

    def frame(drop: Drop | None) -> Array:
        return np.real(protocol.measure(model.impedance(drop)))

    return frame


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Reference resistances and signals, far more accurate than the models that are judged.

    Attributes:
        design: the sensor.
        drops: what changes it.
        resistances: of the flat sensor, (28,) [ohm].
        signals: their change by each drop, (drops, 28) [ohm].
        resistance_error, signal_error: by which a second reference differs, as in `Judgement`.
    """

    design: SensorDesign
    drops: tuple[Drop, ...]
    resistances: Array
    signals: Array
    resistance_error: float
    signal_error: float

    @classmethod
    def compute(cls, seed: int, references: tuple[ModelCase, ModelCase] = REFERENCES) -> "Truth":
        """Solve the reference sensor by the first reference, and check it by the second."""
        design = SensorDesign.reference()
        changes = drops(design, seed)
        first, second = (model_frame(each.model(design)) for each in references)
        flat = first(None)
        signals = np.array([first(drop) - flat for drop in changes])
        unchecked = cls(design, changes, flat, signals, np.nan, np.nan)
        check = judge(second, unchecked, least_seconds=0.0)
        return dataclasses.replace(
            unchecked, resistance_error=check.resistance_error, signal_error=check.signal_error
        )


@dataclass(frozen=True, slots=True)
class Judgement:
    """Errors and run time of a model.

    Attributes:
        resistance_error: largest relative error of the flat resistances.
        signal_error: norm of the error of the change over norm of the change, the largest of all
            drops.
        seconds: median time per frame of 28, conductivity evaluated, assembled and solved anew;
            of the processor, which other programs on the machine do not lengthen.
    """

    resistance_error: float
    signal_error: float
    seconds: float


def judge(frame: Frame, truth: Truth, least_seconds: float = 0.4) -> Judgement:
    """Compare `frame` with the truth and time it over all drops, several times where it is fast."""
    flat = frame(None)
    found, times = [], []
    for drop in truth.drops:
        start = time.process_time()
        found.append(frame(drop) - flat)
        times.append(time.process_time() - start)
    while sum(times) < least_seconds:
        start = time.process_time()
        frame(truth.drops[len(times) % len(truth.drops)])
        times.append(time.process_time() - start)
    missed = np.linalg.norm(np.array(found) - truth.signals, axis=1)
    return Judgement(
        resistance_error=float(np.abs(flat / truth.resistances - 1.0).max()),
        signal_error=float((missed / np.linalg.norm(truth.signals, axis=1)).max()),
        seconds=float(np.median(times)),
    )
