"""Messages between host and board, and their little-endian byte form.

`docs/wire-protocol.md` is the written form of this module.
"""

import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, DeviceError
from eitskin.hardware.protocol.packets import MAX_PAYLOAD, Packet
from eitskin.protocol import Protocol

MAGIC = b"EITS"

_START = struct.Struct("<I")
_INFO = struct.Struct("<4s16s12sIBBIffffI")
_ACK = struct.Struct("<HBB")
_FRAME = struct.Struct("<IQIBBH")
_EVENT = struct.Struct("<BH")
_BYTES_PER_CHANNEL = 9  # re f32, im f32, status u8
MAX_CHANNELS = (MAX_PAYLOAD - _FRAME.size) // _BYTES_PER_CHANNEL


class MessageType(IntEnum):
    """Message types: below 0x80 sent by the host, from 0x80 on by the board."""

    HELLO = 0x01
    START = 0x02
    STOP = 0x03
    GET_TABLE = 0x04
    CALIBRATE = 0x05
    INFO = 0x81
    ACK = 0x82
    FRAME = 0x83
    EVENT = 0x84
    TABLE = 0x85


class AckStatus(IntEnum):
    """Status of an ACK."""

    DONE = 0
    UNKNOWN_TYPE = 1
    MALFORMED = 2
    BUSY = 3
    FAILED = 4


class MessageError(DeviceError):
    """A whole packet that is no message of this protocol."""


@dataclass(frozen=True, slots=True)
class Hello:
    """Request for the board's identity; answered by Info."""


@dataclass(frozen=True, slots=True)
class Start:
    """Request for `frames` frames, without end for 0; a repetition restarts the count."""

    frames: int = 0


@dataclass(frozen=True, slots=True)
class Stop:
    """Request to send no more frames."""


@dataclass(frozen=True, slots=True)
class GetTable:
    """Request for the measurement table; answered by Table."""


@dataclass(frozen=True, slots=True)
class Calibrate:
    """Request to measure the calibration resistor again."""


@dataclass(frozen=True, slots=True)
class Info:
    """Identity and settings of a board; the answer to Hello, also sent once on boot.

    Attributes:
        firmware: name and version of the firmware, at most 16 ASCII characters.
        uid: unique number of the microcontroller, 12 bytes.
        boot_count: number of starts of the board; a new one voids all references.
        n_electrodes, n_measurements: size of the measurement table.
        table_crc32: CRC-32 of the packed table.
        frequency: excitation frequency [Hz].
        amplitude: excitation amplitude [V]; NaN where unknown.
        rtia, rcal: gain and calibration resistors [ohm]; NaN where unknown.
        period: time from one frame to the next [s], to the microsecond.
    """

    firmware: str
    uid: bytes
    boot_count: int
    n_electrodes: int
    n_measurements: int
    table_crc32: int
    frequency: float
    amplitude: float
    rtia: float
    rcal: float
    period: float


@dataclass(frozen=True, slots=True)
class Ack:
    """Acknowledgement of request number `request` of type `type`."""

    request: int
    type: int
    status: int = AckStatus.DONE


@dataclass(frozen=True, slots=True, eq=False)
class FrameData:
    """One frame as measured by the board.

    Attributes:
        number: count of frames since boot, modulo 2**32.
        time: start of the frame, since boot [s], to the microsecond.
        duration: time taken by all measurements [s], to the microsecond.
        impedance: (n,) complex64 [ohm]; may hold NaN and infinity.
        status: (n,) uint8, bits of `eitskin.frame.Status`.
        kind: 0 for a measurement of the sensor; others are reserved.
        flags: reserved, 0.
    """

    number: int
    time: float
    duration: float
    impedance: NDArray[np.complex64]
    status: NDArray[np.uint8]
    kind: int = 0
    flags: int = 0


@dataclass(frozen=True, slots=True)
class Event:
    """Line of text from the firmware; level 0 note, 1 warning, 2 error."""

    level: int
    code: int
    text: str


@dataclass(frozen=True, slots=True)
class Table:
    """Measurement table: rows of electrodes (drive+, drive-, sense+, sense-)."""

    rows: tuple[tuple[int, int, int, int], ...]

    @classmethod
    def of(cls, protocol: Protocol) -> "Table":
        """Table of `protocol`; raises ConfigurationError for more rows than one frame holds."""
        if len(protocol) > MAX_CHANNELS:
            raise ConfigurationError(
                f"one frame on the wire holds at most {MAX_CHANNELS} measurements, the protocol "
                f"has {len(protocol)}; measure fewer"
            )
        return cls(protocol.table)

    @property
    def crc32(self) -> int:
        """CRC-32 of the packed table."""
        return zlib.crc32(_pack_table(self))


Request = Hello | Start | Stop | GetTable | Calibrate
Message = Request | Info | Ack | FrameData | Event | Table


def pack(message: Message, seq: int) -> Packet:
    """Packet number `seq`, modulo 65536, with `message`."""
    type_, packed = _PACK[type(message)]
    return Packet(type_, seq & 0xFFFF, packed(message))


def unpack(packet: Packet) -> Message:
    """Message in `packet`; raises MessageError for a packet without one."""
    try:
        name = MessageType(packet.type)
    except ValueError:
        raise MessageError(
            f"expected a message type from 0x01 to 0x05 or 0x81 to 0x85, got {packet.type:#04x}"
        ) from None
    try:
        return _UNPACK[name](packet.payload)
    except (struct.error, UnicodeDecodeError) as error:
        raise MessageError(
            f"{name.name} of {len(packet.payload)} bytes does not fit: {error}"
        ) from error


