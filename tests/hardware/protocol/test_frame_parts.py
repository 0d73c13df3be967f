"""Frames in parts: whatever happens to the packets, no frame comes out that was not sent."""

import random
from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eitskin.hardware.protocol.frame_parts import (
    MOST_MEASUREMENTS,
    PER_PACKET,
    FrameAssembly,
    FrameData,
    FramePart,
    frame_packets,
)
from eitskin.hardware.protocol.messages import GetTable, Info, Table, TablePart, pack, unpack
from eitskin.hardware.protocol.packets import Decoder, MessageError, MessageType, Packet, encode
from eitskin.simulator import Protocol


@cache
def frame(number, n=250):
    rng = np.random.default_rng(number)
    values = rng.normal(600, 50, n) + 1j * rng.normal(0, 5, n)
    status = rng.integers(0, 64, n).astype(np.uint8)
    return FrameData(number, 0.25 * number, 0.125, values.astype(np.complex64), status)


@cache
def _stream(numbers, n):
    packets = []
    for number in numbers:
        packets += frame_packets(frame(number, n), len(packets))
    return [encode(packet) for packet in packets]


def stream(numbers, n=250):
    """Packets of frames one after the other, on the wire."""
    return list(_stream(tuple(numbers), n))


def joined(data):
    """Frames that come out of bytes, and the count of dropped parts."""
    decoder = Decoder()
    assembly = FrameAssembly(decoder.drops)
    found = []
    for packet in decoder.feed(data):
        part = unpack(packet)
        whole = assembly.add(part) if isinstance(part, FramePart) else part
        found += [] if whole is None else [whole]
    return found, decoder.drops["part of an incomplete frame"]


def is_as_sent(found):
    sent = frame(found.number, len(found.impedance))
    same = found.impedance.tobytes() == sent.impedance.tobytes()
    same = same and found.status.tobytes() == sent.status.tobytes()
    return same and (found.time, found.duration) == (sent.time, sent.duration)


