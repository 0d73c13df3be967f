"""Refusals of hardware: what was asked, the error, and the words that name the key or remedy."""

import dataclasses
import importlib
import sys
from functools import partial

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, DataError, DeviceError, FrameError
from eitskin.geometry import SensorDesign
from eitskin.hardware import Script, Step, open_board
from eitskin.hardware.boards import port
from eitskin.hardware.boards.port import PortInfo, connector, find_port
from eitskin.hardware.boards.text_board import open_text
from eitskin.hardware.diagnosis.reading_check import check_frames, check_readings
from eitskin.hardware.diagnosis.sensor_check import check_sensor
from eitskin.hardware.protocol.messages import Ack, Event, Table, pack
from eitskin.hardware.protocol.packets import (
    MAX_MEASUREMENTS,
    MAX_PAYLOAD,
    MessageType,
    Packet,
    encode,
)
from eitskin.hardware.ros2.messages import McapWriter
from eitskin.hardware.streams import UdpOutlet, WebSocketOutlet, parse_address
from eitskin.hardware.virtual.fault_table import read_faults
from eitskin.hardware.virtual.virtual_board import virtual_terminal
from eitskin.simulator import Frame, Protocol, Scene

from loopback import PROTOCOL, FakeSimulator, connected, firmware, take

NODE = "eitskin.hardware.ros2.skin_node"
BUILT_IN = PortInfo("/dev/ttyS0")
BOARD = PortInfo("/dev/ttyACM0", "EIT board", "ST", 0x0483, 0x5740, "205A3D")
TWIN = dataclasses.replace(BOARD, device="/dev/ttyACM1")
FRAME = Frame(np.ones(28), PROTOCOL)


def too_many():
    """Protocol with a measurement more than a packet has."""
    return Protocol(((0, 1, 2, 3),) * (MAX_MEASUREMENTS + 1), 4)


