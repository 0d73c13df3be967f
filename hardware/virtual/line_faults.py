"""Faults of the line between board and host: bytes and times of frames."""

from eitskin.hardware.protocol.packets import MAX_PACKET
from eitskin.hardware.virtual.fault import Effect, Fault, FaultKind, Hook

TEXT = b"\r\nRzMag: 612.034000 Ohm , RzPhase: -0.120000\r\n"


def _put(packet: bytes, f: Fault, count: int, new: bytes = b"") -> bytes:
    """Packet with `new` in place of `count` bytes from byte `index` on, modulo its length."""
    start = f.index % len(packet)
    return packet[:start] + new + packet[start + count :]


def _bit_flip(packet: bytes, f: Fault) -> bytes:
    wrong = bytearray(packet)
    wrong[f.index // 8 % len(packet)] ^= 1 << f.index % 8
    return bytes(wrong)


def _merged(packet: bytes, f: Fault) -> bytes:
    if f.memory.pop("without end", False):
        return packet.lstrip(b"\0")
    if not packet or f.since:
        return packet
    f.memory["without end"] = True
    return packet.rstrip(b"\0")


def _reordered(packet: bytes, f: Fault) -> bytes:
    if not packet or f.since:
        return packet + bytes(f.memory.pop("held", b""))
    f.memory["held"] = packet
    return b""


def held_back(data: bytes, f: Fault) -> bytes:
    """Nothing while the fault acts, then all at once."""
    held = bytes(f.memory.pop("held", b"")) + data
    if f.since >= f.amount:
        return held
    f.memory["held"] = held
    return b""


def _wrong_baud(data: bytes, f: Fault) -> bytes:
    return f.rng.randbytes(len(data) + f.rng.randrange(len(data) // 2 + 1))


def _packets(sent: bytes) -> list[bytes]:
    """Bytes of each packet of a frame."""
    return [b"\0" + part + b"\0" for part in sent.split(b"\0") if part]


def _times(sent: bytes, f: Fault, times: int) -> bytes:
    """Frame whose packet `index`, modulo their number, is sent `times` times."""
    packets = _packets(sent)
    chosen = f.index % len(packets)
    return b"".join(packets[:chosen] + times * [packets[chosen]] + packets[chosen + 1 :])


def _reordered_parts(sent: bytes, f: Fault) -> bytes:
    packets = _packets(sent)
    first = f.index % len(packets)
    packets[first : first + 2] = packets[first : first + 2][::-1]
    return b"".join(packets)


def _merged_frames(sent: bytes, f: Fault) -> bytes:
    packets = _packets(sent)
    cut = f.amount % max(len(packets), 1) or 1
    return b"".join(packets[cut:] if f.since else packets[:cut])


def two_frames(_: int) -> int:
    """The first frame and the one after, which some faults of one frame have a part in."""
    return 2


def _damage(meaning: str, damaged: Effect, unit: str = "") -> FaultKind:
    """Row of a fault that changes the packet of one frame, where there is one."""

    def effect(packet: bytes, f: Fault) -> bytes:
        return damaged(packet, f) if packet and f.since == 0 else packet

    return FaultKind(meaning, {Hook.PACKET: effect}, unit, stays=two_frames)


DAMAGE_FAULTS = {
    "bit_flip": _damage("Bit `index` of the packet is turned over.", _bit_flip, "bit"),
    "dropped_byte": _damage(
        "Byte `index` of the packet is missing.", lambda packet, f: _put(packet, f, 1), "byte"
    ),
    "inserted_byte": _damage(
        "A byte too many comes before byte `index`.",
        lambda packet, f: _put(packet, f, 0, b"\x55"),
        "byte",
    ),
    "burst": _damage(
        "16 bytes from byte `index` on are noise.",
        lambda packet, f: _put(packet, f, 16, f.rng.randbytes(16)),
        "byte",
    ),
    "truncated": _damage(
        "The packet ends at byte `index`, at its middle for 0.",
        lambda packet, f: packet[: f.index % len(packet) or len(packet) // 2],
        "byte",
    ),
    "merged": FaultKind(
        "The zero that ends the packet is missing, and the one that begins the next.",
        {Hook.PACKET: _merged},
        stays=two_frames,
    ),
    "duplicated": _damage("The packet is sent twice.", lambda packet, _: packet + packet),
    "lost_frame": _damage("The frame is measured and never sent.", lambda *_: b""),
    "reordered": FaultKind(
        "The frame comes after the one that follows it.",
        {Hook.PACKET: _reordered},
        stays=two_frames,
    ),
    "lost_part": _damage(
        "Packet `index` of the frame is missing.",
        lambda sent, f: _times(sent, f, 0),
        "packet",
    ),
    "duplicated_part": _damage(
        "Packet `index` of the frame is sent twice.",
        lambda sent, f: _times(sent, f, 2),
        "packet",
    ),
    "reordered_parts": _damage(
        "Packet `index` of the frame comes after the one that follows it.",
        _reordered_parts,
        "packet",
    ),
    "merged_frames": FaultKind(
        "The frame's packets from number `index` on are missing, and the next one's before it.",
        {Hook.PACKET: _merged_frames},
        "packet",
        default=1,
        stays=two_frames,
    ),
    "garbage": _damage(
        "100 bytes of noise come before the packet.",
        lambda packet, f: f.rng.randbytes(100) + packet,
        "seed",
    ),
    "text": _damage("A line of text comes before the packet.", lambda packet, _: TEXT + packet),
    "oversized": _damage(
        "Twice as many bytes as a packet may have come before it.",
        lambda packet, _: b"\0" + b"\xaa" * 2 * MAX_PACKET + packet,
    ),
}
WIRE_FAULTS = DAMAGE_FAULTS | {
    "back_pressure": FaultKind(
        "From the frame on the line takes nothing for `index` frames, two for 0; then all at once.",
        {Hook.PACKET: held_back},
        "frames",
        default=2,
        stays=lambda frames: frames + 1,
    ),
    "stall": FaultKind(
        "After the frame nothing comes for `index` periods, five for 0.",
        {Hook.DELAY: lambda delay, f: delay + f.amount * f.info.period},
        "periods",
        default=5,
        stays=lambda _: 1,
    ),
    "jitter": FaultKind(
        "From the frame on each is late by up to one period, at random; `index` is the seed.",
        {Hook.DELAY: lambda delay, f: delay + f.rng.random() * f.info.period},
        "seed",
    ),
    "wrong_baud": FaultKind(
        "From the frame on the line runs at another speed: every byte is another, and some are "
        "two.",
        {Hook.LINE: _wrong_baud},
        "seed",
    ),
}