@pytest.mark.parametrize("n", [1, PER_PACKET, PER_PACKET + 1, 2 * PER_PACKET, 250, 928, 5000])
def test_frames_of_any_size_survive_the_wire(n):
    packets = stream(range(3), n)
    assert len(packets) == 3 * -(-n // PER_PACKET)
    assert all(len(packet) <= 1024 for packet in packets)
    found, dropped = joined(b"".join(packets))
    assert [each.number for each in found] == [0, 1, 2]
    assert all(map(is_as_sent, found))
    assert dropped == 0


def test_small_frames_are_those_of_version_1_to_the_byte():
    data = frame(3, PER_PACKET)
    assert frame_packets(data, 70000) == [pack(data, 70000)]
    assert pack(data, 0).version == 1


def test_a_part_has_the_bytes_of_the_specification():
    """See docs/wire-protocol.md."""
    first, second = frame_packets(frame(1, 110), 7)
    assert (first.version, first.seq, second.seq) == (2, 7, 8)
    assert first.payload[16:28].hex(" ") == "00 6d 00 00 6e 00 00 00 00 00 00 00"
    assert second.payload[16:24].hex(" ") == "00 01 00 00 6e 00 6d 00"
    assert second.payload[24:28] == encode_checksum(first)
    assert len(second.payload) == 28 + 9


def encode_checksum(packet):
    """Last four bytes of a packet before stuffing."""
    from cobs import cobs

    return cobs.decode(encode(packet)[1:-1])[-4:]


@given(
    st.lists(st.integers(0, 17), max_size=40),
    st.sampled_from([110, 250, 330]),
)
def test_packets_in_any_order_lost_or_repeated_give_only_frames_that_were_sent(order, n):
    packets = stream(range(6), n)
    found, _ = joined(b"".join(packets[k % len(packets)] for k in order))
    assert all(map(is_as_sent, found))


def test_damaged_streams_of_parts_give_only_frames_that_were_sent():
    rng = random.Random(8)
    whole = dropped = 0
    for _ in range(200):
        packets = stream(range(8))
        for _ in range(rng.randrange(4)):
            _damage(rng, packets)
        found, lost = joined(b"".join(packets))
        assert all(map(is_as_sent, found))
        whole, dropped = whole + len(found), dropped + lost
    assert whole > 750
    assert dropped > 100


def _damage(rng, packets):
    place, other = rng.randrange(len(packets)), rng.randrange(len(packets))
    kind = rng.randrange(6)
    if kind == 0:
        packets[place] = b""
    elif kind == 1:
        packets[place] *= 2
    elif kind == 2:
        packets[place], packets[other] = packets[other], packets[place]
    elif kind == 3:
        del packets[min(place, other) : max(place, other)]
        packets += stream([9])  # never empty
    elif kind == 4 and packets[place]:
        wrong = bytearray(packets[place])
        wrong[rng.randrange(len(wrong))] ^= 1 << rng.randrange(8)
        packets[place] = bytes(wrong)
    else:
        packets[place] = packets[place][: len(packets[place]) // 2]


def test_parts_of_a_board_that_started_anew_are_not_joined_with_older_ones():
    """The same number and time, other values."""
    old, new = frame(0), replace(frame(0), impedance=frame(1).impedance)
    parts = [[encode(packet) for packet in frame_packets(data, 0)] for data in (old, new)]
    found, dropped = joined(b"".join(parts[0][:1] + parts[1][1:] + parts[1]))
    assert len(found) == 1
    assert found[0].impedance.tobytes() == new.impedance.tobytes()
    assert dropped == 3


def test_the_newest_unfinished_frame_is_all_that_is_held():
    drops = Counter()
    assembly = FrameAssembly(drops)
    first = unpack(frame_packets(frame(0), 0)[0])
    for _ in range(1000):
        assert assembly.add(first) is None
    assert drops["part of an incomplete frame"] == 999
    assembly.clear()
    assert drops.total() == 999


# ---- table and identity ----

INFO = Info(
    "eitskin 2.0", b"0123456789ab", 3, 32, 928, 0xDEADBEEF, 40e3, 0.5, 1e3, 200.0, 9800000 * 1e-6
)


def test_a_long_table_is_sent_in_parts_that_say_where_they_belong():
    table = Table.of(Protocol.adjacent(32))
    rows = ()
    while len(rows) < 928:
        (packet,) = Decoder().feed(encode(pack(TablePart.of(table, len(rows)), 1)))
        part = unpack(packet)
        assert (part.total, part.first) == (928, len(rows))
        rows += part.rows
    assert Table(rows) == table


@pytest.mark.parametrize("message", [INFO, GetTable(300), TablePart(928, 5, ((0, 1, 2, 3),))])
def test_messages_of_version_2_survive_the_wire(message):
    (packet,) = Decoder().feed(encode(pack(message, 9)))
    assert packet.version == 2
    assert unpack(packet) == message


@pytest.mark.parametrize(
    ("packet", "complaint"),
    [
        (Packet(MessageType.HELLO, 0, b"", 2), "version 2 of the protocol has no HELLO"),
        (Packet(MessageType.INFO, 0, pack(INFO, 0).payload), "does not fit"),
        (pack(replace(INFO, n_measurements=MOST_MEASUREMENTS), 0), None),
        (
            Packet(
                MessageType.INFO,
                0,
                pack(INFO, 0).payload.replace((928).to_bytes(2, "little"), b"\x6d\0"),
                2,
            ),
            "n_meas must be 110 to 65535, got 109",
        ),
        (
            Packet(MessageType.FRAME, 0, pack(frame(0, 9), 0).payload, 2),
            "length must be 109 for n = 9",
        ),
        (Packet(MessageType.TABLE, 0, b"\x05\0\x05\0\0\1\2\3", 2), "first must be up to 5, got 6"),
    ],
)
def test_packets_of_version_2_that_cannot_be_are_refused(packet, complaint):
    if complaint is None:
        assert unpack(packet).n_measurements == MOST_MEASUREMENTS
        return
    with pytest.raises(MessageError, match=complaint):
        unpack(packet)