def among(ports, call, *arguments):
    """Call on a machine with these ports."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(port, "serial_ports", lambda: ports)
        return call(*arguments)


URIS = {
    "ttyACM0": "expected a board as serial:PORT",
    "virtuel:": "did you mean 'virtual:'",
    "serial:": "such as --board serial:/dev/ttyACM0",
    "serial:/dev/ttyACM0?usb=1": "not by both",
    "replay:": "needs a dataset's folder",
    "replay:x?speed=fast": "speed must be one of real, max",
    "virtual:?sped=max": "no option 'sped'; it has speed",
    "virtual:?seed=one": "option seed must be a number",
    "virtual:?simulator=x": "cannot be given in a URI",
    "virtual:scene.toml": r"write virtual:\?scene=scene.toml",
    "virtual:?speed=fast": "speed must be one of real, max",
    "virtual:?resolution=best": "resolution must be one of coarse, fast, standard, fine",
    "virtual:?faults=gremlins": "name among bit_flip",
    "virtual:?scene=missing.toml": "missing.toml",
    "virtual:?protocol=adjacent:16": "for 16 electrodes, the sensor has 8",
    "virtual:?instrument=ad": "'ad5940', got 'ad'",
    "virtual:?seed=-5&resolution=coarse": "seed must be from 0",
}
CONFIGURATION = {
    "option before opening": (lambda: open_board("replay:nowhere", sped="max"), "'sped'.*speed"),
    "several USB ports": (
        lambda: among((BOARD, TWIN), connector, "", "text:"),
        "such as --board text:/dev/ttyACM0",
    ),
    "text without protocol": (lambda: open_text("/dev/no", "text:"), "protocol=pairwise:8"),
    "protocol": (lambda: open_text("/dev/no", "text:", "ring"), "a protocol: pairwise"),
    "pause": (lambda: open_text("/dev/no", "text:", "pairwise:8", pause=0.0), "positive"),
    "pairs": (lambda: open_text("/dev/no", "text:", "pairwise:8", pairs="mag"), "deg, rad, imag"),
    "frequency": (lambda: open_text("/dev/no", "text:", "pairwise:8", frequency=-1), "positive"),
    "sensor twice": (
        lambda: virtual_terminal(simulator=FakeSimulator(), sensor=SensorDesign.reference()),
        "give the simulator or those",
    ),
    "protocol twice": (
        lambda: virtual_terminal(simulator=FakeSimulator(), protocol="adjacent"),
        "give the simulator or those",
    ),
    "script": (lambda: Script(()), "one step"),
    "step": (lambda: Step(Scene(), 0), "one frame"),
    "payload": (lambda: encode(Packet(1, 1, b"x" * (MAX_PAYLOAD + 1))), r"1009 bytes.*1010"),
    "table": (
        lambda: Table.from_protocol(too_many()),
        "at most 65535 measurements of 255 electrodes",
    ),
    "host": (lambda: UdpOutlet("no host", 1), "cannot find"),
    "expected shape": (lambda: check_sensor([FRAME], np.ones(27)), "shape"),
    "expected zero": (lambda: check_sensor([FRAME], np.zeros(28)), "positive"),
    "expected NaN": (lambda: check_sensor([FRAME], np.full(28, np.nan)), "positive"),
}
OTHERS = {
    "no such USB device": (
        lambda: among((BUILT_IN, BOARD), find_port, "7"),
        DeviceError,
        r"number '7'.*/dev/ttyS0 \(no USB\).*ttyACM0 \(EIT board, ST, 0483:5740, 205A3D\)",
    ),
    "no port": (lambda: among((), find_port, "7"), DeviceError, "No serial port"),
    "two devices of a number": (
        lambda: among((BOARD, TWIN), find_port, "205A3D"),
        DeviceError,
        r"2 ports .*/dev/ttyACM0.*/dev/ttyACM1",
    ),
    "a file": (lambda: open_board(f"serial:{__file__}"), DeviceError, "serial port"),
    "missing port": (lambda: open_board("serial:/dev/no"), DeviceError, "cable"),
    "USB number": (lambda: open_board("serial:?usb=A%201"), DeviceError, "serial number 'A 1'"),
    "USB number of text": (
        lambda: open_board("text:?protocol=pairwise:8&usb=A%201"),
        DeviceError,
        "serial number 'A 1'",
    ),
    "readings": (lambda: check_readings(np.ones((3, 27)), PROTOCOL), DataError, "28 channels"),
    "no frames": (lambda: check_frames([]), FrameError, "one protocol"),
    "no frame": (lambda: check_sensor([], np.ones(28)), FrameError, "at least one"),
    "two boards": (
        lambda: check_sensor([FRAME, Frame(np.ones(1), Protocol.pairwise(2))], np.ones(28)),
        FrameError,
        "one board at a time",
    ),
}
ANSWERS = {  # of a board that is asked who it is
    "INFO of 5 bytes": (encode(Packet(MessageType.INFO, 0, b"hello")), "it sent INFO of 5 bytes"),
    "bytes of a text": (b"\0RzMag: 600.0 Ohm\0", "bad stuffing.*baud rate"),
    "lines": (b"530.1, 529.8\r\n", "printed '530.1, 529.8'.*text:"),
    "unknown status": (
        encode(pack(Ack(1, MessageType.HELLO, 77), 0)),
        "status 77; check that its firmware fits",
    ),
    "event and status": (
        encode(pack(Event(2, 1, "check the SPI"), 0))
        + encode(pack(Ack(1, MessageType.HELLO, 4), 1)),
        r"refused HELLO: failed \(its firmware says: check the SPI\)$",
    ),
}
FAULTS = {
    "wrong_baud@0": "an answer to HELLO.*(baud rate|dropped|none came)",
    "wrong_version@0": "another version of the protocol",
    "wrong_count@0": "announced a table of 27",
    "wrong_table@0": "contradicts itself",
    "negative_ack@2": "refused START: busy",
}


def begin(faults):
    """Take the first frame of a board with faults."""
    take(connected(firmware(read_faults(faults)))[0], 1)


def meet(answer):
    """Meet a board with one answer to everything."""
    board = firmware()
    board.receive = lambda _: answer
    connected(board)


REFUSALS = [
    *((name, partial(meet, answer), DeviceError, said) for name, (answer, said) in ANSWERS.items()),
    *((text, partial(begin, text), DeviceError, said) for text, said in FAULTS.items()),
    ("electrodes", lambda: connected(firmware(n_electrodes=4)), DeviceError, "table cannot be"),
    *(
        (uri, lambda uri=uri: open_board(uri), ConfigurationError, said)
        for uri, said in URIS.items()
    ),
    *((name, call, ConfigurationError, said) for name, (call, said) in CONFIGURATION.items()),
    *((name, *row) for name, row in OTHERS.items()),
    *(
        (text, partial(read_faults, text), ConfigurationError, "among bit_flip")
        for text in ("gremlins", "bit_flip@x", "bit_flip@1:2:3", "bit_flip@-1")
    ),
    *(
        (
            f"period {period}",
            partial(virtual_terminal, simulator=FakeSimulator(), period=period),
            ConfigurationError,
            r"period.*1e-06 to 3600 s",
        )
        for period in (float("nan"), -1.0, 0.0, 5e-324, 1e9)
    ),
    *(
        (
            f"address {text}",
            partial(parse_address, "--udp", text),
            ConfigurationError,
            "--udp must be PORT or HOST:PORT",
        )
        for text in ("", "robot", "robot:x", "70000", "-1")
    ),
    *(
        (
            f"host {number}",
            partial(parse_address, "--udp", f"{host}:5"),
            ConfigurationError,
            "--udp: expected a name",
        )
        for number, host in enumerate(("\u202e", 300 * "a", "..", "x\0", "x y"))
    ),
]


@pytest.mark.parametrize(
    ("call", "error", "said"), [row[1:] for row in REFUSALS], ids=[row[0] for row in REFUSALS]
)
def test_what_cannot_be_is_refused_with_what_to_write(call, error, said, monkeypatch):
    monkeypatch.setattr("serial.tools.list_ports.comports", list)
    with pytest.raises(error, match=said):
        call()


@pytest.mark.parametrize(
    ("module", "extra", "use"),
    [
        ("rosbags", "ros", lambda: McapWriter("none/run.mcap")),
        ("cyclonedds", "ros2", lambda: importlib.import_module(NODE).SkinNode()),
        ("websockets.sync.server", "websocket", lambda: WebSocketOutlet("127.0.0.1", 0)),
    ],
)
def test_the_missing_extra_is_named(module, extra, use, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf"eitskin\[{extra}\]"):
        use()
