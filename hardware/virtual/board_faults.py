"""What can go wrong with a board's answers, with what it says it is, and with its cable."""

import dataclasses
from dataclasses import dataclass

from eitskin.hardware.protocol.messages import Ack, Info, Reply, Type, pack
from eitskin.hardware.protocol.packets import Decoder, encode
from eitskin.hardware.virtual.fault import Fault, Unplugged

OTHER_VERSION = 2


@dataclass
class AnswerFault(Fault):
    """Strikes answers to requests number `frame` and on, `index` of them, one for 0."""

    frame: int = 0

    def answered(self, request: int, reply: bytes) -> bytes:
        """The answer, another one if it is struck."""
        within = self.frame <= request < self.frame + (self.index or 1)
        return self.instead(reply) if within else self.otherwise(reply)

    def instead(self, reply: bytes) -> bytes:
        """What is answered where it strikes."""
        raise NotImplementedError

    def otherwise(self, reply: bytes) -> bytes:
        """What is answered where it does not."""
        return reply


class NoReply(AnswerFault):
    """A request is not answered."""

    def instead(self, reply: bytes) -> bytes:  # noqa: ARG002
        """Nothing."""
        return b""


class LateReply(AnswerFault):
    """An answer comes only with that to the request after it."""

    _held = b""

    def instead(self, reply: bytes) -> bytes:
        """Nothing yet."""
        self._held += reply
        return b""

    def otherwise(self, reply: bytes) -> bytes:
        """What is late, and the answer."""
        held, self._held = self._held, b""
        return held + reply


class NegativeAck(AnswerFault):
    """A request that is answered by an ACK is refused as if the board were busy."""

    def instead(self, reply: bytes) -> bytes:
        """The same ACK with another status."""
        packets = list(Decoder().feed(reply))
        if [packet.type for packet in packets] != [Type.ACK]:
            return reply
        request, type_ = packets[0].payload[:2], packets[0].payload[2]
        refusal = Ack(int.from_bytes(request, "little"), type_, Reply.BUSY)
        return encode(pack(refusal, packets[0].seq))


class WrongVersion(Fault):
    """From the frame on every packet claims another version of the protocol."""

    def line(self, now: int, data: bytes) -> bytes:
        """The same packets with another version, and a checksum that fits."""
        if not self.lasts(now):
            return data
        return b"".join(encode(packet, OTHER_VERSION) for packet in Decoder().feed(data))


class WrongCount(Fault):
    """INFO announces one measurement less than the table has."""

    def introduced(self, now: int, info: Info) -> Info:
        """The info with another count."""
        if not self.lasts(now):
            return info
        return dataclasses.replace(info, n_measurements=info.n_measurements - 1)


class WrongTable(Fault):
    """INFO announces another table than the board then sends."""

    def introduced(self, now: int, info: Info) -> Info:
        """The info with another checksum."""
        if not self.lasts(now):
            return info
        return dataclasses.replace(info, table_crc32=info.table_crc32 ^ 1)


class AlreadyStreaming(Fault):
    """The board sends frames from its start on, without having been asked."""

    def streams_at_once(self) -> bool:
        """It does."""
        return True


class Reboot(Fault):
    """The board starts anew instead of measuring the frame."""

    def over(self, now: int) -> bool:
        """When it has started."""
        return now > self.frame + 1

    def reboots(self, now: int) -> bool:
        """At the frame."""
        return self.strikes(now)


class CounterWrap(Reboot):
    """The board starts anew, with a frame number that wraps after `index` frames, three for 0."""

    def first_number(self) -> int:
        """A few before the last."""
        return 2**32 - (self.index or 3)


class Unplug(Fault):
    """The cable is pulled before the frame is sent, and stays so until this is cleared."""

    def sent(self, now: int, packet: bytes, period: float) -> bytes:  # noqa: ARG002
        """Raises `Unplugged`."""
        if self.lasts(now):
            raise Unplugged(self.passed(packet))
        return packet

    def stays_out(self, now: int) -> bool:
        """It does."""
        return now > self.frame

    def passed(self, packet: bytes) -> bytes:  # noqa: ARG002
        """What still comes through."""
        return b""


class UnplugMidFrame(Unplug):
    """The cable is pulled in the middle of the frame, and stays so until this is cleared."""

    def passed(self, packet: bytes) -> bytes:
        """Half of the packet."""
        return packet[: len(packet) // 2]


class Replug(Fault):
    """The cable is pulled and put back `index` periods later, one for 0; the board starts anew."""

    def over(self, now: int) -> bool:
        """When it has been put back."""
        return now > self.frame + 1

    def sent(self, now: int, packet: bytes, period: float) -> bytes:
        """Raises `Unplugged`, once."""
        if self.strikes(now):
            raise Unplugged(back_after=(self.index or 1) * period)
        return packet


@dataclass
class PortInUse(Fault):
    """Another program has the port open, from the frame on."""

    frame: int = 0

    def holds_port(self, now: int) -> bool:
        """It does."""
        return self.lasts(now)


BOARD_FAULTS: dict[str, type[Fault]] = {
    "no_reply": NoReply,
    "late_reply": LateReply,
    "negative_ack": NegativeAck,
    "wrong_version": WrongVersion,
    "wrong_count": WrongCount,
    "wrong_table": WrongTable,
    "already_streaming": AlreadyStreaming,
    "reboot": Reboot,
    "counter_wrap": CounterWrap,
    "unplug": Unplug,
    "unplug_mid_frame": UnplugMidFrame,
    "replug": Replug,
    "port_in_use": PortInUse,
}
