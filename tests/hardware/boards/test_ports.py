"""Choice of a port: by path, by USB serial number, or the only one."""

import dataclasses
import termios
import types

import pytest
import serial.tools.list_ports

from eitskin.errors import DeviceError
from eitskin.hardware.boards import port
from eitskin.hardware.boards.port import (
    PortInfo,
    connector,
    find_port,
    open_port,
    usb_serial_of,
)

BUILT_IN = PortInfo("/dev/ttyS0")
BOARD = PortInfo("/dev/ttyACM0", "EIT board", "ST", 0x0483, 0x5740, "205A3D")
OTHER = PortInfo("/dev/ttyUSB0", "FT232R", "FTDI", 0x0403, 0x6001, "A10 1&2")


class Bus:
    """Ports that come and go, and what was opened."""

    def __init__(self, *ports):
        self.ports, self.opened = list(ports), []

    def __call__(self):
        return tuple(self.ports)

    def open(self, path, uri, baud):
        self.opened.append((path, uri, baud))
        return object()

    def connector(self, path, uri, usb=""):
        return connector(path, uri, 230400, usb, ports=self, opened=self.open)


def test_a_port_is_found_by_its_serial_number():
    assert find_port("205A3D", Bus(BUILT_IN, OTHER, BOARD)) == "/dev/ttyACM0"


def test_the_serial_number_of_a_path_or_a_link_to_it(tmp_path):
    here = Bus(BUILT_IN, dataclasses.replace(BOARD, device=str(tmp_path / "real")))
    (tmp_path / "by-id").symlink_to(tmp_path / "real")
    assert usb_serial_of(str(tmp_path / "real"), here) == "205A3D"
    assert usb_serial_of(str(tmp_path / "by-id"), here) == "205A3D"
    assert usb_serial_of("/dev/ttyS0", here) == ""
    assert usb_serial_of("/dev/none", here) == ""


def test_the_only_usb_port_needs_no_name():
    bus = Bus(BUILT_IN, BOARD)
    bus.connector("", "text:")()
    assert bus.opened == [("/dev/ttyACM0", "text:", 230400)]


def test_by_serial_number_a_port_is_looked_for_at_every_connection():
    bus = Bus(BOARD)
    connect = bus.connector("", "serial:?usb=205A3D", usb="205A3D")
    connect()
    bus.ports = [OTHER, dataclasses.replace(BOARD, device="/dev/ttyACM3")]
    connect()
    assert [path for path, *_ in bus.opened] == ["/dev/ttyACM0", "/dev/ttyACM3"]
    bus.ports = [OTHER]
    with pytest.raises(DeviceError, match="205A3D"):
        connect()


def test_a_board_that_was_named_by_path_is_followed_to_another():
    bus = Bus(BOARD, BUILT_IN)
    connect = bus.connector("/dev/ttyACM0", "serial:/dev/ttyACM0")
    connect()
    # Another device has its place now.
    bus.ports = [dataclasses.replace(OTHER, device="/dev/ttyACM0")]
    bus.ports += [dataclasses.replace(BOARD, device="/dev/ttyACM1")]
    connect()
    bus.ports = []
    connect()
    assert [path for path, *_ in bus.opened] == ["/dev/ttyACM0", "/dev/ttyACM1", "/dev/ttyACM0"]


def test_a_port_that_vanishes_while_it_is_opened_is_a_device_error(monkeypatch):
    def vanish(*_, **__):
        raise termios.error(5, "Input/output error")

    monkeypatch.setattr("serial.Serial", vanish)
    with pytest.raises(DeviceError, match="cannot open"):
        open_port("/dev/ttyACM0", "serial:/dev/ttyACM0")


def test_a_port_without_serial_number_is_its_path():
    bus = Bus(BUILT_IN)
    connect = bus.connector("/dev/ttyS0", "serial:/dev/ttyS0")
    bus.ports = []
    connect()
    assert bus.opened == [("/dev/ttyS0", "serial:/dev/ttyS0", 230400)]


def test_the_uri_of_a_port_opens_it_again():
    assert BUILT_IN.uri == "serial:/dev/ttyS0"
    assert BOARD.uri == "serial:?usb=205A3D"
    assert OTHER.uri == "serial:?usb=A10%201%262"


def test_what_pyserial_lists_is_taken_over(monkeypatch):
    found = [
        types.SimpleNamespace(
            device="/dev/ttyUSB0", description="n/a", manufacturer=None, vid=None, pid=None,
            serial_number=None,
        ),
        types.SimpleNamespace(
            device="/dev/ttyACM0", description="EIT board", manufacturer="ST", vid=0x0483,
            pid=0x5740, serial_number="205A3D",
        ),
    ]  # fmt: skip
    monkeypatch.setattr(serial.tools.list_ports, "comports", lambda: found)
    assert port.serial_ports() == (BOARD, PortInfo("/dev/ttyUSB0"))
    with pytest.raises(DeviceError, match=r"cable.*/dev/ttyACM0 \(EIT board"):
        port.open_port("/dev/nowhere-at-all", "serial:/dev/nowhere-at-all")
