"""What can go wrong with a virtual board, by name.

A fault is written `name@frame:index`, such as `bit_flip@5:12`. From that frame on it stays where
that is the nature of the fault (a channel that is NaN), else it strikes once (a lost frame).
"""

import dataclasses
import re
from dataclasses import dataclass

import numpy as np

from eitskin.geometry import ConfigurationError
from eitskin.hardware.messages import FrameData
from eitskin.simulator import Protocol, Status

STRAY_CAPACITANCE = 100e-12
"""What an open lead still sees [F]."""


class Unplugged(Exception):  # noqa: N818
    """The cable has been pulled."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; the base has no effect.

    Attributes:
        frame: the number of the frame that it strikes first.
        index: which channel, electrode, byte or bit it strikes.
    """

    frame: int = 5
    index: int = 0

    def measured(self, data: FrameData, protocol: Protocol, frequency: float) -> FrameData:  # noqa: ARG002
        """What becomes of the measured values."""
        return data

    def sent(self, number: int, packet: bytes) -> bytes:  # noqa: ARG002
        """What becomes of the bytes of frame `number`; may raise `Unplugged`."""
        return packet


class BitFlip(Fault):
    """Bit `index` of the packet is turned over."""

    def sent(self, number: int, packet: bytes) -> bytes:
        """The packet with one wrong bit."""
        if number != self.frame:
            return packet
        damaged = bytearray(packet)
        damaged[self.index // 8 % len(packet)] ^= 1 << self.index % 8
        return bytes(damaged)


class DroppedByte(Fault):
    """Byte `index` of the packet is missing."""

    def sent(self, number: int, packet: bytes) -> bytes:
        """The packet without that byte."""
        if number != self.frame:
            return packet
        place = self.index % len(packet)
        return packet[:place] + packet[place + 1 :]


class LostFrame(Fault):
    """The frame is measured and never sent."""

    def sent(self, number: int, packet: bytes) -> bytes:
        """Nothing."""
        return b"" if number == self.frame else packet


class NanChannel(Fault):
    """Channel `index` is NaN from then on, and nothing says so."""

    def measured(self, data: FrameData, protocol: Protocol, frequency: float) -> FrameData:  # noqa: ARG002
        """The frame with that channel NaN."""
        if data.number < self.frame:
            return data
        impedance = data.impedance.copy()
        impedance[self.index % len(impedance)] = complex(np.nan, np.nan)
        return dataclasses.replace(data, impedance=impedance)


class OpenElectrode(Fault):
    """Electrode `index` has lost contact: all its pairs see its stray capacitance only."""

    def measured(self, data: FrameData, protocol: Protocol, frequency: float) -> FrameData:
        """The frame with those pairs open, and marked so."""
        if data.number < self.frame:
            return data
        touched = (np.array(protocol.table) == self.index % protocol.n_electrodes).any(axis=1)
        impedance, status = data.impedance.copy(), data.status.copy()
        impedance[touched] = 1.0 / (2j * np.pi * frequency * STRAY_CAPACITANCE)
        status[touched] |= np.uint8(Status.OPEN)
        return dataclasses.replace(data, impedance=impedance, status=status)


class Unplug(Fault):
    """The cable is pulled before the frame is sent."""

    def sent(self, number: int, packet: bytes) -> bytes:
        """Raises `Unplugged`."""
        if number >= self.frame:
            raise Unplugged
        return packet


FAULTS: dict[str, type[Fault]] = {
    "bit_flip": BitFlip,
    "dropped_byte": DroppedByte,
    "lost_frame": LostFrame,
    "nan_channel": NanChannel,
    "open_electrode": OpenElectrode,
    "unplug": Unplug,
}


def read_faults(text: str) -> tuple[Fault, ...]:
    """The faults in "name@frame:index,..."; raises ConfigurationError where one cannot be."""
    return tuple(_read_fault(part.strip()) for part in text.split(",") if part.strip())


def _read_fault(text: str) -> Fault:
    match = re.fullmatch(r"(\w+)(?:@(\d+))?(?::(\d+))?", text)
    if match is None or match[1] not in FAULTS:
        raise ConfigurationError(
            f"expected a fault as name@frame:index with a name among {', '.join(FAULTS)}, got "
            f"{text!r}"
        )
    given = {"frame": match[2], "index": match[3]}
    return FAULTS[match[1]](**{name: int(value) for name, value in given.items() if value})
