"""Packets: framing by byte stuffing, checksum, and a decoder for any stream of bytes.

    packet = 00 | COBS(version u8, type u8, seq u16, payload, crc32 u32) | 00

Consistent overhead byte stuffing (Cheshire and Baker, 1999) leaves no zero inside a packet, so a
zero always ends a packet, and damage costs no more than the packets that it lies in.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum, StrEnum

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
