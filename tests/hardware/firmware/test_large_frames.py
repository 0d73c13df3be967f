"""Firmware in C: frames of more measurements than one packet holds."""

import numpy as np
import pytest

from eitskin.hardware.protocol.frame_parts import PER_PACKET, FramePart
from eitskin.hardware.protocol.messages import (
    Ack,
    AckStatus,
    GetTable,
    Hello,
    Start,
    Stop,
    TablePart,
    pack,
    unpack,
)
from eitskin.hardware.protocol.packets import Decoder, MessageType, Packet, encode
from eitskin.simulator import Protocol

from compiled_firmware import CompiledFirmware, ask, config, messages
from loopback import connected, take
from simulated_afe import SimulatedAfe

ADJACENT = Protocol.adjacent(32)
VALUES = np.linspace(-30.0, 40.0, len(ADJACENT)) + 3j
PAIRWISE = Protocol.pairwise(16)  # 120 measurements, two packets


def board(protocol, values):
    """Board that measures `values`, with 500 ohm at every drive pair."""
    transfer = {row[:2] + row[:2]: 500.0 for row in protocol.table}
    transfer |= dict(zip(protocol.table, values, strict=True))
    settings = config(protocol.table, period_us=10_600 * len(protocol))
    settings.n_electrodes = protocol.n_electrodes
    return CompiledFirmware(SimulatedAfe(transfer.__getitem__), settings)


def small():
    found = board(PAIRWISE, np.linspace(400.0, 800.0, len(PAIRWISE)))
    found.boot()
    return found


def test_928_measurements_of_32_electrodes_come_whole():
    host, port = connected(board(ADJACENT, VALUES))
    assert host.protocol == ADJACENT
    assert host.info.n_measurements == 928
    (frame,) = take(host, 1)
    assert np.abs(frame.impedance - VALUES).max() < 0.02
    assert not frame.status.any()
    assert host.counts.dropped == {}
    assert not port.firmware.afe.complaints


def test_parts_name_the_packet_before_them_and_say_when_they_were_measured():
    found = small()
    assert ask(found, Start(1)) == [Ack(1, MessageType.START)]
    packets = list(Decoder().feed(found.frame()))
    first, second = map(unpack, packets)
    assert isinstance(first, FramePart)
    assert (first.first, first.end, second.first, second.end) == (0, PER_PACKET, PER_PACKET, 120)
    assert (first.previous, second.previous) == (0, packets[0].checksum)
    assert second.continues(first)
    assert first.data.duration == pytest.approx(PER_PACKET * 10.58e-3, rel=0.01)
    assert second.data.duration == pytest.approx(120 * 10.58e-3, rel=0.01)


def test_the_table_is_asked_for_in_parts():
    found = small()
    part = TablePart(120, 100, PAIRWISE.table[100:])
    assert ask(found, GetTable(100)) == [part]
    assert ask(found, GetTable(120), 7) == [Ack(7, MessageType.GET_TABLE, AckStatus.MALFORMED)]
    assert ask(found, GetTable(), 8) == [Ack(8, MessageType.GET_TABLE, AckStatus.FAILED)]
    longer = messages(found.receive(encode(Packet(MessageType.GET_TABLE, 9, b"123", 2))))
    assert longer == [Ack(9, MessageType.GET_TABLE, AckStatus.MALFORMED)]
    answers = Decoder().feed(found.receive(encode(pack(Hello(), 1))))
    assert [(packet.version, packet.type) for packet in answers] == [(2, MessageType.INFO)]
    other = messages(found.receive(encode(Packet(MessageType.HELLO, 9, b"", 2))))
    assert other == [Ack(9, MessageType.HELLO, AckStatus.UNKNOWN_TYPE)]


def test_a_frame_that_is_stopped_is_not_joined_with_the_next():
    host, port = connected(small())
    stream = host.frames()
    next(stream)
    while not port.waiting:  # the first part of the next frame
        port.waiting += port.firmware.poll()
    port.firmware.receive(encode(pack(Stop(), 99)))
    port.firmware.receive(encode(pack(Start(0), 100)))
    frame = next(stream)
    assert frame.impedance.real == pytest.approx(np.linspace(400.0, 800.0, 120), rel=1e-4)
    assert host.counts.dropped == {"part of an incomplete frame": 1}
    assert host.lost == 0


def test_a_last_part_of_one_measurement_waits_for_the_part_before_it():
    table = Protocol(ADJACENT.table[: PER_PACKET + 1], 32)
    values = np.linspace(30.0, 40.0, len(table))
    _, port = connected(board(table, values))
    port.firmware.line = 0
    port.firmware.receive(encode(pack(Start(1), 9)))
    port.firmware.frame()
    port.firmware.line = None
    (first, last) = messages(port.firmware.receive(b""))[1:]
    assert last.continues(first)
