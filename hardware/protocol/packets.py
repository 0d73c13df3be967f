"""Packets: framing by byte stuffing, checksum, a decoder for any stream, and frames in parts.

    packet = 00 | COBS(version u8, type u8, seq u16, payload, crc32 u32) | 00

Consistent overhead byte stuffing (Cheshire and Baker, 1999) leaves no zero inside a packet, so a
zero always ends a packet, and damage costs no more than the packets that it lies in.

A frame of at most `PER_PACKET` measurements is one packet of version 1. A larger frame is sent in
parts, packets of version 2, each as soon as it is measured. A part holds the checksum of the packet
with the part before it, so that no parts of different frames are ever joined.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum, StrEnum

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError, DeviceError
from eitskin.extras import require

VERSIONS = (1, 2)
"""Versions of the wire protocol; version 2 adds frames of several packets."""
MAX_PACKET = 1024
"""Longest packet on the wire, both zeros included [bytes]."""

_HEADER = struct.Struct("<BBH")
_CRC = struct.Struct("<I")
_MAX_STUFFED = MAX_PACKET - 2
# A stuffed byte string is longer by one byte per 254, rounded up.
MAX_PAYLOAD = _MAX_STUFFED - (_MAX_STUFFED + 254) // 255 - _HEADER.size - _CRC.size
"""Longest payload that fits into a packet [bytes]."""
_FRAME = struct.Struct("<IQIBBH")
_PART = struct.Struct("<HHI")
_BYTES_PER_CHANNEL = 9  # re f32, im f32, status u8
PER_PACKET = (MAX_PAYLOAD - _FRAME.size) // _BYTES_PER_CHANNEL
"""Most measurements in one packet, a whole frame or a part."""
MAX_MEASUREMENTS = 0xFFFF
"""Most measurements in a frame, as their number has two bytes."""


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


class MessageError(DeviceError):
    """A whole packet that is no message of this protocol."""


def require_field(message: str, name: str, good: bool, expected: str, got: object) -> None:
    """Raise MessageError for a field of a message that is not as expected."""
    if not good:
        raise MessageError(f"{message}: {name} must be {expected}, got {got!r}")


class PacketDrop(StrEnum):
    """Reasons for dropping received bytes."""

    TOO_LONG = "too long"
    STUFFING = "bad stuffing"
    TOO_SHORT = "too short"
    CHECKSUM = "bad checksum"
    VERSION = "other version"
    MALFORMED = "malformed message"
    STALE = "repeated or late frame"
    PART = "part of an incomplete frame"


@dataclass(frozen=True, slots=True)
class Packet:
    """Content of one packet.

    Attributes:
        type: message type of the payload.
        seq: number of the request, or of the packet from the board, 0 to 65535.
        payload: the packed message.
        version: version of the wire protocol that the payload is written in.
    """

    type: int
    seq: int
    payload: bytes = b""
    version: int = 1

    @property
    def checksum(self) -> int:
        """CRC-32 that the packet ends with."""
        return zlib.crc32(self.content)

    @property
    def content(self) -> bytes:
        """Bytes that the checksum is of: header and payload."""
        return _HEADER.pack(self.version, self.type, self.seq) + self.payload


def encode(packet: Packet) -> bytes:
    """Bytes of `packet` on the wire; raises ConfigurationError for a payload too long."""
    if len(packet.payload) > MAX_PAYLOAD:
        raise ConfigurationError(
            f"a packet carries at most {MAX_PAYLOAD} bytes, got {len(packet.payload)}; split the "
            "message"
        )
    whole = packet.content + _CRC.pack(packet.checksum)
    stuffed: bytes = require("cobs.cobs", "hardware").encode(whole)
    return b"\0" + stuffed + b"\0"


class Decoder:
    """Decoder of a byte stream, in chunks of any size, into packets.

    Attributes:
        drops: count of dropped packets, by reason.
    """

    def __init__(self) -> None:
        """Start between two packets."""
        self.drops: Counter[PacketDrop] = Counter()
        self._cobs = require("cobs.cobs", "hardware")
        self._partial = bytearray()
        self._skipping = False

    def restart(self) -> None:
        """Discard an unfinished packet; the bytes that follow belong to another stream."""
        self._partial.clear()
        self._skipping = False

    @property
    def buffered_bytes(self) -> int:
        """Number of bytes held of an unfinished packet, at most `MAX_PACKET`."""
        return len(self._partial)

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Packets completed by `data`; bytes that are no packet are dropped and counted."""
        *ended, unfinished = bytes(data).split(b"\0")
        for part in ended:
            self._extend(part)
            packet = self._finish()
            if packet is not None:
                yield packet
        self._extend(unfinished)

    def _extend(self, chunk: bytes) -> None:
        if self._skipping:
            return
        if len(self._partial) + len(chunk) > _MAX_STUFFED:
            self.drops[PacketDrop.TOO_LONG] += 1
            self._partial.clear()
            self._skipping = True
        else:
            self._partial += chunk

    def _finish(self) -> Packet | None:
        """Packet in the bytes since the last zero; None where those are empty or no packet."""
        stuffed = bytes(self._partial)
        self._partial.clear()
        self._skipping = False
        if not stuffed:
            return None
        packet = self._open(stuffed)
        if isinstance(packet, PacketDrop):
            self.drops[packet] += 1
            return None
        return packet

    def _open(self, stuffed: bytes) -> Packet | PacketDrop:
        try:
            body: bytes = self._cobs.decode(stuffed)
        except self._cobs.DecodeError:
            return PacketDrop.STUFFING
        if len(body) < _HEADER.size + _CRC.size:
            return PacketDrop.TOO_SHORT
        content, checksum = body[: -_CRC.size], body[-_CRC.size :]
        if _CRC.pack(zlib.crc32(content)) != checksum:
            return PacketDrop.CHECKSUM
        version, type_, seq = _HEADER.unpack_from(content)
        if version not in VERSIONS:
            return PacketDrop.VERSION
        return Packet(type_, seq, content[_HEADER.size :], version)


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


