"""Messages between host and board, and their little-endian byte form.

`docs/reference/wire-protocol.md` is the written form of this module.
"""

import math
import struct
import zlib
from collections.abc import Callable, Iterable
from dataclasses import astuple, dataclass
from enum import IntEnum
from typing import Any, NamedTuple, cast

from eitskin.errors import ConfigurationError
from eitskin.extras import old_names
from eitskin.hardware.protocol.packets import (
    MAX_MEASUREMENTS,
    MAX_PAYLOAD,
    PER_PACKET,
    FrameData,
    FramePart,
    MessageError,
    MessageType,
    Packet,
    pack_frame,
    require_field,
    unpack_frame,
    unpack_part,
)
from eitskin.protocol import MAX_ELECTRODES, Protocol, Row

MAGIC = b"EITS"

_INFO = {1: struct.Struct("<4s16s12sIBBIffffI"), 2: struct.Struct("<4s16s12sIBHIffffI")}
_ANALOG = ("frequency", "amplitude", "rtia", "rcal")
_EVENT = struct.Struct("<BH")
_TABLE_PART = struct.Struct("<HH")
_ROWS_PER_PACKET = (MAX_PAYLOAD - _TABLE_PART.size) // 4


class AckStatus(IntEnum):
    """Status of an ACK."""

    DONE = 0
    UNKNOWN_TYPE = 1
    MALFORMED = 2
    BUSY = 3
    FAILED = 4


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
    """Request for the measurement table.

    Attributes:
        first: first row of a TablePart; None asks for the whole Table, of version 1.
    """

    first: int | None = None


@dataclass(frozen=True, slots=True)
class Calibrate:
    """Request to measure the calibration resistor again."""


@old_names(of="from_protocol")
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

    Example:
        >>> from eitskin import Protocol
        >>> from eitskin.hardware import Info
        >>> protocol = Protocol.pairwise(8)
        >>> info = Info.from_protocol(protocol, firmware="mine", period=0.3)
        >>> info.n_measurements
        28
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

    @classmethod
    def from_protocol(cls, protocol: Protocol, **known: Any) -> "Info":
        """Info of a board with a protocol; what is not known is NaN, zero or empty."""
        numbers: dict[str, Any] = dict.fromkeys((*_ANALOG, "period"), math.nan)
        numbers |= {"n_electrodes": protocol.n_electrodes, "n_measurements": len(protocol)}
        numbers |= {
            "firmware": "",
            "uid": bytes(12),
            "boot_count": 0,
            "table_crc32": Table.from_protocol(protocol).crc32,
        }
        return cls(**numbers | known)


@dataclass(frozen=True, slots=True)
class Ack:
    """Acknowledgement of request number `request` of type `type`."""

    request: int
    type: int
    status: int = AckStatus.DONE


@dataclass(frozen=True, slots=True)
class Event:
    """Line of text from the firmware; level 0 note, 1 warning, 2 error."""

    level: int
    code: int
    text: str


@dataclass(frozen=True, slots=True)
class Table:
    """Measurement table: rows of electrodes (drive+, drive-, sense+, sense-)."""

    rows: tuple[Row, ...]

    @classmethod
    def from_protocol(cls, protocol: Protocol) -> "Table":
        """Table of `protocol`; raises ConfigurationError for more than the wire can say."""
        if len(protocol) > MAX_MEASUREMENTS or protocol.n_electrodes > MAX_ELECTRODES:
            raise ConfigurationError(
                f"on the wire a frame holds at most {MAX_MEASUREMENTS} measurements of "
                f"{MAX_ELECTRODES} electrodes, the protocol is {protocol}; measure fewer"
            )
        return cls(protocol.table)

    @property
    def crc32(self) -> int:
        """CRC-32 of the packed table."""
        return zlib.crc32(_pack_rows(self.rows))


@dataclass(frozen=True, slots=True)
class TablePart:
    """Rows of the measurement table from number `first` on, of `total` in all."""

    total: int
    first: int
    rows: tuple[Row, ...]

    @classmethod
    def from_table(cls, table: Table, first: int) -> "TablePart":
        """As many rows of `table` from number `first` on as one packet holds."""
        return cls(len(table.rows), first, table.rows[first : first + _ROWS_PER_PACKET])


Request = Hello | Start | Stop | GetTable | Calibrate
Message = Request | Info | Ack | FrameData | FramePart | Event | Table | TablePart


def pack(message: Message, seq: int) -> Packet:
    """Packet number `seq`, modulo 65536, with `message`; frames in parts have `frame_packets`."""
    version = _version(message)
    type_ = _TYPES[type(message)]
    return Packet(type_, seq & 0xFFFF, _CODECS[version, type_].pack(message), version)


def _version(message: Message) -> int:
    """Version 2 for messages about tables that are larger than a frame in one packet."""
    if isinstance(message, Info):
        return 2 if message.n_measurements > PER_PACKET else 1
    paged = isinstance(message, GetTable) and message.first is not None
    return 2 if paged or isinstance(message, TablePart) else 1


