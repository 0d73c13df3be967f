"""Framing and messages: whatever the bytes, nothing raises and nothing false comes through."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from eitskin.hardware import Info
from eitskin.hardware.protocol.messages import (
    Ack,
    Calibrate,
    Event,
    GetTable,
    Hello,
    Start,
    Stop,
    Table,
    TablePart,
    pack,
    unpack,
)
from eitskin.hardware.protocol.packets import (
    MAX_MEASUREMENTS,
    MAX_PACKET,
    MAX_PAYLOAD,
    PER_PACKET,
    Decoder,
    FrameAssembly,
    FrameData,
    FramePart,
    MessageError,
    MessageType,
    Packet,
    PacketDrop,
    encode,
    frame_packets,
)

packets = st.builds(
    Packet,
    st.integers(0, 0xFF),
    st.integers(0, 0xFFFF),
    st.binary(max_size=MAX_PAYLOAD) | st.integers(0, MAX_PAYLOAD).map(lambda n: b"\0" * n),
)
u8, u16, u32 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32))
positive = st.floats(2.0**-100, 2.0**100, width=32)
INFO = Info("eitskin 1.0", b"0123456789ab", 3, 8, 28, 0xDEADBEEF, 40e3, 0.5, 1e3, 200.0, 0.2968)

LARGE_INFO = Info(
    "eitskin 2.0", b"0123456789ab", 3, 32, 928, 0xDEADBEEF, 40e3, 0.5, 1e3, 200.0, 9800000 * 1e-6
)
LARGEST_INFO = replace(LARGE_INFO, n_measurements=MAX_MEASUREMENTS)
VERSION_2 = [LARGE_INFO, LARGEST_INFO, GetTable(300), TablePart(928, 5, ((0, 1, 2, 3),))]


@pytest.mark.slow
@given(st.lists(packets, max_size=5), st.lists(st.integers(1, 700), min_size=1))
def test_packets_survive_however_the_stream_is_chopped(sent, pieces):
    stream = b"".join(encode(packet) for packet in sent)
    decoder, received = Decoder(), []
    for length in pieces * (len(stream) // sum(pieces) + 1):
        received += decoder.feed(stream[:length])
        stream = stream[length:]
    assert received == sent
    assert not decoder.drops


def test_packets_and_parts_have_the_bytes_of_the_specification():
    """Little-endian, one field after the other; see docs/reference/wire-protocol.md."""
    assert encode(pack(Hello(), 1)).hex(" ") == "00 04 01 01 01 05 0f e3 21 81 00"
    values = np.array([1 - 2j], np.complex64)
    frame = FrameData(0x01020304, 1.5, 0.25, values, np.array([5], np.uint8))
    assert pack(frame, 0).payload.hex(" ") == (
        "04 03 02 01 60 e3 16 00 00 00 00 00 90 d0 03 00 00 01 00 00 00 00 80 3f 00 00 00 c0 05"
    )
    assert frame_packets(frame, 70000) == [pack(frame, 70000)]
    assert pack(INFO, 0).payload == (
        b"EITSeitskin 1.0\0\0\0\0\x000123456789ab"
        + bytes.fromhex("03 00 00 00 08 1c ef be ad de 00 40 1c 47 00 00 00 3f")
        + bytes.fromhex("00 00 7a 44 00 00 48 43 60 87 04 00")
    )
    # See docs/reference/wire-protocol.md.
    first, second = frame_packets(sent_frame(1, 110), 0xFFFF)
    assert (first.version, first.seq, second.seq) == (2, 0xFFFF, 0)
    assert first.payload[16:28].hex(" ") == "00 6d 00 00 6e 00 00 00 00 00 00 00"
    assert second.payload[16:24].hex(" ") == "00 01 00 00 6e 00 6d 00"
    assert second.payload[24:28] == cobs.decode(encode(first)[1:-1])[-4:]
    assert len(second.payload) == 28 + 9


def test_the_decoder_is_bounded_and_passes_neither_control_characters_nor_old_parts():
    """The same number and time, other values."""
    decoder = Decoder()
    for _ in range(1000):
        assert list(decoder.feed(b"x" * 1000)) == []
        assert decoder.buffered_bytes <= MAX_PACKET
    longest = encode(Packet(0xFF, 0xFFFF, b"\xff" * MAX_PAYLOAD))
    assert len(longest) == MAX_PACKET
    assert [packet.type for packet in decoder.feed(2 * longest)] == [0xFF, 0xFF]
    assert decoder.drops == {PacketDrop.TOO_LONG: 1}
    event = unpack(pack(Event(0, 0, "clear \x1b[2J\x9b1m and\rwrite\n"), 0))
    assert event.text == "clear ?[2J?1m and?write?"
    info = unpack(pack(replace(INFO, firmware="\x1b]0;me\x07 1.0"), 0))
    assert info.firmware == "?]0;me? 1.0"
    old, new = sent_frame(0), replace(sent_frame(0), impedance=sent_frame(1).impedance)
    parts = [[encode(packet) for packet in frame_packets(data, 0)] for data in (old, new)]
    found, dropped = joined(b"".join(parts[0][:1] + parts[1][1:] + parts[1]))
    assert len(found) == 1
    assert found[0].impedance.tobytes() == new.impedance.tobytes()
    assert dropped == 3
    found, dropped = joined(1000 * parts[0][0])  # the newest is all that is held
    assert (found, dropped) == ([], 999)


@pytest.mark.parametrize(
    ("bytes_", "reason"),
    [
        (b"\0\x05ab\0", PacketDrop.STUFFING),
        (b"\0" + cobs.encode(b"1234567") + b"\0", PacketDrop.TOO_SHORT),
        (b"\0" + cobs.encode(b"12345678") + b"\0", PacketDrop.CHECKSUM),
        (b"\0" + b"y" * MAX_PACKET + b"\0", PacketDrop.TOO_LONG),
        (encode(Packet(1, 1, version=3)), PacketDrop.VERSION),
    ],
)
def test_every_drop_is_counted_by_its_reason(bytes_, reason):
    decoder = Decoder()
    assert list(decoder.feed(bytes_)) == []
    assert decoder.drops == {reason: 1}


@given(st.binary(max_size=3000), packets)
def test_garbage_never_raises_and_does_not_hide_the_next_packet(garbage, packet):
    received = list(Decoder().feed(garbage + encode(packet)))
    assert received[-1:] == [packet]


@given(
    st.sampled_from([Hello(), Stop(), GetTable(), Calibrate(), *VERSION_2])
    | st.builds(Start, u32)
    | st.builds(Ack, u16, u8, u8)
    | st.builds(Event, u8, u16, st.text("µVé日 ", max_size=200))
    | st.builds(
        Info,
        st.text("eit 1.0-", max_size=16),
        st.binary(min_size=12, max_size=12),
        u32,
        st.integers(2, 255),
        st.integers(1, PER_PACKET),
        u32,
        *[positive] * 4,
        st.integers(1, 2**32 - 1).map(lambda us: us * 1e-6),
    )
    | st.builds(
        Table, st.lists(st.tuples(u8, u8, u8, u8), min_size=1, max_size=PER_PACKET).map(tuple)
    ),
    u16,
)
def test_messages_survive_the_wire(message, seq):
    (packet,) = Decoder().feed(encode(pack(message, seq)))
    assert (packet.seq, packet.version) == (seq, 1 + (message in VERSION_2))
    assert unpack(packet) == message


# ---- frame parts ----


@cache
def sent_frame(number, n=250):
    """Frame of any bits, NaN and infinity included."""
    rng = np.random.default_rng(number)
    values, status = (rng.integers(0, 256, size, np.uint8) for size in (8 * n, n))
    return FrameData(number, 0.25 * number, 0.125, values.view(np.complex64), status)


def stream(numbers, n=250):
    """Packets of frames one after the other, on the wire."""
    packets = []
    for number in numbers:
        packets += frame_packets(sent_frame(number, n), len(packets))
    return [encode(packet) for packet in packets]


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
    sent = sent_frame(found.number, len(found.impedance))
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


@pytest.mark.slow
@given(st.randoms(use_true_random=False))
def test_damaged_streams_of_parts_give_only_frames_that_were_sent(rng):
    packets = stream(range(8))
    for _ in range(rng.randrange(4)):
        place, other = sorted(rng.randrange(len(packets)) for _ in range(2))
        bit = 1 << rng.randrange(8)
        packets[place], packets[other] = rng.choice(
            [
                (b"", packets[other]),
                (2 * packets[place], packets[other]),
                (packets[other], packets[place]),
                (packets[place][: len(packets[place]) // 2], packets[other]),
                (bytes([*packets[place][:-9], 1 + bit, *packets[place][-8:]]), packets[other]),
            ]
        )
    found, _ = joined(b"".join(packets))
    assert all(map(is_as_sent, found))


# ---- table and identity ----


def v1(kind, payload):
    return Packet(kind, 0, payload)


def v2(kind, payload):
    return Packet(kind, 0, payload, 2)


@pytest.mark.parametrize(
    ("packet", "complaint"),
    [
        (v1(0x42, b""), "message type"),
        (v1(MessageType.HELLO, b"x"), "HELLO of 1 bytes"),
        (v1(MessageType.START, b"123"), "START of 3 bytes"),
        (v1(MessageType.ACK, b"12345"), "ACK of 5 bytes"),
        (v1(MessageType.TABLE, b"12345"), "multiple of 4, got 5"),
        (v1(MessageType.TABLE, b""), "multiple of 4, got 0"),
        (v1(MessageType.EVENT, b"1"), "EVENT of 1 bytes"),
        (v1(MessageType.FRAME, pack(sent_frame(0, 28), 0).payload[:-1]), "272 for n = 28, got 271"),
        (pack(sent_frame(0, 0), 0), "at least 1, got 0"),
        (v1(MessageType.INFO, b"EITX" + pack(INFO, 0).payload[4:]), "magic must be b'EITS'"),
        (v1(MessageType.INFO, pack(INFO, 0).payload[:-4] + bytes(4)), "period_us must be at least"),
        (v1(MessageType.INFO, pack(LARGE_INFO, 0).payload), "does not fit"),
        (
            v2(MessageType.INFO, pack(LARGE_INFO, 0).payload.replace(b"\xa0\x03", b"\x6d\0")),
            "110 to",
        ),
        (v2(MessageType.HELLO, b""), "version 2 of the protocol has no HELLO"),
        (v2(MessageType.FRAME, pack(sent_frame(0, 9), 0).payload), "must be 109 for n = 9"),
        (v2(MessageType.TABLE, b"\x05\0\x05\0\0\1\2\3"), "first must be up to 5, got 6"),
        *(
            (pack(replace(INFO, **{name: value}), 0), "finite")
            for name in ("frequency", "amplitude", "rtia", "rcal")
            for value in (-1.0, float("nan"))
        ),
    ],
)
def test_whole_packets_that_are_no_message_are_refused(packet, complaint):
    with pytest.raises(MessageError, match=complaint):
        unpack(packet)
