"""Fuzzing of the codec by random and mutated bytes."""

import itertools
import random
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from eitskin.hardware.protocol.frame_parts import (
    FrameAssembly,
    FrameData,
    FramePart,
    frame_packets,
)
from eitskin.hardware.protocol.messages import pack, unpack
from eitskin.hardware.protocol.packets import MAX_PACKET, Decoder, MessageError, encode


@dataclass
class Codec:
    """Counts of bytes fed to the decoder and of its results.

    Attributes:
        fed: bytes.
        whole: frames that came out and had been sent.
        false: packets that came out and had not been sent.
        raised: exceptions other than `MessageError`, by name.
        longest: most bytes ever held back.
        regained: how many good frames it took after damage until one came out, how often.
        drops: byte strings thrown away, by reason.
        joined: frames of several packets that came out whole and had been sent.
        mixed: frames of several packets that came out and had not been sent.
    """

    fed: int = 0
    whole: int = 0
    false: int = 0
    raised: Counter[str] = field(default_factory=Counter)
    longest: int = 0
    regained: Counter[int] = field(default_factory=Counter)
    drops: Counter[str] = field(default_factory=Counter)
    joined: int = 0
    mixed: int = 0


def fuzz_codec(total: int, seed: int) -> Codec:
    """Feed so many bytes: damage of every kind, each followed by good frames."""
    rng = random.Random(seed)  # noqa: S311
    found, decoder = Codec(), Decoder()
    packets = [_packet(number) for number in range(64)]
    sent = {next(Decoder().feed(packet)).payload for packet in packets}
    while found.fed < total:
        _feed(decoder, _damaged(rng, rng.choice(packets)), rng, sent, found)
        for good in itertools.count(1):
            if _feed(decoder, rng.choice(packets), rng, sent, found):
                found.regained[good] += 1
                break
    found.drops = Counter({reason.value: count for reason, count in decoder.drops.items()})
    _fuzz_parts(total, rng, found)
    return found


def _fuzz_parts(total: int, rng: random.Random, found: Codec) -> None:
    """Feed so many bytes of frames in parts, with packets lost, repeated, reordered, damaged."""
    frames = [_frame(number, 928) for number in range(16)]
    sent = {(each.number, each.impedance.tobytes()) for each in frames}
    decoder = Decoder()
    assembly = FrameAssembly(decoder.drops)
    packets = [encode(packet) for each in frames for packet in frame_packets(each, 0)]
    fed = 0
    while fed < total:
        for each in _rearranged(rng, packets):
            fed += len(each)
            for packet in decoder.feed(each):
                part = unpack(packet)
                whole = assembly.add(part) if isinstance(part, FramePart) else None
                if whole is not None:
                    known = (whole.number, whole.impedance.tobytes()) in sent
                    found.joined, found.mixed = found.joined + known, found.mixed + (not known)


def _rearranged(rng: random.Random, packets: list[bytes]) -> list[bytes]:
    """Packets of several frames, one in twenty of them not as it was sent."""
    result: list[bytes] = []
    for place, packet in enumerate(packets):
        other = rng.choice(packets)
        choices = [[], [packet, packet], [other], [other, packet], [packets[place - 1], packet]]
        choices.append([_damaged(rng, packet)])
        result += rng.choice(choices) if rng.random() < 0.05 else [packet]
    return result


def _feed(
    decoder: Decoder, data: bytes, rng: random.Random, sent: set[bytes], found: Codec
) -> bool:
    """Feed `data` in pieces; True if a frame came out."""
    found.fed += len(data)
    came = False
    while data:
        cut = rng.randrange(1, len(data) + 1)
        piece, data = data[:cut], data[cut:]
        try:
            for packet in decoder.feed(piece):
                if packet.payload in sent:
                    unpack(packet)
                    found.whole, came = found.whole + 1, True
                else:
                    found.false += 1
        except MessageError:
            found.raised["MessageError of a packet that was sent"] += 1
        except Exception as error:  # whatever comes is what is looked for
            found.raised[type(error).__name__] += 1
        found.longest = max(found.longest, decoder.buffered)
    return came


def _packet(number: int) -> bytes:
    return encode(pack(_frame(number, 28), number))


def _frame(number: int, n: int) -> FrameData:
    rng = np.random.default_rng(number)
    values = rng.normal(600, 100, n) + 1j * rng.normal(0, 10, n)
    status = np.zeros(n, np.uint8)
    return FrameData(number, number * 0.3, 0.297, values.astype(np.complex64), status)


def _damaged(rng: random.Random, packet: bytes) -> bytes:
    """Damaged versions of a packet, with random and overlong bytes among them."""
    place, length = rng.randrange(len(packet)), rng.randrange(1, 40)
    noise = rng.randbytes(length)
    flipped = bytearray(packet)
    for _ in range(rng.randrange(1, 6)):
        flipped[rng.randrange(len(packet))] ^= 1 << rng.randrange(8)
    other = bytes(rng.choices(packet, k=rng.randrange(1, 600)))
    return rng.choice(
        [
            bytes(flipped),
            packet[:place] + noise + packet[place + length :],
            packet[:place] + noise + packet[place:],
            packet[:place] + packet[place + length :],
            packet[:place],
            packet[place:],
            rng.randbytes(rng.randrange(1, 4000)),
            other,
            packet.rstrip(b"\0") + packet.lstrip(b"\0"),
            b"\0" + b"\xff" * rng.randrange(MAX_PACKET, 4 * MAX_PACKET),
        ]
    )
