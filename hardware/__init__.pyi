"""Public names of eitskin.hardware, and where each is defined."""

from eitskin.hardware.boards.board import (
    Board as Board,
)
from eitskin.hardware.boards.board import Connection as Connection
from eitskin.hardware.boards.board import (
    Counts as Counts,
)
from eitskin.hardware.boards.replay_board import ReplayBoard as ReplayBoard
from eitskin.hardware.boards.serial_board import SerialBoard as SerialBoard
from eitskin.hardware.diagnosis.reading_check import (
    ReadingCheck as ReadingCheck,
)
from eitskin.hardware.diagnosis.reading_check import (
    check_readings as check_readings,
)
from eitskin.hardware.diagnosis.sensor_check import (
    SensorCheck as SensorCheck,
)
from eitskin.hardware.diagnosis.sensor_check import (
    check_sensor as check_sensor,
)
from eitskin.hardware.live import (
    Estimate as Estimate,
)
from eitskin.hardware.live import (
    FramePipeline as FramePipeline,
)
from eitskin.hardware.live import LiveReadings as LiveReadings
from eitskin.hardware.live import (
    Reading as Reading,
)
from eitskin.hardware.live import (
    run_live as run_live,
)
from eitskin.hardware.opening import open_board as open_board
from eitskin.hardware.protocol.messages import Info as Info
from eitskin.hardware.virtual.stage import (
    Script as Script,
)
from eitskin.hardware.virtual.stage import Stage as Stage
from eitskin.hardware.virtual.stage import (
    Step as Step,
)
from eitskin.hardware.virtual.virtual_board import (
    VirtualBoard as VirtualBoard,
)
from eitskin.hardware.virtual.virtual_board import (
    open_virtual as open_virtual,
)
from eitskin.hardware.virtual.virtual_board import (
    virtual_terminal as virtual_terminal,
)
