"""Presses on a fitted twin, simulated, as a pipeline is adapted by them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from eitskin.config import read_toml
from eitskin.datasets.recipe.specimen import Specimen
from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.fixtures import Bend, Fixture
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.instrument.meter import FourTerminalMeter
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.indenters import Cylinder
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.scene.touch import Touch
from eitskin.training.twin.twin import Twin

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PressedTwin:
    """Twin of one sensor whose presses are simulated, for `Pipeline.adapt`.

    Attributes:
        specimen: fitted sensor, fixture and materials.
        meter: fitted circuit and reading of the board.
        protocol: of the measurements.
        resolution: of the simulator.
        nominal: sensor whose mesh and factors are shared, which halves the time; None for its own.
    """

    specimen: Specimen
    meter: FourTerminalMeter
    protocol: Protocol
    resolution: Resolution = "coarse"
    nominal: SensorDesign | None = None

    @classmethod
    def of(cls, twin: Twin) -> "PressedTwin":
        """Presses on a twin that was just fitted."""
        nominal = twin.nominal.design
        return cls(twin.specimen, twin.meter, twin.frames.protocol, twin.resolution, nominal)

    @classmethod
    def read(cls, folder: str | Path, protocol: Protocol) -> "PressedTwin":
        """Presses on the twin in a folder of `eitskin twin fit`, in measurements of a protocol.

        Raises ConfigurationError where a file of it is missing or damaged, or where the twin has
        another number of electrodes than the protocol.
        """
        place = Path(folder)
        design = SensorDesign.from_toml(place / "design.toml")
        fixture = read_toml(cast("type[Any]", Fixture), place / "fixture.toml")
        mechanics = read_toml(Mechanics, place / "mechanics.toml")
        meter = Instrument.from_toml(place / "rig.toml").meter or FourTerminalMeter()
        if protocol.n_electrodes != (count := len(design.electrodes)):
            raise ConfigurationError(
                f"expected a twin with {protocol.n_electrodes} electrodes, as the pipeline has, "
                f"got {count} in {folder}; fit the twin to the same sensor"
            )
        return cls(Specimen(design, fixture, mechanics), meter, protocol)

    def inside(self, places: Array) -> NDArray[np.bool_]:
        """Whether places (n, 2) [m] are on the sensor (n,).

        Raises ConfigurationError for a sensor whose outline is a surface.
        """
        outline = self.specimen.design.outline
        if isinstance(outline, Surface):
            raise ConfigurationError("expected a twin with a plane outline, got a surface")
        return outline.contains(places)

    def changes(self, touches: Array, angle_deg: float, radius: float) -> Array:
        """Changes of log V (n, C) by single touches (n, 3) of x [m], y [m] and force [N].

        Args:
            touches: one in each row.
            angle_deg: of the bend, before and during the touches [deg].
            radius: of the indenter, a cylinder [m].

        Raises ConfigurationError for bends or presses that the twin cannot have.
        """
        simulator = self.specimen.simulator(self.nominal, self.resolution, self.protocol)
        bend, indenter = Bend(angle_deg), Cylinder(round(radius, 6))
        pressed = ((Touch(x, y, force, indenter),) for x, y, force in touches.tolist())
        scenes = [Scene(bend=bend), *(Scene(bend=bend, touches=each) for each in pressed)]
        Z = np.real(simulator.impedances(scenes))
        reading, _ = self.meter.reading(self.meter.transfer_impedance(Z, self.protocol))
        logs = np.log(np.abs(reading))
        changes: Array = logs[1:] - logs[0]
        return changes
