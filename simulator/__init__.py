"""Physics: from a sensor, bent and pressed, to the impedances at its electrodes."""

from eitskin.simulator.forward import ForwardModel
from eitskin.simulator.frame import Frame, Status
from eitskin.simulator.instrument import WhiteNoise
from eitskin.simulator.protocol import Protocol
from eitskin.simulator.scene import Scene
from eitskin.simulator.simulator import Simulator
from eitskin.simulator.touch import Cylinder, Touch

__all__ = [
    "Cylinder",
    "ForwardModel",
    "Frame",
    "Protocol",
    "Scene",
    "Simulator",
    "Status",
    "Touch",
    "WhiteNoise",
]
