"""One thing that goes wrong with a virtual board: what a fault can reach, and when it strikes."""

from dataclasses import dataclass

from eitskin.hardware.protocol.messages import FrameData, Info
from eitskin.protocol import Protocol


class Unplugged(Exception):  # noqa: N818
    """The cable has been pulled.

    Attributes:
        sent: bytes that still came through.
        back_after: when it is put back, and the board starts anew [s]; None for not by itself.
    """

    def __init__(self, sent: bytes = b"", back_after: float | None = None) -> None:
        """Pull it after these bytes."""
        super().__init__()
        self.sent, self.back_after = sent, back_after


@dataclass
class Fault:
    """One fault; the base has no effect.

    Time is counted in frames since the board was made, `now`, which a restart does not set back.

    Attributes:
        frame: the frame that it strikes first; where it strikes answers, the request.
        index: which channel, electrode, byte or bit it strikes, or how hard.
    """

    frame: int = 5
    index: int = 0

    def __post_init__(self) -> None:
        """Prepare what the fault remembers; nothing, here."""

    def strikes(self, now: int) -> bool:
        """Whether this is the one frame that it strikes."""
        return now == self.frame

    def lasts(self, now: int) -> bool:
        """Whether it has begun, for what then stays."""
        return now >= self.frame

    def over(self, now: int) -> bool:  # noqa: ARG002
        """Whether it has struck and will not again, for what strikes once."""
        return False

    def measured(self, now: int, data: FrameData, protocol: Protocol, info: Info) -> FrameData:  # noqa: ARG002
        """What becomes of the measured values."""
        return data

    def sent(self, now: int, packet: bytes, period: float) -> bytes:  # noqa: ARG002
        """What becomes of the bytes of a frame; may raise `Unplugged`."""
        return packet

    def answered(self, request: int, reply: bytes) -> bytes:  # noqa: ARG002
        """What becomes of the answer to request number `request`, counted from 0."""
        return reply

    def line(self, now: int, data: bytes) -> bytes:  # noqa: ARG002
        """What becomes of all bytes on the line."""
        return data

    def introduced(self, now: int, info: Info) -> Info:  # noqa: ARG002
        """What the board says it is."""
        return info

    def delay(self, now: int, period: float) -> float:  # noqa: ARG002
        """By how much the frame after this one is late [s]."""
        return 0.0

    def reboots(self, now: int) -> bool:  # noqa: ARG002
        """Whether the board starts anew instead of measuring this frame."""
        return False

    def first_number(self) -> int:
        """The number of the first frame after a start."""
        return 0

    def streams_at_once(self) -> bool:
        """Whether the board sends frames without having been asked."""
        return False

    def stays_out(self, now: int) -> bool:  # noqa: ARG002
        """Whether the cable is out for good."""
        return False

    def holds_port(self, now: int) -> bool:  # noqa: ARG002
        """Whether another program has the port open."""
        return False
