"""Deformation of the layer by presses on a bent sensor, solved as one problem."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.deformation.kinematics import Deformation, Gradients, OnePass, Points, mapped
from eitskin.simulator.layer.dents import Dent, Dents, PlacedDent
from eitskin.simulator.presses.contact_frame import ContactFrame

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class BentPresses(OnePass):
    """Bend of the layer, dents turned to its top, and the correction of both in the finite stack.

    All displacements are added up.

    Attributes:
        bend: of the untouched layer.
        presses: dents with their frames.
        correction: displacement [m] and mean stress [Pa], without dents of its own.
    """

    bend: Deformation
    presses: tuple[tuple[ContactFrame, Dent], ...]
    correction: Dents

    def mapped(self, points: Points) -> tuple[Points, Gradients]:
        """Positions and deformation gradient in one pass."""
        positions, F = mapped(self.bend, points)
        corrected, slope = self.correction.mapped(points)
        positions = positions + (corrected - points)
        F = F + (slope - np.eye(3))
        for frame, dents in self._dents():
            stretched = frame.stretched(points)
            pressed, slope = dents.mapped(stretched)
            positions = positions + frame.turned(pressed - stretched)
            F = F + frame.gradient(slope - np.eye(3))
        return positions, F

    def mean_stress(self, points: Points) -> Array:
        """Mean stress by the presses [Pa] at flat points (..., 3) [m], (...)."""
        stress = self.correction.mean_stress(points)
        for frame, dents in self._dents():
            stress = stress + dents.mean_stress(frame.stretched(points))
        return stress

    def _dents(self) -> list[tuple[ContactFrame, Dents]]:
        return [
            (frame, Dents((PlacedDent(frame.x, frame.y, dent),))) for frame, dent in self.presses
        ]
