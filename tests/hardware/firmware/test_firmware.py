"""The firmware in C: its packets, its answers, and that no bytes break it."""

import ctypes
import ctypes as c
import random
import struct
import subprocess

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eitskin.hardware import Info
from eitskin.hardware.protocol.messages import (
    Ack,
    AckStatus,
    Event,
    GetTable,
    Hello,
    Start,
    Stop,
    Table,
    pack,
    unpack,
)
from eitskin.hardware.protocol.packets import (
    MAX_PACKET,
    MAX_PAYLOAD,
    Decoder,
    FrameData,
    MessageType,
    Packet,
    encode,
)

from compiled_firmware import ask, booted, compiled_board, frames, fuzzer, library, messages
from loopback import PROTOCOL

# ---- who it is ----


@pytest.mark.slow
def test_it_says_who_it_is_on_boot_and_when_asked():
    board = compiled_board()
    (info,) = messages(board.boot())
    assert ask(board, Hello()) == [info]
    assert (info.firmware, info.uid) == ("eitskin-c 1.0", b"uid-of-12-by")
    assert (info.boot_count, info.n_electrodes, info.n_measurements) == (1, 8, 28)
    assert info.table_crc32 == Table.from_protocol(PROTOCOL).crc32
    assert (info.frequency, info.rtia, info.rcal) == (40e3, 200.0, 200.0)
    assert info.amplitude == pytest.approx(0.607)
    assert info.period == pytest.approx(28 * 10.6e-3)
    assert ask(board, GetTable()) == [Table.from_protocol(PROTOCOL)]


@pytest.mark.slow
def test_a_reboot_counts_and_starts_the_numbers_again():
    board = booted()
    frames(board, 2)
    (info,) = messages(board.boot())
    assert info.boot_count == 2
    assert not board.streaming
    first, _ = frames(board, 2)
    assert (first.number, first.time) == (0, pytest.approx(0.0177, abs=1e-3))
    board.number = 2**32 - 1
    assert [frame.number for frame in frames(board, 2)] == [2**32 - 1, 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"n_measurements": 0},
        {"n_electrodes": 7},
        {"pga": 5},
        {"rtia": 8},
        {"period_us": 290_000},
    ],
)
def test_a_configuration_that_cannot_be_does_not_boot(changes):
    with pytest.raises(AssertionError):
        compiled_board(**changes).boot()


# ---- requests ----


def test_requests_may_be_repeated_stop_a_frame_and_wait_for_the_line():
    board = booted()
    assert ask(board, Start(2), 4) == ask(board, Start(2), 4) == [Ack(4, MessageType.START)]
    board.frame()
    assert ask(board, Start(2), 4) == [Ack(4, MessageType.START)]
    numbers = []
    while board.streaming:
        numbers += [message.number for message in messages(board.frame())]
    assert numbers == [1, 2]
    assert ask(board, Stop(), 5) == ask(board, Stop(), 5) == [Ack(5, MessageType.STOP)]
    board = booted()
    board.receive(encode(pack(Start(0), 1)))
    board.frame()
    board.poll(20)
    assert ask(board, Stop(), 2) == [Ack(2, MessageType.STOP)]
    assert messages(board.poll(1000)) == []
    (frame,) = frames(board, 1)
    assert frame.number == 1
    assert not frame.status.any()
    assert not board.afe.complaints
    board = booted()
    board.line = 0
    asked = b"".join(encode(pack(GetTable(), seq)) for seq in range(40))  # 5 kB of answers
    board.hear(asked)
    assert board.poll(200) == b""
    board.line = None
    assert messages(board.receive(b"")) == [Table.from_protocol(PROTOCOL)] * 40


# ---- a bad line ----


def noisy_stream(rng, pieces):
    """Requests, damaged requests and garbage."""
    stream = bytearray()
    for number in range(pieces):
        type_ = rng.choice([*range(7), 0x83, 0xFF])
        payload = rng.randbytes(rng.choice([0, 0, 0, 4, rng.randrange(1009)]))
        packet = encode(Packet(type_, number & 0xFFFF, payload))
        kind = rng.randrange(5)
        if kind < 2:
            stream += packet
        elif kind == 2:
            place = rng.randrange(1, len(packet) - 1)
            stream += packet[:place] + rng.choice([b"", bytes([rng.randrange(256)])])
            stream += packet[place + rng.randrange(2) :]
        else:
            stream += rng.randbytes(rng.choice([3, 30, 300, 3000]) if kind == 3 else 1)
    return bytes(stream) + b"\0"


