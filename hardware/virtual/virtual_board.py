"""A virtual board: the firmware's logic on simulated measurements, behind a pseudo-terminal.

The host opens it as it opens a real one, so both share every byte of the host's code.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar, cast, get_args

import numpy as np

from eitskin.errors import ConfigurationError, DeviceError
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.hardware.boards.port import Port, open_port
from eitskin.hardware.boards.serial_board import SerialBoard
from eitskin.hardware.protocol.messages import (
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
from eitskin.hardware.protocol.packets import Decoder, Packet, encode
from eitskin.hardware.virtual.fault import Fault, Hook
from eitskin.hardware.virtual.faults import read_faults
from eitskin.hardware.virtual.pseudo_terminal import Pace, PseudoTerminal
from eitskin.hardware.virtual.scene_script import (
    Measure,
    Measuring,
    SceneSource,
    Script,
    SimulatedSensor,
    Step,
    noise_free,
)
from eitskin.hardware.virtual.stage import Stage
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.resolution import Resolution
from eitskin.simulator.instrument.ad5940 import MEASUREMENT_TIME
from eitskin.simulator.instrument.instrument import Instrument
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator

SPEEDS = ("real", "max")
LONGEST_PERIOD = 3600.0
T = TypeVar("T")


class VirtualFirmware:
    """The firmware: bytes in, bytes out. It knows no port and no clock; whoever serves it does.

    Attributes:
        info: who the board says it is.
        streaming: whether frames are due.
        delay: by how much the frame after the newest is late [s].
        stage: what happens to the board.
    """

    def __init__(
        self,
        stage: Stage,
        protocol: Protocol,
        measure: Measure = noise_free,
        period: float | None = None,
    ) -> None:
        """Build a board that has not booted yet.

        Args:
            stage: the scene that it measures, and what goes wrong with it.
            protocol: its measurement table.
            measure: what it reads of noise-free impedances, by frames since it was built.
            period: from frame to frame [s]; 10.6 ms for each measurement when omitted.
        """
        self.stage = stage
        self.streaming, self.delay = False, 0.0
        self._protocol, self._measure = protocol, measure
        self._decoder = Decoder()
        self._seq = self._left = self._number = self._started = 0
        self._late = 0.0
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

    @property
    def holds_port(self) -> bool:
        """Whether another program has the port open."""
        return self._changed(Hook.PORT_HELD, False)

    @property
    def plugged_in(self) -> bool:
        """Whether the cable may be put back."""
        return not self._changed(Hook.STAYS_OUT, False)

    def boots_from(self, count: int) -> None:
        """Have the boot count go on from `count`, modulo 2**32."""
        self.info = dataclasses.replace(self.info, boot_count=count % 2**32)

    def boot(self) -> bytes:
        """Start afresh, and say so."""
        self.info = dataclasses.replace(self.info, boot_count=(self.info.boot_count + 1) % 2**32)
        self._start()
        return self._send(self._changed(Hook.INFO, self.info)) + self._send(
            Event(0, 0, f"boot {self.info.boot_count}")
        )

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host and answer them."""
        return b"".join(self._reply(packet) for packet in self._decoder.feed(data))

    def frame(self) -> bytes:
        """Measure the next frame and send it; raises `Unplugged` where a fault says so."""
        now, faults = self.stage.frames, self.stage.active
        if self._changed(Hook.REBOOTS, False, now, faults):
            self.stage.frames += 1
            return self.boot()
        impedance, status = self._measure(self.stage.measured(now), now)
        self.stage.sent_as(self._number)
        data = FrameData(
            number=self._number,
            time=(now - self._started) * self.info.period + self._late,
            duration=len(self._protocol) * MEASUREMENT_TIME,
            impedance=self._changed(Hook.IMPEDANCE, impedance.astype(np.complex64), now, faults),
            status=self._changed(Hook.STATUS, status, now, faults),
        )
        packet = encode(pack(data, self._seq))
        self._seq += 1
        self.skip()
        self.delay = self._changed(Hook.DELAY, 0.0, now, faults)
        self._late += self.delay
        packet = self._changed(Hook.PACKET, packet, now, faults)
        return self._changed(Hook.LINE, packet, now)

    def skip(self) -> None:
        """Let a frame pass that the host is too slow for."""
        self.stage.frames += 1
        self._number = (self._number + 1) % 2**32
        if self._left:
            self._left -= 1
            self.streaming = self._left > 0

    def _start(self) -> None:
        self._decoder = Decoder()
        self._seq = self._left = 0
        self._number = self._changed(Hook.FIRST_NUMBER, 0)
        self._started, self._late, self.delay = self.stage.frames, 0.0, 0.0
        self.streaming = self._changed(Hook.STREAMS, False)

    def _reply(self, packet: Packet) -> bytes:
        reply = self._changed(Hook.REPLY, self._answer(packet), self.stage.requests)
        self.stage.requests += 1
        return self._changed(Hook.LINE, reply)

    def _answer(self, packet: Packet) -> bytes:
        try:
            message = unpack(packet)
        except MessageError:
            return self._acknowledge(packet, Reply.MALFORMED)
        match message:
            case Hello():
                return self._packed(self._changed(Hook.INFO, self.info))
            case GetTable():
                return self._packed(self._table)
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
        return self._packed(Ack(packet.seq, packet.type, status))

    def _packed(self, message: Message) -> bytes:
        sent = encode(pack(message, self._seq))
        self._seq += 1
        return sent

    def _send(self, message: Message) -> bytes:
        return self._changed(Hook.LINE, self._packed(message))

    def _changed(
        self, hook: Hook, value: T, now: int | None = None, faults: Sequence[Fault] | None = None
    ) -> T:
        """The value that goes on from `hook`; the newest frame and faults when omitted."""
        now = self.stage.frames if now is None else now
        for fault in self.stage.active if faults is None else faults:
            value = fault.change(hook, value, now, self.info, self._protocol)
        return value


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
    sensor: str | Path | SensorDesign | None = None,
    period: float | None = None,
    link: str | Path | None = None,
) -> PseudoTerminal[VirtualFirmware]:
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
        simulator: of the sensor; one of `sensor` when omitted.
        sensor: a design, or the path of its TOML file; the reference sensor when omitted.
        period: from frame to frame [s]; the AD5940's when omitted.
        link: a path that leads to the terminal, also after the cable was pulled and put back.

    Raises ConfigurationError for an option that cannot be.
    """
    if speed not in SPEEDS:
        raise ConfigurationError(f"speed must be one of {', '.join(SPEEDS)}, got {speed!r}")
    if resolution not in get_args(Resolution):
        known = ", ".join(get_args(Resolution))
        raise ConfigurationError(f"resolution must be one of {known}, got {resolution!r}")
    if period is not None and not 1e-6 <= period <= LONGEST_PERIOD:
        raise ConfigurationError(
            f"period must be from 1e-06 to {LONGEST_PERIOD:g} s, as the wire can say it, got "
            f"{period}"
        )
    if simulator is None:
        simulator = Simulator(_design(sensor), resolution=cast("Resolution", resolution))
    elif sensor is not None:
        raise ConfigurationError("a simulator has its own sensor; give one of the two")
    if isinstance(instrument, str):
        instrument = Instrument.named(instrument)
    elif instrument is None and np.isfinite(snr_db):
        instrument = Instrument(snr_db)
    simulated = SimulatedSensor(simulator, instrument, seed, period)
    chosen = read_faults(faults) if isinstance(faults, str) else faults
    stage = Stage(simulated.solve, _scenes(scene), chosen)
    firmware = VirtualFirmware(stage, simulated.protocol, simulated.measure, period)
    terminal = PseudoTerminal(
        firmware, Pace(firmware.info.period if speed == "real" else 0.0), link
    )
    stage.changed = terminal.wake
    return terminal


def open_virtual(uri: str = "virtual:", **options: Any) -> SerialBoard:
    """Open a virtual board over its pseudo-terminal; the options are `virtual_terminal`'s."""
    terminal = virtual_terminal(**options)

    def connect() -> Port:
        if not terminal.path:
            raise DeviceError(f"{uri}: the virtual board is unplugged; clear its faults")
        return open_port(terminal.path, uri)

    terminal.start()
    try:
        return SerialBoard(
            connect,
            uri,
            and_close=terminal.close,
            stage=terminal.firmware.stage,
        )
    except BaseException:
        terminal.close()
        raise


def _design(sensor: str | Path | SensorDesign | None) -> SensorDesign:
    if sensor is None:
        return SensorDesign.reference()
    return sensor if isinstance(sensor, SensorDesign) else SensorDesign.from_toml(sensor)


def _scenes(scene: str | Path | Scene | SceneSource | None) -> SceneSource | None:
    if isinstance(scene, Scene):
        return Script((Step(scene),))
    if isinstance(scene, (str, Path)):
        return Script.from_toml(scene)
    return scene
