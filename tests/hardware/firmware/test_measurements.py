"""Firmware in C: measurements through the AD5940, their status, and large frames."""

import numpy as np
import pytest

from eitskin.hardware.protocol.messages import (
    Ack,
    AckStatus,
    Calibrate,
    Event,
    GetTable,
    Hello,
    Start,
    Stop,
    TablePart,
    pack,
    unpack,
)
from eitskin.hardware.protocol.packets import (
    PER_PACKET,
    Decoder,
    FrameData,
    FramePart,
    MessageType,
    Packet,
    encode,
)
from eitskin.simulator import Protocol, Status
from eitskin.simulator.instrument.ad5940 import CODES, FrontEnd

from compiled_firmware import (
    CompiledFirmware,
    ask,
    booted,
    compiled_board,
    config,
    frames,
    messages,
)
from loopback import FLAT, PROTOCOL, connected, take
from simulated_afe import SimulatedAfe

ABSENCE = Event(2, 1, "no AD5940 answers: check its SPI and its supply")


def quantisation(values, amplitude=0.607, full_range=0.9, rtia=200.0, rcal=200.0):
    """Bound of the rounding to codes [ohm]: of V, of I, and of both on RCAL."""
    step = full_range / CODES
    half_codes = step * np.sqrt(0.5)
    of_v = half_codes / amplitude
    of_i = half_codes / (amplitude / np.abs(values) * rtia)
    at_rcal = min(amplitude, 0.8 * 3e-3 * rcal, 0.8 * full_range / rtia * rcal, 0.8 * full_range)
    of_rcal = half_codes / at_rcal + half_codes / (at_rcal / rcal * rtia)
    return np.abs(values) * (of_v + of_i + of_rcal + 1e-6)


# ---- what it measures ----


def within_codes(board, values=FLAT, slack=1.0, **gains):
    """The frame that a board measures, which must be the sensor to within its codes."""
    (frame,) = frames(board, 1)
    assert not board.afe.complaints
    assert not frame.status.any()
    error = np.abs(frame.impedance - values)
    assert (error <= slack * quantisation(values, **gains)).all()
    assert error.max() > 1e-4  # there are codes indeed


PHASES = np.exp(2j * np.pi * np.arange(28) / 28.0)  # all around: a sign or a wrap would show


@pytest.mark.parametrize(
    ("changes", "gains"),
    [
        ({}, {}),
        ({"excitation": 1, "rtia": 1}, {"amplitude": 0.121, "rtia": 1e3}),
        ({"excitation": 2, "pga": 4}, {"amplitude": 0.075, "full_range": 0.133}),
        (
            {"excitation": 3, "pga": 3, "rtia": 2},
            {"amplitude": 0.015, "full_range": 0.3, "rtia": 5e3},
        ),
        ({"pga": 0}, {}),
    ],
)
def test_a_frame_is_the_sensor_to_within_its_codes(changes, gains):
    for values in (FLAT + 0j, FLAT * PHASES):
        within_codes(booted(values, **changes), values, **gains)


@pytest.mark.parametrize("factor", [0.9, 1.0037, 1.1])
def test_the_resistor_of_an_evaluation_board_will_do(factor):
    board = compiled_board(rcal_ohm=10e3)
    board.afe.rcal, board.afe.rtia_factor = 10e3, factor
    board.boot()
    within_codes(board, slack=1.2, rcal=10e3)


def test_the_part_is_set_up_calibrated_and_reads_what_the_model_reads():
    front_end = FrontEnd(
        floor=0.0, quantisation=True, clipping=True, excitation=0.607, pga_range=0.9, rtia=200.0
    )
    expected, _ = front_end.convert(FLAT + 0j, FLAT + 0j, np.random.default_rng(0))
    frame, second = frames(booted(), 2)
    assert frame.duration / 28 == pytest.approx(10.6e-3, rel=0.01)
    assert frame.duration < second.time - frame.time == pytest.approx(28 * 10.6e-3)
    ratio = frame.impedance / expected
    assert np.abs(ratio - ratio.mean()).max() < 3e-7  # one factor, of the calibration
    assert abs(ratio.mean() - 1.0) < 2e-5
    board = booted()
    frames(board, 1)
    on_rcal, on_sensor = board.afe.seen[:2], board.afe.seen[2:]
    assert len(on_sensor) == 2 * 28
    for setting in board.afe.seen:
        assert setting["frequency"] == pytest.approx(40e3, abs=0.02)
        assert (setting["points"], setting["range"]) == (2048, 0.9)
    assert not any(setting["on_sensor"] for setting in on_rcal)
    assert all(setting["amplitude"] == pytest.approx(0.607) for setting in on_sensor)
    board = compiled_board()
    board.afe.rtia_factor = 1.2 * np.exp(0.3j)
    board.afe.voltage_factor = 0.97 * np.exp(-0.1j)
    board.boot()
    within_codes(board, slack=1.3)


@pytest.mark.parametrize("period_us", [296_800, 294_000])  # the second is always late
def test_calibrating_while_it_streams_waits_for_the_frame_to_end(period_us):
    board = booted(period_us=period_us)
    board.receive(encode(pack(Start(0), 1)))
    board.frame()
    board.poll(20)
    board.afe.rtia_factor = 1.05
    (ack,) = ask(board, Calibrate(), 9)
    assert ack == Ack(9, MessageType.CALIBRATE)
    torn, good = (messages(board.frame())[-1] for _ in range(2))
    assert torn.impedance[-1] == pytest.approx(FLAT[-1] / 1.05, rel=1e-4)
    assert (np.abs(good.impedance - FLAT) <= 1.1 * quantisation(FLAT)).all()


