"""The firmware in C: its packets, its answers, and that no bytes break it."""

import random
import subprocess

import pytest

from eitskin.errors import DeviceError
from eitskin.hardware.protocol.frame_parts import FrameData
from eitskin.hardware.protocol.messages import (
    Ack,
    AckStatus,
    Event,
    GetTable,
    Hello,
    Info,
    Start,
    Stop,
    Table,
    pack,
    unpack,
)
from eitskin.hardware.protocol.packets import Decoder, MessageType, Packet, encode

from compiled_firmware import ask, booted, compiled_board, frames, fuzzer, messages
from loopback import PROTOCOL, connected, take

# ---- who it is ----


@pytest.mark.slow
def test_it_says_who_it_is_on_boot_and_when_asked():
    board = compiled_board()
    (info,) = messages(board.boot())
    assert ask(board, Hello()) == [info]
    assert (info.firmware, info.uid) == ("eitskin-c 1.0", b"uid-of-12-by")
    assert (info.boot_count, info.n_electrodes, info.n_measurements) == (1, 8, 28)
    assert info.table_crc32 == Table.of(PROTOCOL).crc32
    assert (info.frequency, info.rtia, info.rcal) == (40e3, 200.0, 200.0)
    assert info.amplitude == pytest.approx(0.607)
    assert info.period == pytest.approx(28 * 10.6e-3)
    assert ask(board, GetTable()) == [Table.of(PROTOCOL)]


def test_a_reboot_counts_and_starts_the_numbers_again():
    board = booted()
    frames(board, 2)
    (info,) = messages(board.boot())
    assert info.boot_count == 2
    assert not board.streaming
    first, _ = frames(board, 2)
    assert (first.number, first.time) == (0, pytest.approx(0.0177, abs=1e-3))


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


def test_requests_may_be_repeated():
    board = booted()
    assert ask(board, Start(2), 4) == ask(board, Start(2), 4) == [Ack(4, MessageType.START)]
    board.frame()
    assert ask(board, Start(2), 4) == [Ack(4, MessageType.START)]
    numbers = []
    while board.streaming:
        numbers += [message.number for message in messages(board.frame())]
    assert numbers == [1, 2]
    assert ask(board, Stop(), 5) == ask(board, Stop(), 5) == [Ack(5, MessageType.STOP)]


def test_stop_ends_the_frame_that_is_being_measured():
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


@pytest.mark.parametrize("type_", [0x00, 0x06, 0x7F, MessageType.FRAME, 0xFF])
def test_an_unknown_request_is_told_so(type_):
    sent = booted().receive(encode(Packet(type_, 300, b"x" * 1000)))
    assert messages(sent) == [Ack(300, type_, AckStatus.UNKNOWN_TYPE)]


@pytest.mark.parametrize(
    ("type_", "payload"),
    [
        (MessageType.HELLO, b"x"),
        (MessageType.START, b""),
        (MessageType.START, b"123"),
        (MessageType.START, b"12345"),
        (MessageType.STOP, b"x"),
        (MessageType.GET_TABLE, b"1234"),
        (MessageType.CALIBRATE, b"\0"),
    ],
)
def test_a_malformed_request_is_told_so_and_changes_nothing(type_, payload):
    board = booted()
    sent = board.receive(encode(Packet(type_, 7, payload)))
    assert messages(sent) == [Ack(7, type_, AckStatus.MALFORMED)]
    assert not board.streaming


def test_frame_numbers_wrap():
    board = booted()
    board.number = 2**32 - 2
    assert [frame.number for frame in frames(board, 4)] == [2**32 - 2, 2**32 - 1, 0, 1]


# ---- a bad line ----


def damaged(rng, packet):
    data = bytearray(packet)
    place = rng.randrange(1, len(data) - 1)
    kind = rng.randrange(3)
    if kind == 0:
        data[place] ^= 1 << rng.randrange(8)
    elif kind == 1:
        del data[place]
    else:
        data.insert(place, rng.randrange(256))
    return bytes(data)


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
            stream += damaged(rng, packet)
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
@pytest.mark.parametrize("seed", range(1))
def test_no_bytes_break_it_and_only_whole_requests_are_answered(seed):
    stream = noisy_stream(random.Random(seed), 4000)
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


def test_requests_wait_while_their_answers_cannot_be_sent():
    board = booted()
    board.line = 0
    asked = b"".join(encode(pack(GetTable(), seq)) for seq in range(40))  # 5 kB of answers
    board.hear(asked)
    assert board.poll(200) == b""
    board.line = None
    assert messages(board.receive(b"")) == [Table.of(PROTOCOL)] * 40


# ---- behind a port ----


def test_the_host_is_told_that_the_part_is_missing():
    board = compiled_board()
    board.afe.present = False
    with pytest.raises(DeviceError, match=r"START: .*AD5940"):
        take(connected(board)[0], 1)