def _pack_info(info: Info) -> bytes:
    return _INFO.pack(
        MAGIC,
        info.firmware.encode("ascii"),
        info.uid,
        info.boot_count,
        info.n_electrodes,
        info.n_measurements,
        info.table_crc32,
        info.frequency,
        info.amplitude,
        info.rtia,
        info.rcal,
        round(info.period * 1e6),
    )


def _unpack_info(payload: bytes) -> Info:
    magic, name, uid, boots, n_el, n_meas, crc, *analog, period_us = _INFO.unpack(payload)
    firmware = name.rstrip(b"\0").decode("ascii")
    frequency, amplitude, rtia, rcal = analog
    period = period_us * 1e-6
    info = Info(firmware, uid, boots, n_el, n_meas, crc, frequency, amplitude, rtia, rcal, period)
    _require("INFO", "magic", magic == MAGIC, f"{MAGIC!r}", magic)
    _require("INFO", "n_el", info.n_electrodes >= 2, "at least 2", info.n_electrodes)
    n = info.n_measurements
    _require("INFO", "n_meas", 1 <= n <= MAX_CHANNELS, f"1 to {MAX_CHANNELS}", n)
    for name in ("frequency", "amplitude", "rtia", "rcal"):
        value = getattr(info, name)
        _require("INFO", name, math.isfinite(value) and value > 0, "finite and positive", value)
    _require("INFO", "period_us", period_us > 0, "at least 1", period_us)
    return info


def _pack_frame(frame: FrameData) -> bytes:
    n = len(frame.impedance)
    times = round(frame.time * 1e6), round(frame.duration * 1e6)
    head = _FRAME.pack(frame.number & 0xFFFFFFFF, *times, frame.kind, n, frame.flags)
    return head + frame.impedance.astype("<c8").tobytes() + frame.status.tobytes()


def _unpack_frame(payload: bytes) -> FrameData:
    number, time_us, duration_us, kind, n, flags = _FRAME.unpack_from(payload)
    expected = _FRAME.size + _BYTES_PER_CHANNEL * n
    _require("FRAME", "length", len(payload) == expected, f"{expected} for n = {n}", len(payload))
    _require("FRAME", "n", n >= 1, "at least 1", n)
    return FrameData(
        number=number,
        time=time_us * 1e-6,
        duration=duration_us * 1e-6,
        impedance=np.frombuffer(payload, "<c8", n, _FRAME.size),
        status=np.frombuffer(payload, np.uint8, n, _FRAME.size + 8 * n),
        kind=kind,
        flags=flags,
    )


def _pack_event(event: Event) -> bytes:
    text = event.text.encode("utf-8")[: MAX_PAYLOAD - _EVENT.size]
    return _EVENT.pack(event.level, event.code) + text


def _unpack_event(payload: bytes) -> Event:
    level, code = _EVENT.unpack_from(payload)
    # The text is for people: a damaged letter is no reason to lose the other letters.
    return Event(level, code, payload[_EVENT.size :].decode("utf-8", errors="replace"))


def _pack_table(table: Table) -> bytes:
    return bytes(electrode for row in table.rows for electrode in row)


def _unpack_table(payload: bytes) -> Table:
    whole = len(payload) > 0 and len(payload) % 4 == 0
    _require("TABLE", "length", whole, "a positive multiple of 4", len(payload))
    return Table(tuple(struct.iter_unpack("<4B", payload)))


def _empty(message: Callable[[], Message]) -> Callable[[bytes], Message]:
    def unpack_nothing(payload: bytes) -> Message:
        name = getattr(message, "__name__", "")
        _require(name, "length", payload == b"", "0", len(payload))
        return message()

    return unpack_nothing


def _require(message: str, name: str, good: bool, expected: str, got: object) -> None:
    if not good:
        raise MessageError(f"{message}: {name} must be {expected}, got {got!r}")


_PACK: dict[type, tuple[MessageType, Callable[..., bytes]]] = {
    Hello: (MessageType.HELLO, lambda _: b""),
    Start: (MessageType.START, lambda start: _START.pack(start.frames)),
    Stop: (MessageType.STOP, lambda _: b""),
    GetTable: (MessageType.GET_TABLE, lambda _: b""),
    Calibrate: (MessageType.CALIBRATE, lambda _: b""),
    Info: (MessageType.INFO, _pack_info),
    Ack: (MessageType.ACK, lambda ack: _ACK.pack(ack.request, ack.type, ack.status)),
    FrameData: (MessageType.FRAME, _pack_frame),
    Event: (MessageType.EVENT, _pack_event),
    Table: (MessageType.TABLE, _pack_table),
}
_UNPACK: dict[MessageType, Callable[[bytes], Message]] = {
    MessageType.HELLO: _empty(Hello),
    MessageType.START: lambda payload: Start(*_START.unpack(payload)),
    MessageType.STOP: _empty(Stop),
    MessageType.GET_TABLE: _empty(GetTable),
    MessageType.CALIBRATE: _empty(Calibrate),
    MessageType.INFO: _unpack_info,
    MessageType.ACK: lambda payload: Ack(*_ACK.unpack(payload)),
    MessageType.FRAME: _unpack_frame,
    MessageType.EVENT: _unpack_event,
    MessageType.TABLE: _unpack_table,
}
