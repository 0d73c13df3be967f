"""Physics: from a sensor, bent and pressed, to the impedances at its electrodes."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
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

# Who wants a protocol or a frame need not wait for finite elements, interpolation and mechanics:
# each name is loaded when it is first asked for (PEP 562).
_OTHER_HOMES = {
    "EXACT": "reanalysis",
    "Cylinder": "indenters",
    "ForwardModel": "forward",
    "Profile": "indenters",
    "Sphere": "indenters",
    "Status": "frame",
    "Tolerance": "reanalysis",
}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        home = import_module(f"{__name__}.{_OTHER_HOMES.get(name, name.lower())}")
        value = globals()[name] = getattr(home, name)
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
