"""Public names of eitskin.simulator, and where each is defined."""

from eitskin.frame import (
    Frame as Frame,
)
from eitskin.frame import (
    Status as Status,
)
from eitskin.protocol import Protocol as Protocol
from eitskin.simulator.deformation.sensor_grid import SensorGrid as SensorGrid
from eitskin.simulator.electrical.batch import (
    EXACT as EXACT,
)
from eitskin.simulator.electrical.batch import (
    Tolerance as Tolerance,
)
from eitskin.simulator.electrical.forward_model import ForwardModel as ForwardModel
from eitskin.simulator.instrument.drift import Session as Session
from eitskin.simulator.instrument.drift import (
    age_gel as age_gel,
)
from eitskin.simulator.instrument.instrument import Instrument as Instrument
from eitskin.simulator.instrument.meter import FourTerminalMeter as FourTerminalMeter
from eitskin.simulator.instrument.meter_fit import (
    MeterFit as MeterFit,
)
from eitskin.simulator.instrument.meter_fit import (
    fit_meter as fit_meter,
)
from eitskin.simulator.instrument.meter_fit import select_meter as select_meter
from eitskin.simulator.mechanics.layer_stack import Mechanics as Mechanics
from eitskin.simulator.scene.indenters import (
    Cylinder as Cylinder,
)
from eitskin.simulator.scene.indenters import (
    Footprint as Footprint,
)
from eitskin.simulator.scene.indenters import (
    Profile as Profile,
)
from eitskin.simulator.scene.indenters import (
    Sphere as Sphere,
)
from eitskin.simulator.scene.scene import Scene as Scene
from eitskin.simulator.scene.scene import Touch as Touch
from eitskin.simulator.simulator import Simulator as Simulator