def expected_answer(packet):
    good = {0x01: 0, 0x02: 4, 0x03: 0, 0x04: 0, 0x05: 0}
    if packet.type not in good:
        return Ack(packet.seq, packet.type, AckStatus.UNKNOWN_TYPE)
    if len(packet.payload) != good[packet.type]:
        return Ack(packet.seq, packet.type, AckStatus.MALFORMED)
    if packet.type in {MessageType.HELLO, MessageType.GET_TABLE}:
        return Info if packet.type == MessageType.HELLO else Table
    return Ack(packet.seq, packet.type)


@pytest.mark.slow
def test_no_bytes_break_it_and_only_whole_requests_are_answered():
    stream = noisy_stream(random.Random(0), 4000)
    done = subprocess.run([fuzzer()], input=stream, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    decoder = Decoder()
    sent = list(decoder.feed(done.stdout))
    assert not decoder.drops
    assert [packet.seq for packet in sent] == [n & 0xFFFF for n in range(len(sent))]
    answers = [unpack(packet) for packet in sent]
    answers = [a if isinstance(a, Ack) else type(a) for a in answers]
    answers = [a for a in answers if a not in (FrameData, Event)]
    expected = [Info] + [expected_answer(packet) for packet in Decoder().feed(stream)]
    assert len(expected) > 1000
    assert answers == expected


# ---- firmware packets ----


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


@pytest.mark.slow
@given(st.lists(packets, max_size=4), st.binary(max_size=50))
def test_both_codecs_read_the_same_packets(sent, garbage):
    stream = b"x" * (MAX_PACKET - 1) + b"".join(encode(packet) + garbage + b"\0" for packet in sent)
    stream += encode(Packet(1, 1, version=3))
    assert decoded_in_c(stream) == list(Decoder().feed(stream))


def test_a_packet_without_room_is_not_written():
    packet = Packet(0x84, 3, b"text")
    size = len(encode(packet))
    assert encoded_in_c(packet, size) == encode(packet)
    assert encoded_in_c(packet, size - 1) == b""


# ---- boot count ----


ERASED = 0xFFFFFFFF
READ = c.CFUNCTYPE(c.c_uint32, c.c_void_p, c.c_int, c.c_uint32)
WRITE = c.CFUNCTYPE(None, c.c_void_p, c.c_int, c.c_uint32, c.c_uint32)
ERASE = c.CFUNCTYPE(None, c.c_void_p, c.c_int)


class Store(c.Structure):
    _fields_ = (
        ("context", c.c_void_p),
        ("words", c.c_uint32),
        ("read", READ),
        ("write", WRITE),
        ("erase", ERASE),
    )


class Flash:
    """Two pages whose power may fail: a step is then done in part, and all after it not at all.

    Attributes:
        power: steps until the power fails; None for never.
        erasures: how often each page was erased.
    """

    def __init__(self, words=8):
        self.pages = [[ERASED] * words for _ in range(2)]
        self.erasures = [0, 0]
        self.power = None
        count = library().eit_count_boot
        count.restype, count.argtypes = c.c_uint32, [c.POINTER(Store)]
        self._store = Store(None, words, READ(self.read), WRITE(self.write), ERASE(self.erase))
        self.boot = lambda: count(self._store)

    def _left(self):
        """Part of the step that the power lasts for."""
        if self.power is None:
            return 1.0
        self.power -= 1
        return 1.0 if self.power > 0 else 0.5 if self.power == 0 else 0.0

    def read(self, _, page, word):
        return self.pages[page][word]

    def write(self, _, page, word, value):
        left = self._left()
        low_half_stays = 0xFFFF if left == 0.5 else ERASED if left == 0.0 else 0
        self.pages[page][word] &= value | low_half_stays

    def erase(self, _, page):
        left = self._left()
        self.erasures[page] += 1
        words = self.pages[page]
        words[: int(left * len(words))] = [ERASED] * int(left * len(words))


def test_boots_are_counted_over_many_pages():
    flash = Flash()
    assert [flash.boot() for _ in range(100)] == list(range(1, 101))
    assert sum(flash.erasures) == 100 // 4 - 1  # four records a page; the first two came erased
    assert abs(flash.erasures[0] - flash.erasures[1]) <= 1
    flash.pages = [[0x12345678] * 8, [0] * 8]  # anything may be in them at first
    assert [flash.boot() for _ in range(12)] == list(range(1, 13))


@pytest.mark.parametrize("before", [0, 2, 3, 4, 7, 11])
def test_a_power_cut_at_any_step_loses_no_count_but_its_own(before):
    for steps in range(1, 4):
        flash = Flash()
        for _ in range(before):
            flash.boot()
        flash.power = steps
        flash.boot()
        flash.power = None
        after = [flash.boot() for _ in range(10)]
        assert after[0] in {before + 1, before + 2}, steps
        assert after == list(range(after[0], after[0] + 10)), steps
