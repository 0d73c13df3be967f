"""Cases of the reference: touches, support, bend and variation of the sensor."""

from dataclasses import dataclass, field, replace
from typing import Literal

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.simulator.mechanics.layer_stack import Mechanics
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.scene.indenters import Cylinder, Sphere

Support = Literal["rigid", "plates", "substrate", "free"]


@dataclass(frozen=True, slots=True)
class Case:
    """Touches, or none, on a supported, possibly bent sensor.

    Attributes:
        name: of the case.
        touches: (x, y) of each touch [mm].
        force: of each touch [N].
        indenter: rough, of each touch.
        support: "rigid": the base is bonded. "plates": the base is bonded where |x - 75 mm| is at
            least half the span of 40 mm, and free between. "substrate": a soft layer of the
            sensor's outline is bonded to the base and to rigid ground. "free": the outer sides are
            held, base and top are free.
        angle: of the plates, each turned by half of it about an axis 8 mm below mid-layer [deg].
        thickness: of gel and stack over the reference sensor's.
        ratio: shear modulus of the encapsulation over the gel's.
        substrate: thickness [mm] and shear modulus [kPa] of the substrate.
    """

    name: str
    touches: tuple[tuple[float, float], ...]
    force: float = 10.0
    indenter: Cylinder | Sphere = field(default_factory=Cylinder)
    support: Support = "rigid"
    angle: float = 0.0
    thickness: float = 1.0
    ratio: float = 1.4
    substrate: tuple[float, float] = (10.0, 20.0)

    def design(self) -> SensorDesign:
        """Design of the sensor."""
        design = SensorDesign.reference()
        if self.thickness == 1.0:
            return design
        return replace(
            design,
            thickness=self.thickness * design.thickness,
            encapsulated_thickness=self.thickness * design.encapsulated_thickness,
        )

    def mechanics(self) -> Mechanics:
        """Materials of the sensor."""
        standard = Mechanics()
        modulus = self.ratio * standard.gel.shear_modulus
        return replace(standard, encapsulation=NeoHookean(modulus))
