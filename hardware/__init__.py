"""Boards: the wire, the host's side of it, virtual boards, recordings, and the live loop."""

from eitskin.hardware.board import Board, Counts, open_board
from eitskin.hardware.connection import Connection
from eitskin.hardware.live import Estimate, FramePipeline, Reading, run_live
from eitskin.hardware.messages import Info
from eitskin.hardware.replay import ReplayBoard
from eitskin.hardware.script import Script, Step
from eitskin.hardware.sensor_check import SensorCheck, check_sensor
from eitskin.hardware.serial_board import SerialBoard
from eitskin.hardware.stage import Stage
from eitskin.hardware.virtual import open_virtual, virtual_terminal

__all__ = [
    "Board",
    "Connection",
    "Counts",
    "Estimate",
    "FramePipeline",
    "Info",
    "Reading",
    "ReplayBoard",
    "Script",
    "SensorCheck",
    "SerialBoard",
    "Stage",
    "Step",
    "check_sensor",
    "open_board",
    "open_virtual",
    "run_live",
    "virtual_terminal",
]
