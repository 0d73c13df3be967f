"""Electrode layouts that `eitskin bench layouts` compares."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import Rectangle
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.protocol import Protocol
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME

Array = NDArray[np.float64]

PAPER = "paper: 8 on the rim"
COUNTS = (6, 8, 10, 12, 16, 32)
WIDTHS = (0.002, 0.0035, 0.005, 0.008, 0.012)  # along the rim [m]
CONTACTS = (1e-5, 1e-4, 1e-3, 1e-2)  # [ohm m2]
BENT_COUNTS = (8, 12, 16, 32)  # of electrodes on the rim of bent sheets
ANGLES = (-20.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0)  # [deg]
SIZE = (0.150, 0.060)  # of the paper's sensor [m]
_RIM = 0.005  # from the rim to the middle of a pad beside it [m]


@dataclass(frozen=True, slots=True)
class Layout:
    """Electrode layout of a bent sensor, of which every pair is measured.

    Attributes:
        name: of the layout, for tables; says nothing about it.
        design: the sensor.
        angle_deg: of the bend at which it is judged [deg].
    """

    name: str
    design: SensorDesign
    angle_deg: float = 0.0

    @property
    def protocol(self) -> Protocol:
        """Protocol that measures all pairs."""
        return Protocol.pairwise(len(self.design.electrodes))

    @property
    def scan_time(self) -> float:
        """Time from one frame to the next [s]."""
        return len(self.protocol) * MEASUREMENT_TIME


def paper(angle_deg: float = 0.0) -> Layout:
    """Layout of the paper's sensor at a bend angle [deg]."""
    return Layout(PAPER, SensorDesign.reference(), angle_deg)


def with_electrodes(name: str, electrodes: Sequence[Electrode]) -> Layout:
    """Layout of the paper's sensor with other electrodes.

    Raises ConfigurationError, naming the layout, for electrodes that overlap or do not fit.
    """
    try:
        design = dataclasses.replace(SensorDesign.reference(), electrodes=tuple(electrodes))
    except ConfigurationError as error:
        raise ConfigurationError(f"layout '{name}': {error}") from error
    return Layout(name, design)


def sweeps() -> dict[str, tuple[Layout, ...]]:
    """Layouts by the name of their sweep; the paper's layout is in each."""
    return {
        "count": tuple(_counted(count) for count in COUNTS),
        "placement": tuple(_placements()),
        "width": tuple(
            with_electrodes(f"{1e3 * width:g} mm wide", _around(8, width=width)) for width in WIDTHS
        ),
        "contact": tuple(
            with_electrodes(f"{z:g} ohm m2", _around(8, contact_impedance=z)) for z in CONTACTS
        ),
        "bend": tuple(_bent(count, angle) for count in BENT_COUNTS for angle in ANGLES),
    }


def _around(count: int, width: float = 0.005, contact_impedance: float = 1e-3) -> list[Electrode]:
    """Electrodes evenly spaced on the rim, one in the middle of the lower side as in the paper."""
    outline = Rectangle(*SIZE)
    start = outline.length / 2 % (outline.perimeter / count)
    return list(uniform(outline, count, width, start, contact_impedance))


def _counted(count: int) -> Layout:
    return with_electrodes(f"{count} on the rim", _around(count))


def _bent(count: int, angle_deg: float) -> Layout:
    name = f"{count}, {angle_deg:g} deg"
    return dataclasses.replace(_counted(count), name=name, angle_deg=angle_deg)


def _placements() -> Iterator[Layout]:
    """Layouts of eight 5 mm electrodes: on the rim, on top beside it, on top all over, inside."""
    design = SensorDesign.reference()
    outline, half = Rectangle(*SIZE), design.thickness / 2
    yield paper()
    rim = np.array([(e.x, e.y) for e in design.electrodes])
    kinds: tuple[tuple[Literal["top", "inside"], float | None, str], ...] = (
        ("top", None, "on top"),
        ("inside", half, "inside"),
    )
    for on, z, where in kinds:
        beside = np.clip(rim, _RIM, np.array(SIZE) - _RIM)
        pads = [Electrode(x, y, z=z, on=on) for x, y in beside.tolist()]
        yield with_electrodes(f"{where}, beside the rim", pads)
        spread = grid(outline, 2, 4, 0.005, on=on, z=z)
        yield with_electrodes(f"{where}, 2 x 4", spread)
