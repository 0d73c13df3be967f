"""Sensor that is touched: its design, materials and plates, and the way to its corrections."""

from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.design.sensor import Plates, SensorDesign
from eitskin.simulator.deformation.contact import BentState, ContactFrame
from eitskin.simulator.deformation.corrections import is_tabulable
from eitskin.simulator.deformation.node_sums import NodeSums
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid
from eitskin.simulator.deformation.solution_store import Problem
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.scene.scene import AnyIndenter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
TouchModel = Literal["tabulated", "solved"]


class PlatesUnder(Protocol):
    """Plates under a sensor at one angle, as its presses see them."""

    @property
    def bend(self) -> Deformation | None:
        """Bend of the gel; None where the plates are flat."""
        ...

    @property
    def state(self) -> BentState | None:
        """Equilibrium of the whole bent stack, which takes seconds; None where it is flat."""
        ...

    def problem(self, indenter: AnyIndenter) -> Problem:
        """Table of what the plates change of presses by an indenter."""
        ...

    def reaches(self, indenter: AnyIndenter, x: float, depth: float) -> bool:
        """Whether the table reaches to a dent at x of a depth [m]."""
        ...

    def evaluate(
        self, indenter: AnyIndenter, places: Array, scenes: Indices, sums: NodeSums | None
    ) -> Array:
        """Add what the plates change of presses (x, y, depth), (n, 3) [m], to scenes (n,) of sums.

        Returns by how much deeper each sinks [m], (n,).
        """
        ...


class PressedSensor(NamedTuple):
    """Sensor that is touched.

    Attributes:
        design: design of the sensor, with its support.
        mechanics: materials.
        model: way to the corrections of dents; None chooses.
        grid: nominal values about which tables are solved.
        plates: plates that hold the sensor and may bend it; None on another support.
    """

    design: SensorDesign
    mechanics: Mechanics
    model: TouchModel | None = None
    grid: SensorGrid = OWN_GRID
    plates: PlatesUnder | None = None

    @property
    def is_tabulable(self) -> bool:
        """Whether corrections of its presses can be tabulated."""
        on_plates = isinstance(self.design.support, Plates)
        return is_tabulable(self.design) and on_plates == (self.plates is not None)

    @property
    def bend(self) -> Deformation | None:
        """Bend by the plates, in which the sensor is pressed; None for one pressed flat."""
        return None if self.plates is None else self.plates.bend

    @property
    def state(self) -> BentState | None:
        """Equilibrium of the bent stack, solved in some seconds; None for one pressed flat."""
        return None if self.plates is None else self.plates.state

    def frame(self, shape: BentState | Deformation, x: float, y: float) -> ContactFrame:
        """Frame of the top of the bent stack under (x, y) [m]."""
        return ContactFrame.from_bent_top(shape, x, y, self.mechanics.stack(self.design))
