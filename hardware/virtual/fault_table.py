"""Table of all faults of a virtual board, by name.

A fault is written `name@frame:index`, such as `bit_flip@5:12`. From that frame on it stays (a
channel that is NaN) or acts once (a lost frame), by its nature. Faults of replies count requests
instead of frames: `no_reply@0:2` leaves the first two unanswered.

To add a fault, add a row to one of the tables: `WIRE_FAULTS` for bytes and times of frames,
`BOARD_FAULTS` for answers, identity and cable, `SENSOR_FAULTS` from electrodes to values.
"""

import difflib
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.frame import Status
from eitskin.hardware.protocol.messages import Ack, AckStatus, pack
from eitskin.hardware.protocol.packets import MAX_PACKET, Decoder, MessageType, encode
from eitskin.hardware.virtual.fault import Effect, Fault, FaultKind, Hook, UnpluggedError

TEXT = b"\r\nRzMag: 612.034000 Ohm , RzPhase: -0.120000\r\n"


def _put(packet: bytes, f: Fault, count: int, new: bytes = b"") -> bytes:
    """Packet with `new` in place of `count` bytes from byte `index` on, modulo its length."""
    start = f.index % len(packet)
    return packet[:start] + new + packet[start + count :]


def _bit_flip(packet: bytes, f: Fault) -> bytes:
    wrong = bytearray(packet)
    wrong[f.index // 8 % len(packet)] ^= 1 << f.index % 8
    return bytes(wrong)


def _merge_packets(packet: bytes, f: Fault) -> bytes:
    if f.memory.pop("without end", False):
        return packet.lstrip(b"\0")
    if not packet or f.since:
        return packet
    f.memory["without end"] = True
    return packet.rstrip(b"\0")


def _reorder_packets(packet: bytes, f: Fault) -> bytes:
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


def _packets(packet: bytes) -> list[bytes]:
    """Bytes of each packet of a frame."""
    return [b"\0" + part + b"\0" for part in packet.split(b"\0") if part]


def _times(packet: bytes, f: Fault, times: int) -> bytes:
    """Frame whose packet `index`, modulo their number, is sent `times` times."""
    packets = _packets(packet)
    chosen = f.index % len(packets)
    return b"".join(packets[:chosen] + times * [packets[chosen]] + packets[chosen + 1 :])


def _reordered_parts(packet: bytes, f: Fault) -> bytes:
    packets = _packets(packet)
    first = f.index % len(packets)
    packets[first : first + 2] = packets[first : first + 2][::-1]
    return b"".join(packets)


def _merged_frames(packet: bytes, f: Fault) -> bytes:
    packets = _packets(packet)
    cut = f.amount % max(len(packets), 1) or 1
    return b"".join(packets[cut:] if f.since else packets[:cut])


def two_frames(_: int) -> int:
    """The first frame and the one after, which some faults of one frame have a part in."""
    return 2


def _row(hook: Hook, meaning: str, effect: Effect, unit: str = "", **more: Any) -> FaultKind:
    """Row of a fault with one effect."""
    return FaultKind(meaning, {hook: effect}, unit, **more)


_values, _network = partial(_row, Hook.IMPEDANCE), partial(_row, Hook.NETWORK)
_packet = partial(_row, Hook.PACKET)
_reply = partial(_row, Hook.REPLY, unit="requests", default=1, frame=0)


def _damage(meaning: str, damaged: Effect, unit: str = "") -> FaultKind:
    """Row of a fault that changes the packet of one frame, where there is one."""

    def effect(packet: bytes, f: Fault) -> bytes:
        return damaged(packet, f) if packet and f.since == 0 else packet

    return _packet(meaning, effect, unit, stays=two_frames)


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
    "merged": _packet(
        "The zero that ends the packet is missing, and the one that begins the next.",
        _merge_packets,
        stays=two_frames,
    ),
    "duplicated": _damage("The packet is sent twice.", lambda packet, _: packet + packet),
    "lost_frame": _damage("The frame is measured and never sent.", lambda *_: b""),
    "reordered": _packet(
        "The frame comes after the one that follows it.", _reorder_packets, stays=two_frames
    ),
    "lost_part": _damage(
        "Packet `index` of the frame is missing.", lambda sent, f: _times(sent, f, 0), "packet"
    ),
    "duplicated_part": _damage(
        "Packet `index` of the frame is sent twice.", lambda sent, f: _times(sent, f, 2), "packet"
    ),
    "reordered_parts": _damage(
        "Packet `index` of the frame comes after the one that follows it.",
        _reordered_parts,
        "packet",
    ),
    "merged_frames": _packet(
        "The frame's packets from number `index` on are missing, and the next one's before it.",
        _merged_frames,
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
    "back_pressure": _packet(
        "From the frame on the line takes nothing for `index` frames, two for 0; then all at once.",
        held_back,
        "frames",
        default=2,
        stays=lambda frames: frames + 1,
    ),
    "stall": _row(
        Hook.DELAY,
        "After the frame nothing comes for `index` periods, five for 0.",
        lambda delay, f: delay + f.amount * f.info.period,
        "periods",
        default=5,
        stays=lambda _: 1,
    ),
    "jitter": _row(
        Hook.DELAY,
        "From the frame on each is late by up to one period, at random; `index` is the seed.",
        lambda delay, f: delay + f.rng.random() * f.info.period,
        "seed",
    ),
    "wrong_baud": _row(
        Hook.LINE,
        "From the frame on the line runs at another speed: every byte is another, and some are "
        "two.",
        lambda data, f: f.rng.randbytes(len(data) + f.rng.randrange(len(data) // 2 + 1)),
        "seed",
    ),
}


Array = NDArray[Any]
"""Impedances [ohm], or status bits, of one frame, (measurements,); or an impedance matrix."""

NAN = complex(np.nan, np.nan)
OTHER_VERSION = 99
STRAY_CAPACITANCE = 100e-12  # F, measured at an open lead
SHORT = 2.0  # ohm, leads of a shorted pair
CLIPPING_SHARE = 0.7  # of the impedance, where a sine is cut off
LOST_PER_FRAME = 0.05  # of the resistance of a failing contact's pairs, in one frame
GAIN_STEP = 1.02
WRONG_RTIA = 5.0  # the next resistor of the AD5940, 1 kohm where 200 ohm are meant
DRIFT_PER_FRAME = 1e-4


def read_faults(text: str) -> tuple[Fault, ...]:
    """Faults of a text "name@frame:index,..."; raises ConfigurationError for an unknown one."""
    return tuple(_read_fault(part.strip()) for part in text.split(",") if part.strip())


def _read_fault(text: str) -> Fault:
    match = re.fullmatch(r"(\w+)(?:@(\d{1,10}))?(?::(\d{1,6}))?", text)
    if match is None or match[1] not in FAULTS:
        near = difflib.get_close_matches(re.split("[@:]", text)[0], FAULTS, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ConfigurationError(
            f"expected a fault as name@frame:index with a name among {', '.join(FAULTS)}, got "
            f"{text!r}{hint}"
        )
    kind = FAULTS[match[1]]
    return Fault(match[1], kind, int(match[2] or kind.frame), int(match[3] or 0))


def _negative_ack(reply: bytes, f: Fault) -> bytes:
    packets = list(Decoder().feed(reply))
    if f.since >= f.amount or [packet.type for packet in packets] != [MessageType.ACK]:
        return reply
    request, type_ = packets[0].payload[:2], packets[0].payload[2]
    refusal = Ack(int.from_bytes(request, "little"), type_, AckStatus.BUSY)
    return encode(pack(refusal, packets[0].seq))


def _wrong_version(data: bytes, _: Fault) -> bytes:
    packets = Decoder().feed(data)
    return b"".join(encode(replace(packet, version=OTHER_VERSION)) for packet in packets)


def _unplug(meaning: str, sent: Callable[[bytes], bytes]) -> FaultKind:
    """Row of a cable that is pulled after a part of the frame, and stays out."""

    def pull(packet: bytes, _: Fault) -> NoReturn:
        raise UnpluggedError(sent(packet))

    effects: dict[Hook, Effect] = {
        Hook.PACKET: pull,
        Hook.STAYS_OUT: lambda out, f: out or f.since > 0,
    }
    return FaultKind(f"{meaning}, and stays so until this is cleared.", effects)


def _replug(packet: bytes, f: Fault) -> bytes:
    if f.since == 0:
        raise UnpluggedError(back_after=f.amount * f.info.period)
    return packet


def _substitute(array: Array, where: Any, value: Any) -> Array:
    """Copy with `value` at the channels `where`."""
    changed = array.copy()
    changed[where] = value
    return changed


def _open_lead(z: Array, f: Fault) -> Array:
    """Network whose electrode hangs on its stray capacitance alone, as a lead that is off does.

    The lead neither carries current into the sensor nor follows its potential. Ground is the mean
    potential of the electrodes that are left.
    """
    other_electrodes = np.arange(len(z)) != f.electrode
    row = z[other_electrodes].mean(axis=0)
    opened: Array = (z - row - row[:, None] + row[other_electrodes].mean()).astype(np.complex128)
    opened[f.electrode] = opened[:, f.electrode] = 0.0
    opened[f.electrode, f.electrode] = 1.0 / (2j * np.pi * f.info.frequency * STRAY_CAPACITANCE)
    return opened


def _short_electrodes(z: Array, f: Fault) -> Array:
    """Network with a resistor between the two electrodes that the channel drives.

    Its admittance grows by b b^T / R with b = e_i - e_j; by the formula of Sherman and Morrison
    its impedance falls by Z b b^T Z / (R + b^T Z b).
    """
    first, second = f.protocol.table[f.channel][:2]
    between = z[:, first] - z[:, second]
    shorted: Array = z - np.outer(between, between) / (SHORT + between[first] - between[second])
    return shorted


def _swap_electrodes(z: Array, f: Fault) -> Array:
    """Network with two electrodes exchanged."""
    order = np.arange(len(z))
    first, second = f.electrode, (f.electrode + 1) % len(z)
    order[[first, second]] = second, first
    swapped: Array = z[np.ix_(order, order)]
    return swapped


def _losing(z: Array, f: Fault) -> Array:
    """Network with a growing resistance in series with the electrode.

    It grows by a share of the mean resistance of the electrode's pairs.
    """
    k, diagonal = f.electrode, np.diagonal(z)
    pairs = np.delete(diagonal[k] + diagonal - 2.0 * z[k], k)
    lost = z.copy()
    lost[k, k] += LOST_PER_FRAME * f.since * pairs.real.mean()
    return lost


BOARD_FAULTS = {
    "no_reply": _reply(
        "A request is not answered.", lambda reply, f: b"" if f.since < f.amount else reply
    ),
    "late_reply": _reply("An answer comes only with that to the request after it.", held_back),
    "negative_ack": _reply(
        "A request that is answered by an ACK is refused as if the board were busy.", _negative_ack
    ),
    "wrong_version": _row(
        Hook.LINE,
        "From the frame on every packet claims another version of the protocol.",
        _wrong_version,
    ),
    "wrong_count": _row(
        Hook.INFO,
        "INFO announces one measurement less than the table has.",
        lambda info, _: replace(info, n_measurements=info.n_measurements - 1),
    ),
    "wrong_table": _row(
        Hook.INFO,
        "INFO announces another table than the board then sends.",
        lambda info, _: replace(info, table_crc32=info.table_crc32 ^ 1),
    ),
    "already_streaming": _row(
        Hook.STREAMS,
        "The board sends frames from its start on, without having been asked.",
        lambda *_: True,
    ),
    "reboot": _row(
        Hook.REBOOTS,
        "The board restarts instead of measuring the frame.",
        lambda already, f: already or f.since == 0,
        stays=two_frames,
    ),
    "counter_wrap": FaultKind(
        "The board restarts, with a frame number that wraps after `index` frames, three for 0.",
        {
            Hook.REBOOTS: lambda already, f: already or f.since == 0,
            Hook.FIRST_NUMBER: lambda number, f: max(number, 2**32 - f.amount),
        },
        "frames",
        default=3,
        stays=two_frames,
    ),
    "unplug": _unplug("The cable is pulled before the frame is sent", lambda _: b""),
    "unplug_mid_frame": _unplug(
        "The cable is pulled in the middle of the frame", lambda packet: packet[: len(packet) // 2]
    ),
    "replug": _packet(
        "The cable is pulled and put back `index` periods later, one for 0; the board restarts.",
        _replug,
        "periods",
        default=1,
        stays=two_frames,
    ),
    "port_in_use": _row(
        Hook.PORT_HELD,
        "Another program has the port open, from the frame on.",
        lambda *_: True,
        frame=0,
    ),
}
SENSOR_FAULTS = {
    "nan_channel": _values(
        "Channel `index` is NaN.", lambda z, f: _substitute(z, f.channel, NAN), "channel"
    ),
    "inf_channel": _values(
        "Channel `index` is infinite.", lambda z, f: _substitute(z, f.channel, np.inf), "channel"
    ),
    "frozen_frame": _values(
        "All channels stay as they are, to the last bit.", lambda z, f: f.memory.setdefault("z", z)
    ),
    "stuck_channel": _values(
        "Channel `index` stays as it is, to the last bit.",
        lambda z, f: _substitute(z, f.channel, f.memory.setdefault("z", z[f.channel])),
        "channel",
    ),
    "clipping": FaultKind(
        "Channel `index` is cut off by the converter, and marked so.",
        {
            Hook.IMPEDANCE: lambda z, f: _substitute(z, f.channel, z[f.channel] * CLIPPING_SHARE),
            Hook.STATUS: lambda bits, f: _substitute(
                bits, f.channel, bits[f.channel] | Status.CLIPPED
            ),
        },
        "channel",
    ),
    "open_electrode": FaultKind(
        "The lead of electrode `index` is off: it sees stray capacitance; what needs it is marked.",
        {
            Hook.NETWORK: _open_lead,
            Hook.STATUS: lambda bits, f: _substitute(bits, f.pairs, bits[f.pairs] | Status.OPEN),
        },
        "electrode",
    ),
    "shorted_pair": _network(
        "The electrodes that channel `index` drives touch each other; all others see that.",
        _short_electrodes,
        "channel",
    ),
    "swapped_electrodes": _network(
        "The wires of electrodes `index` and the next are swapped.", _swap_electrodes, "electrode"
    ),
    "contact_loss": _network(
        "Electrode `index` loses contact slowly: its resistance grows frame by frame.",
        _losing,
        "electrode",
    ),
    "wrong_rtia": _values(
        "The board measures with another resistor than it reckons with.",
        lambda z, _: z / WRONG_RTIA,
    ),
    "phase_360": _values(
        "Every phase is off by 360 degrees, which changes no impedance but by rounding.",
        lambda z, _: np.abs(z) * np.exp(1j * (np.angle(z) + np.float32(2.0 * np.pi))),
    ),
    "gain_step": _values("All channels grow by two per cent at once.", lambda z, _: z * GAIN_STEP),
    "drift_ramp": _values(
        "All channels grow steadily.", lambda z, f: z * (1.0 + DRIFT_PER_FRAME * f.since)
    ),
}
FAULTS: dict[str, FaultKind] = WIRE_FAULTS | BOARD_FAULTS | SENSOR_FAULTS
