"""The firmware's packets: C and Python write the same bytes and read the same packets."""

import ctypes
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eitskin.hardware.protocol.messages import Hello, pack
from eitskin.hardware.protocol.packets import MAX_PACKET, MAX_PAYLOAD, Decoder, Packet, encode

from compiled_firmware import library


@pytest.fixture(scope="module", autouse=True)
def built():
    """Built before the first test, so that none of them is slow."""
    return library()


packets = st.builds(
    Packet,
    st.integers(0, 0xFF),
    st.integers(0, 0xFFFF),
    st.binary(max_size=MAX_PAYLOAD)
    | st.integers(0, MAX_PAYLOAD).map(lambda n: b"\x01" * n)
    | st.integers(0, MAX_PAYLOAD).map(bytes),
    st.sampled_from([1, 2]),
)


def encoded_in_c(packet, room=MAX_PACKET):
    out = bytearray(b"\xaa" * (room + 1))
    buffer = (ctypes.c_char * len(out)).from_buffer(out)
    size = library().shim_encode(
        packet.version,
        packet.type,
        packet.seq,
        packet.payload,
        len(packet.payload),
        buffer,
        room,
    )
    assert out[room] == 0xAA, "written past the end"
    return bytes(out[:size])


def decoded_in_c(stream):
    found = (ctypes.c_char * (2 * len(stream) + 16))()
    size = library().shim_decode(stream, len(stream), found)
    rest = found.raw[:size]
    decoded = []
    while rest:
        version, type_, seq, size = struct.unpack_from("<BBHH", rest)
        decoded.append(Packet(type_, seq, rest[6 : 6 + size], version))
        rest = rest[6 + size :]
    return decoded


@pytest.mark.slow
@given(packets)
def test_both_codecs_write_the_same_bytes(packet):
    assert encoded_in_c(packet) == encode(packet)


@given(st.lists(packets, max_size=4), st.binary(max_size=50))
def test_both_codecs_read_the_same_packets(sent, garbage):
    stream = b"".join(encode(packet) + garbage + b"\0" for packet in sent)
    assert decoded_in_c(stream) == list(Decoder().feed(stream))


def test_a_packet_without_room_is_not_written():
    packet = Packet(0x84, 3, b"text")
    size = len(encode(packet))
    assert encoded_in_c(packet, size) == encode(packet)
    assert encoded_in_c(packet, size - 1) == b""


def test_a_packet_too_long_is_dropped_and_the_next_is_read():
    stream = b"x" * (MAX_PACKET - 1) + encode(pack(Hello(), 5))
    assert [packet.seq for packet in decoded_in_c(stream)] == [5]
    assert decoded_in_c(encode(Packet(1, 1, version=3))) == []
