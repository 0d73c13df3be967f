"""Public names of eitskin.geometry, and where each is defined."""

from eitskin.errors import (
    ConfigurationError as ConfigurationError,
)
from eitskin.errors import (
    DataError as DataError,
)
from eitskin.errors import (
    DeviceError as DeviceError,
)
from eitskin.errors import (
    EitskinError as EitskinError,
)
from eitskin.errors import (
    FrameError as FrameError,
)
from eitskin.errors import (
    PartialError as PartialError,
)
from eitskin.errors import (
    UnusableFrameError as UnusableFrameError,
)
from eitskin.geometry.deformation.fixtures import (
    Bend as Bend,
)
from eitskin.geometry.deformation.fixtures import (
    Clamp as Clamp,
)
from eitskin.geometry.deformation.fixtures import (
    FreeArc as FreeArc,
)
from eitskin.geometry.deformation.fixtures import (
    Hinge as Hinge,
)
from eitskin.geometry.deformation.fixtures import (
    Roll as Roll,
)
from eitskin.geometry.deformation.fixtures import (
    Twist as Twist,
)
from eitskin.geometry.design.dispersion import (
    ColeCole as ColeCole,
)
from eitskin.geometry.design.dispersion import (
    ConductivityTable as ConductivityTable,
)
from eitskin.geometry.design.electrode import Electrode as Electrode
from eitskin.geometry.design.inclusion import (
    Inclusion as Inclusion,
)
from eitskin.geometry.design.outline import (
    Disc as Disc,
)
from eitskin.geometry.design.outline import (
    Outline as Outline,
)
from eitskin.geometry.design.outline import (
    PlaneOutline as PlaneOutline,
)
from eitskin.geometry.design.outline import (
    Polygon as Polygon,
)
from eitskin.geometry.design.outline import (
    Rectangle as Rectangle,
)
from eitskin.geometry.design.patches import Contacts as Contacts
from eitskin.geometry.design.sensor import (
    Free as Free,
)
from eitskin.geometry.design.sensor import (
    Layer as Layer,
)
from eitskin.geometry.design.sensor import (
    Plates as Plates,
)
from eitskin.geometry.design.sensor import (
    Rigid as Rigid,
)
from eitskin.geometry.design.sensor import (
    SensorDesign as SensorDesign,
)
from eitskin.geometry.design.sensor import (
    Substrate as Substrate,
)
from eitskin.geometry.design.sensor import (
    Support as Support,
)
from eitskin.geometry.design.surface import Surface as Surface
from eitskin.geometry.meshing.mesh import Mesh as Mesh
from eitskin.geometry.meshing.mesh_design import structured_mesh as structured_mesh
