"""What can go wrong with the bytes of frames on their way, and with the time they take."""

import random

from eitskin.hardware.protocol.packets import MAX_PACKET
from eitskin.hardware.virtual.fault import Fault

TEXT = b"\r\nRzMag: 612.034000 Ohm , RzPhase: -0.120000\r\n"


class Damage(Fault):
    """The bytes of one frame are changed."""

    def sent(self, now: int, packet: bytes, period: float) -> bytes:  # noqa: ARG002
        """The packet, damaged if it is the one."""
        return self.damaged(packet) if packet and self.strikes(now) else packet

    def over(self, now: int) -> bool:
        """After the frame that follows, which some damage has a part in."""
        return now > self.frame + 1

    def damaged(self, packet: bytes) -> bytes:
        """What is sent instead of `packet`."""
        raise NotImplementedError

    def place(self, packet: bytes) -> int:
        """The byte that is struck."""
        return self.index % len(packet)


class BitFlip(Damage):
    """Bit `index` of the packet is turned over."""

    def damaged(self, packet: bytes) -> bytes:
        """The packet with one wrong bit."""
        wrong = bytearray(packet)
        wrong[self.index // 8 % len(packet)] ^= 1 << self.index % 8
        return bytes(wrong)


class DroppedByte(Damage):
    """Byte `index` of the packet is missing."""

    def damaged(self, packet: bytes) -> bytes:
        """The packet without that byte."""
        place = self.place(packet)
        return packet[:place] + packet[place + 1 :]


class InsertedByte(Damage):
    """A byte too many comes before byte `index`."""

    def damaged(self, packet: bytes) -> bytes:
        """The packet with 55 in it."""
        place = self.place(packet)
        return packet[:place] + b"\x55" + packet[place:]


class Burst(Damage):
    """16 bytes from byte `index` on are noise."""

    def damaged(self, packet: bytes) -> bytes:
        """The packet with noise in it."""
        place = self.place(packet)
        noise = random.Random(self.index).randbytes(16)  # noqa: S311
        return packet[:place] + noise + packet[place + 16 :]


class Truncated(Damage):
    """The packet ends at byte `index`, at its middle for 0."""

    def damaged(self, packet: bytes) -> bytes:
        """The beginning of the packet."""
        return packet[: self.place(packet) or len(packet) // 2]


class Merged(Damage):
    """The zero that ends the packet is missing, and the one that begins the next."""

    _ends = False

    def sent(self, now: int, packet: bytes, period: float) -> bytes:
        """Two packets without a zero between them."""
        if self._ends:
            self._ends = False
            return packet.lstrip(b"\0")
        return super().sent(now, packet, period)

    def damaged(self, packet: bytes) -> bytes:
        """The packet without its end."""
        self._ends = True
        return packet.rstrip(b"\0")


class Duplicated(Damage):
    """The packet is sent twice."""

    def damaged(self, packet: bytes) -> bytes:
        """The packet, twice."""
        return packet + packet


class LostFrame(Damage):
    """The frame is measured and never sent."""

    def damaged(self, packet: bytes) -> bytes:  # noqa: ARG002
        """Nothing."""
        return b""


class Reordered(Damage):
    """The frame comes after the one that follows it."""

    _held = b""

    def sent(self, now: int, packet: bytes, period: float) -> bytes:
        """The packet and what was held back."""
        held, self._held = self._held, b""
        return super().sent(now, packet, period) + held

    def damaged(self, packet: bytes) -> bytes:
        """Nothing yet."""
        self._held = packet
        return b""


class Garbage(Damage):
    """100 bytes of noise come before the packet."""

    def damaged(self, packet: bytes) -> bytes:
        """Noise and the packet."""
        return random.Random(self.index).randbytes(100) + packet  # noqa: S311


class Text(Damage):
    """A line of text comes before the packet."""

    def damaged(self, packet: bytes) -> bytes:
        """Text and the packet."""
        return TEXT + packet


class Oversized(Damage):
    """Twice as many bytes as a packet may have come before it."""

    def damaged(self, packet: bytes) -> bytes:
        """A packet too long, and the packet."""
        return b"\0" + b"\xaa" * 2 * MAX_PACKET + packet


class BackPressure(Fault):
    """From the frame on the line takes nothing for `index` frames, two for 0; then all at once."""

    _held = b""

    def over(self, now: int) -> bool:
        """When everything has come."""
        return now > self.frame + (self.index or 2)

    def sent(self, now: int, packet: bytes, period: float) -> bytes:  # noqa: ARG002
        """Nothing, or everything that was held back."""
        held, self._held = self._held + packet, b""
        if self.frame <= now < self.frame + (self.index or 2):
            self._held = held
            return b""
        return held


class Stall(Fault):
    """After the frame nothing comes for `index` periods, five for 0."""

    def over(self, now: int) -> bool:
        """After the pause."""
        return now > self.frame

    def delay(self, now: int, period: float) -> float:
        """The pause."""
        return (self.index or 5) * period if self.strikes(now) else 0.0


class Jitter(Fault):
    """From the frame on each is late by up to one period, at random; `index` is the seed."""

    def __post_init__(self) -> None:
        """Draw from a generator of its own."""
        self._random = random.Random(self.index)  # noqa: S311

    def delay(self, now: int, period: float) -> float:
        """A random part of the period."""
        return self._random.random() * period if self.lasts(now) else 0.0


class WrongBaud(Fault):
    """From the frame on the line runs at another speed: every byte is another, and some are two."""

    def __post_init__(self) -> None:
        """Garble in a way of its own."""
        self._random = random.Random(self.index)  # noqa: S311

    def line(self, now: int, data: bytes) -> bytes:
        """What a receiver at the wrong speed makes of it."""
        if not self.lasts(now):
            return data
        return self._random.randbytes(len(data) + self._random.randrange(len(data) // 2 + 1))


WIRE_FAULTS: dict[str, type[Fault]] = {
    "bit_flip": BitFlip,
    "dropped_byte": DroppedByte,
    "inserted_byte": InsertedByte,
    "burst": Burst,
    "truncated": Truncated,
    "merged": Merged,
    "duplicated": Duplicated,
    "lost_frame": LostFrame,
    "reordered": Reordered,
    "garbage": Garbage,
    "text": Text,
    "oversized": Oversized,
    "back_pressure": BackPressure,
    "stall": Stall,
    "jitter": Jitter,
    "wrong_baud": WrongBaud,
}
