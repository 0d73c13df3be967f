"""A virtual board: the firmware's logic on simulated measurements, behind a pseudo-terminal.

The host opens it as it opens a real one, so both share every byte of the host's code.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from eitskin.geometry import ConfigurationError, SensorDesign
from eitskin.hardware.faults import Fault, read_faults
from eitskin.hardware.messages import (
    Ack,
    Calibrate,
    Event,
    FrameData,
    GetTable,
    Hello,
    Info,
    Message,
    MessageError,
    Reply,
    Start,
    Stop,
    Table,
    pack,
    unpack,
)
from eitskin.hardware.packets import Decoder, Packet, encode
from eitskin.hardware.port import open_port
from eitskin.hardware.pseudo_terminal import Pace, PseudoTerminal
from eitskin.hardware.script import Measuring, Reading, SceneSource, Script, SimulatedSensor, Step
from eitskin.hardware.serial_board import SerialBoard
from eitskin.simulator import Instrument, Protocol, Scene, Simulator
from eitskin.simulator.ad5940 import MEASUREMENT_TIME
from eitskin.simulator.resolution import Resolution

SPEEDS = ("real", "max")
Sensor = Callable[[int], Reading]
"""What is measured in the frame with a given number."""


class VirtualFirmware:
    """The firmware: bytes in, bytes out. It knows no port and no clock; whoever serves it does.

    Attributes:
        info: who the board says it is.
        streaming: whether frames are due.
    """

    def __init__(
        self,
        sensor: Sensor,
        protocol: Protocol,
        period: float | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        """Build a board that has not booted yet.

        Args:
            sensor: what it measures.
            protocol: its measurement table.
            period: from frame to frame [s]; 10.6 ms for each measurement when omitted.
            faults: what goes wrong with it.
        """
        self._sensor, self._protocol, self._faults = sensor, protocol, faults
        self._table = Table.of(protocol)
        self.info = Info(
            firmware="eitskin-virtual",
            uid=b"eitskin-0000",
            boot_count=0,
            n_electrodes=protocol.n_electrodes,
            n_measurements=len(protocol),
            table_crc32=self._table.crc32,
            frequency=40e3,
            amplitude=0.607,
            rtia=200.0,
            rcal=200.0,
            period=len(protocol) * MEASUREMENT_TIME if period is None else period,
        )
        self.streaming = False
        self._decoder = Decoder()
        self._seq = self._number = self._left = 0

    def boot(self) -> bytes:
        """Start afresh, and say so."""
        self.info = dataclasses.replace(self.info, boot_count=self.info.boot_count + 1)
        self.streaming = False
        self._decoder = Decoder()
        self._seq = self._number = self._left = 0
        return self._send(self.info) + self._send(Event(0, 0, f"boot {self.info.boot_count}"))

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host and answer them."""
        return b"".join(self._answer(packet) for packet in self._decoder.feed(data))

    def frame(self) -> bytes:
        """Measure the next frame and send it; raises `Unplugged` where a fault says so."""
        number = self._number
        impedance, status = self._sensor(number)
        data = FrameData(
            number=number,
            time=number * self.info.period,
            duration=len(self._protocol) * MEASUREMENT_TIME,
            impedance=impedance.astype(np.complex64),
            status=status,
        )
        for fault in self._faults:
            data = fault.measured(data, self._protocol, self.info.frequency)
        sent = self._send(data)
        for fault in self._faults:
            sent = fault.sent(number, sent)
        self.skip()
        return sent

    def skip(self) -> None:
        """Let a frame pass that the host is too slow for."""
        self._number += 1
        if self._left:
            self._left -= 1
            self.streaming = self._left > 0

    def _answer(self, packet: Packet) -> bytes:
        try:
            message = unpack(packet)
        except MessageError:
            return self._acknowledge(packet, Reply.MALFORMED)
        match message:
            case Hello():
                return self._send(self.info)
            case GetTable():
                return self._send(self._table)
            case Start(frames):
                self._left, self.streaming = frames, True
            case Stop():
                self.streaming = False
            case Calibrate():
                pass  # its resistor is exact
            case _:
                return self._acknowledge(packet, Reply.UNKNOWN_TYPE)
        return self._acknowledge(packet, Reply.DONE)

    def _acknowledge(self, packet: Packet, status: Reply) -> bytes:
        return self._send(Ack(packet.seq, packet.type, status))

    def _send(self, message: Message) -> bytes:
        sent = encode(pack(message, self._seq))
        self._seq += 1
        return sent


def virtual_terminal(
    *,
    speed: str = "real",
    resolution: str = "fast",
    scene: str | Path | Scene | SceneSource | None = None,
    seed: int = 0,
    snr_db: float = 75.0,
    instrument: Instrument | str | None = None,
    faults: str | Sequence[Fault] = (),
    simulator: Measuring | None = None,
    period: float | None = None,
) -> PseudoTerminal:
    """A virtual board on a pseudo-terminal, not yet served.

    Args:
        speed: "real", paced as the AD5940 is, or "max", as fast as it is read.
        resolution: of the simulator.
        scene: a scene, a `Script`, a function from frame number to scene, or the path of a TOML
            file that holds one of the first two; the flat untouched sensor when omitted.
        seed: of the instrument.
        snr_db: the noise's distance below full scale [dB]; infinity for none.
        instrument: that measures, in one session, or its name; white noise of `snr_db` when
            omitted.
        faults: what goes wrong, as text or as `Fault`s.
        simulator: of the sensor; one of the reference design when omitted.
        period: from frame to frame [s]; the AD5940's when omitted.

    Raises ConfigurationError for an option that cannot be.
    """
    if speed not in SPEEDS:
        raise ConfigurationError(f"speed must be one of {', '.join(SPEEDS)}, got {speed!r}")
    if resolution not in get_args(Resolution):
        known = ", ".join(get_args(Resolution))
        raise ConfigurationError(f"resolution must be one of {known}, got {resolution!r}")
    if simulator is None:
        simulator = Simulator(SensorDesign.reference(), resolution=cast("Resolution", resolution))
    if isinstance(instrument, str):
        instrument = Instrument.named(instrument)
    elif instrument is None and np.isfinite(snr_db):
        instrument = Instrument(snr_db)
    sensor = SimulatedSensor(simulator, _scenes(scene), instrument, seed, period)
    chosen = read_faults(faults) if isinstance(faults, str) else faults
    firmware = VirtualFirmware(sensor, sensor.protocol, period, chosen)
    return PseudoTerminal(firmware, Pace(firmware.info.period if speed == "real" else 0.0))


def open_virtual(uri: str = "virtual:", **options: Any) -> SerialBoard:
    """Open a virtual board over its pseudo-terminal; the options are `virtual_terminal`'s."""
    terminal = virtual_terminal(**options)
    terminal.start()
    try:
        return SerialBoard(open_port(terminal.path, uri), uri, and_close=terminal.close)
    except BaseException:
        terminal.close()
        raise


def _scenes(scene: str | Path | Scene | SceneSource | None) -> SceneSource:
    if scene is None:
        return Script((Step(Scene()),))
    if isinstance(scene, Scene):
        return Script((Step(scene),))
    if isinstance(scene, (str, Path)):
        return Script.from_toml(scene)
    return scene