@pytest.mark.parametrize("rcal", [1e9, 1e-2, 800.0])
def test_without_its_resistor_it_says_that_it_is_uncalibrated(rcal):
    board = compiled_board()
    board.afe.rcal = rcal
    *_, event = messages(board.boot())
    assert (event.level, event.text) == (1, "RCAL reads wrong: RTIA is not calibrated")
    (frame,) = frames(board, 1)
    assert (frame.status == Status.UNCALIBRATED).all()
    assert np.allclose(frame.impedance, FLAT, rtol=1e-4)  # by the nominal resistor


# ---- what it says of a measurement ----


def one_bad(value, row=3):
    values = FLAT.astype(complex)
    values[row] = value
    (frame,) = frames(booted(values), 1)
    others = np.arange(28) != row
    assert not frame.status[others].any()
    assert np.allclose(frame.impedance[others], FLAT[others], rtol=1e-4)
    return frame.impedance[row], Status(int(frame.status[row]))


STRAY = 1.0 / (2j * np.pi * 40e3 * 100e-12)  # ohm of the capacitance of an open pair


@pytest.mark.parametrize(
    ("value", "expected", "measured"),
    [
        (STRAY, Status.OPEN, pytest.approx(STRAY, rel=0.01)),
        (
            1e12,
            Status.OPEN | Status.LOW_CURRENT,
            pytest.approx(200 * 0.607 / 0.9 * CODES, rel=1e-3),
        ),
        (2e6, Status.OPEN | Status.LOW_CURRENT, None),
        (150.0, Status.CLIPPED, None),
        (1e-3, Status.CLIPPED, None),
    ],
)
def test_a_current_too_small_or_too_large_is_marked(value, expected, measured):
    impedance, status = one_bad(value)
    assert status == expected
    assert np.isfinite(impedance)
    assert measured is None or impedance == measured


def test_codes_at_their_end_are_clipped_and_endless_transforms_time_out_alone():
    board = booted(rtia=1)  # 1 kohm: a volt and more for every pair
    board.afe.comparators = False
    (frame,) = frames(board, 1)
    saturated = FLAT < 500.0
    assert (frame.status[saturated] == Status.CLIPPED).all()
    board = booted()
    board.afe.stuck = set(PROTOCOL.table[:14])
    for frame in frames(board, 3):  # and no event: they do not add up
        assert (frame.status == Status.DFT_TIMEOUT * (np.arange(28) < 14)).all()
        assert np.isnan(frame.impedance[:14]).all()
        assert np.allclose(frame.impedance[14:], FLAT[14:], rtol=1e-4)


@pytest.mark.slow
def test_lost_registers_are_set_up_and_a_failed_calibration_tried_again():
    board = booted()
    board.afe.reset()
    board.receive(encode(pack(Start(0), 1)))
    silent, event, good = messages(board.frame() + board.frame())
    assert (silent.status & Status.DFT_TIMEOUT).all()
    assert (event.level, event.text) == (1, "a frame of DFT timeouts: resetting the AD5940")
    assert (np.abs(good.impedance - FLAT) <= quantisation(FLAT)).all()
    assert (good.number, board.streaming) == (1, True)
    board = compiled_board()
    board.afe.rcal = 1e9
    board.boot()
    board.afe.rcal = 200.0
    taken = frames(board, 40)
    uncalibrated = [bool(frame.status.all()) for frame in taken]
    assert uncalibrated == [True] * 32 + [False] * 8


def test_a_part_that_goes_away_ends_the_stream_and_is_calibrated_when_it_is_back():
    board = booted()
    board.receive(encode(pack(Start(0), 1)))
    board.afe.present, sent = False, b""
    while board.streaming:
        sent += board.frame()
    assert [type(message) for message in messages(sent)] == [FrameData, Event, Event]
    board.poll(50)
    assert ask(board, Start(1)) == [ABSENCE, Ack(1, MessageType.START, AckStatus.FAILED)]
    before = board.afe.now
    board.afe.present, board.afe.rtia_factor = True, 1.1
    board.poll(50)
    assert board.afe.now - before < 1.2e6  # us: it is looked for each second
    (frame,) = frames(board, 1)
    assert not frame.status.any()
    assert (np.abs(frame.impedance - FLAT) <= 1.2 * quantisation(FLAT)).all()


# Frames of several packets


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


@pytest.mark.slow
def test_frames_of_several_packets_come_whole_in_order_and_apart():
    host, port = connected(board(ADJACENT, VALUES))
    assert host.protocol == ADJACENT
    assert host.info.n_measurements == 928
    (frame,) = take(host, 1)
    assert np.abs(frame.impedance - VALUES).max() < 0.02
    assert not frame.status.any()
    assert host.counts.dropped == {}
    assert not port.firmware.afe.complaints
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
    table = Protocol(ADJACENT.table[: PER_PACKET + 1], 32)
    values = np.linspace(30.0, 40.0, len(table))
    _, port = connected(board(table, values))
    port.firmware.line = 0
    port.firmware.receive(encode(pack(Start(1), 9)))
    port.firmware.frame()
    port.firmware.line = None
    (first, last) = messages(port.firmware.receive(b""))[1:]
    assert last.continues(first)


def test_parts_name_the_packet_before_them_and_tables_are_asked_for_in_parts():
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
