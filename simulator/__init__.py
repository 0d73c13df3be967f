"""Physics: from a sensor, bent and pressed, to the impedances at its electrodes."""

from eitskin.simulator.forward import ForwardModel
from eitskin.simulator.frame import Frame, Status
from eitskin.simulator.indenters import Cylinder, Profile, Sphere
from eitskin.simulator.instrument import Instrument
from eitskin.simulator.mechanics import Mechanics
from eitskin.simulator.protocol import Protocol
from eitskin.simulator.reanalysis import EXACT, Tolerance
from eitskin.simulator.scene import Scene
from eitskin.simulator.session import Session
from eitskin.simulator.simulator import Simulator
from eitskin.simulator.touch import Touch

__all__ = [
    "EXACT",
    "Cylinder",
    "ForwardModel",
    "Frame",
    "Instrument",
    "Mechanics",
    "Profile",
    "Protocol",
    "Scene",
    "Session",
    "Simulator",
    "Sphere",
    "Status",
    "Tolerance",
    "Touch",
]