def unpack(packet: Packet) -> Message:
    """Message in `packet`; raises MessageError for a packet without one."""
    try:
        name = MessageType(packet.type)
    except ValueError:
        raise MessageError(
            f"expected a message type from 0x01 to 0x05 or 0x81 to 0x85, got {packet.type:#04x}"
        ) from None
    codec = _CODECS.get((packet.version, name))
    if codec is None:
        raise MessageError(f"version {packet.version} of the protocol has no {name.name}")
    try:
        return codec.unpack(packet)
    except (struct.error, UnicodeDecodeError) as error:
        raise MessageError(
            f"{name.name} of {len(packet.payload)} bytes does not fit: {error}"
        ) from error


class _Codec(NamedTuple):
    """Bytes of a message: its class, and both directions."""

    message: type
    pack: Callable[[Any], bytes]
    unpack: Callable[[Packet], Message]


def _plain(message: Callable[..., Message], form: str = "") -> _Codec:
    """Codec of a message that consists of its first fields, in the form of `struct`."""
    packed = struct.Struct(f"<{form}")
    return _Codec(
        cast("type", message),
        lambda each: packed.pack(*astuple(each)[: len(form)]),
        lambda packet: message(*packed.unpack(packet.payload)),
    )


def _pack_info(info: Info) -> bytes:
    firmware, *numbers, period = astuple(info)
    form = _INFO[_version(info)]
    return form.pack(MAGIC, firmware.encode("ascii"), *numbers, round(period * 1e6))


def _unpack_info(packet: Packet) -> Info:
    magic, name, *numbers, period_us = _INFO[packet.version].unpack(packet.payload)
    firmware = _printable(name.rstrip(b"\0").decode("ascii"))
    info = Info(*(firmware, *numbers, period_us * 1e-6))
    least, most = (1, PER_PACKET) if packet.version == 1 else (PER_PACKET + 1, MAX_MEASUREMENTS)
    n_meas = info.n_measurements
    require_field("INFO", "magic", magic == MAGIC, f"{MAGIC!r}", magic)
    require_field("INFO", "n_el", info.n_electrodes >= 2, "at least 2", info.n_electrodes)
    require_field("INFO", "n_meas", least <= n_meas <= most, f"{least} to {most}", n_meas)
    for name in _ANALOG:
        value = getattr(info, name)
        good = math.isfinite(value) and value > 0
        require_field("INFO", name, good, "finite and positive", value)
    require_field("INFO", "period_us", period_us > 0, "at least 1", period_us)
    return info


def _pack_event(event: Event) -> bytes:
    text = event.text.encode("utf-8")[: MAX_PAYLOAD - _EVENT.size]
    return _EVENT.pack(event.level, event.code) + text


def _unpack_event(packet: Packet) -> Event:
    level, code = _EVENT.unpack_from(packet.payload)
    # The text is for people: a damaged letter is no reason to lose the other letters.
    text = packet.payload[_EVENT.size :].decode("utf-8", errors="replace")
    return Event(level, code, _printable(text))


def _printable(text: str) -> str:
    """Text with a question mark for each control character: it could command the terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)


def _pack_rows(rows: Iterable[Row]) -> bytes:
    return bytes(electrode for row in rows for electrode in row)


def _unpack_rows(payload: bytes) -> tuple[Row, ...]:
    whole = len(payload) > 0 and len(payload) % 4 == 0
    require_field("TABLE", "length", whole, "a positive multiple of 4", len(payload))
    return tuple(struct.iter_unpack("<4B", payload))


def _unpack_table_part(packet: Packet) -> TablePart:
    total, first = _TABLE_PART.unpack_from(packet.payload)
    part = TablePart(total, first, _unpack_rows(packet.payload[_TABLE_PART.size :]))
    end = first + len(part.rows)
    require_field("TABLE", "first", end <= total, f"up to {total}", end)
    return part


_CODECS = {
    (1, MessageType.HELLO): _plain(Hello),
    (1, MessageType.START): _plain(Start, "I"),
    (1, MessageType.STOP): _plain(Stop),
    (1, MessageType.GET_TABLE): _plain(GetTable),
    (2, MessageType.GET_TABLE): _plain(GetTable, "H"),
    (1, MessageType.CALIBRATE): _plain(Calibrate),
    (1, MessageType.INFO): _Codec(Info, _pack_info, _unpack_info),
    (2, MessageType.INFO): _Codec(Info, _pack_info, _unpack_info),
    (1, MessageType.ACK): _plain(Ack, "HBB"),
    (1, MessageType.FRAME): _Codec(FrameData, pack_frame, unpack_frame),
    (2, MessageType.FRAME): _Codec(FramePart, pack_frame, unpack_part),
    (1, MessageType.EVENT): _Codec(Event, _pack_event, _unpack_event),
    (1, MessageType.TABLE): _Codec(
        Table, lambda table: _pack_rows(table.rows), lambda p: Table(_unpack_rows(p.payload))
    ),
    (2, MessageType.TABLE): _Codec(
        TablePart,
        lambda part: _TABLE_PART.pack(part.total, part.first) + _pack_rows(part.rows),
        _unpack_table_part,
    ),
}
_TYPES = {codec.message: type_ for (_, type_), codec in _CODECS.items()}