@dataclass(frozen=True, slots=True, eq=False)
class FramePart:
    """Consecutive measurements of a frame that is sent in several packets.

    Attributes:
        data: number and start of the frame, and the measurements of this part; its duration is the
            time from the frame's start to the end of this part.
        total: number of measurements of the whole frame.
        first: number of this part's first measurement, from 0.
        previous: checksum of the packet with the part before; 0 for the first part.
        checksum: checksum of the packet with this part.
    """

    data: FrameData
    total: int
    first: int
    previous: int
    checksum: int

    @property
    def end(self) -> int:
        """Number of the first measurement after this part."""
        return self.first + len(self.data.impedance)

    def continues(self, before: "FramePart") -> bool:
        """Whether this part was sent next after `before`, in the same frame."""
        return (self.previous, self.first, self.total, self.data.number) == (
            before.checksum,
            before.end,
            before.total,
            before.data.number,
        )


class FrameAssembly:
    """Parts of the newest frame, until it is complete."""

    def __init__(self, drops: Counter[PacketDrop]) -> None:
        """Start without parts; parts that are dropped are counted in `drops`."""
        self._drops = drops
        self._parts: list[FramePart] = []

    def clear(self) -> None:
        """Discard the parts of an unfinished frame, uncounted."""
        self._parts.clear()

    def add(self, part: FramePart) -> FrameData | None:
        """Frame that `part` completes; None where parts are missing or the part is dropped."""
        if part.first == 0:
            if self._parts:
                self._drops[PacketDrop.PART] += len(self._parts)
            self._parts.clear()
        elif not self._parts or not part.continues(self._parts[-1]):
            self._drops[PacketDrop.PART] += 1
            return None
        self._parts.append(part)
        if part.end < part.total:
            return None
        whole = replace(
            part.data,
            impedance=np.concatenate([part.data.impedance for part in self._parts]),
            status=np.concatenate([part.data.status for part in self._parts]),
        )
        self._parts.clear()
        return whole


def frame_packets(frame: FrameData, seq: int) -> list[Packet]:
    """Packets of a whole frame, numbered from `seq` on: one, or its parts."""
    total = len(frame.impedance)
    if total <= PER_PACKET:
        return [Packet(MessageType.FRAME, seq & 0xFFFF, pack_frame(frame))]
    packets: list[Packet] = []
    previous = 0
    for first in range(0, total, PER_PACKET):
        rows = slice(first, first + PER_PACKET)
        measured = replace(
            frame,
            duration=frame.duration * min(rows.stop, total) / total,
            impedance=frame.impedance[rows],
            status=frame.status[rows],
        )
        payload = pack_frame(measured, _PART.pack(total, first, previous))
        packets.append(Packet(MessageType.FRAME, (seq + len(packets)) & 0xFFFF, payload, 2))
        previous = packets[-1].checksum
    return packets


def pack_frame(frame: FrameData, part: bytes = b"") -> bytes:
    """Payload of FRAME; `part` follows the head in version 2."""
    times = round(frame.time * 1e6), round(frame.duration * 1e6)
    number, n = frame.number & 0xFFFFFFFF, len(frame.impedance)
    head = _FRAME.pack(number, *times, frame.kind, n, frame.flags)
    return head + part + frame.impedance.astype("<c8").tobytes() + frame.status.tobytes()


def unpack_frame(packet: Packet) -> FrameData:
    """Frame in a packet of version 1; raises MessageError where the packet does not fit."""
    return _measurements(packet.payload, _FRAME.size)


def unpack_part(packet: Packet) -> FramePart:
    """Part in a packet of version 2; raises MessageError where the packet does not fit."""
    data = _measurements(packet.payload, _FRAME.size + _PART.size)
    total, first, previous = _PART.unpack_from(packet.payload, _FRAME.size)
    part = FramePart(data, total, first, previous, packet.checksum)
    require_field("FRAME", "n", part.total > PER_PACKET, f"above {PER_PACKET}", part.total)
    require_field("FRAME", "first", part.end <= part.total, f"up to {part.total}", part.end)
    return part


def _measurements(payload: bytes, head: int) -> FrameData:
    """Measurements that follow a head of `head` bytes."""
    number, time_us, duration_us, kind, n, flags = _FRAME.unpack_from(payload)
    expected = head + _BYTES_PER_CHANNEL * n
    whole = len(payload) == expected
    require_field("FRAME", "length", whole, f"{expected} for n = {n}", len(payload))
    require_field("FRAME", "n", n >= 1, "at least 1", n)
    return FrameData(
        number=number,
        time=time_us * 1e-6,
        duration=duration_us * 1e-6,
        impedance=np.frombuffer(payload, "<c8", n, head),
        status=np.frombuffer(payload, np.uint8, n, head + 8 * n),
        kind=kind,
        flags=flags,
    )
