"""The firmware in C: its packets, its answers, its measurements, and that nothing breaks it."""

import ctypes
import random
import struct
import subprocess

import numpy as np
import pytest
from compiled_firmware import (
    CompiledFirmware,
    build,
    compiled_board,
    compiled_terminal,
    config,
    library,
    sensor,
)
from hypothesis import given
from hypothesis import strategies as st
from simulated_afe import SimulatedAfe

from eitskin.geometry import DeviceError, SensorDesign
from eitskin.hardware import open_board
from eitskin.hardware.messages import (
    Ack,
    Calibrate,
    Event,
    FrameData,
    GetTable,
    Hello,
    Info,
    Reply,
    Start,
    Stop,
    Table,
    Type,
    pack,
    unpack,
)
from eitskin.hardware.packets import MAX_PACKET, MAX_PAYLOAD, Decoder, Packet, encode
from eitskin.simulator import Protocol, Scene, Simulator, Status
from eitskin.simulator.ad5940 import CODES, FrontEnd

from loopback import FLAT, PROTOCOL, connected, take


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
)


def encoded_in_c(packet, room=MAX_PACKET):
    out = bytearray(room + 1)
    buffer = (ctypes.c_char * len(out)).from_buffer(out)
    size = library().shim_encode(
        packet.type, packet.seq, packet.payload, len(packet.payload), buffer, room
    )
    assert out[room] == 0, "written past the end"
    return bytes(out[:size])


def decoded_in_c(stream):
    found = (ctypes.c_char * (len(stream) + 16))()
    size = library().shim_decode(stream, len(stream), found)
    rest = found.raw[:size]
    decoded = []
    while rest:
        type_, seq, size = struct.unpack_from("<BHH", rest)
        decoded.append(Packet(type_, seq, rest[5 : 5 + size]))
        rest = rest[5 + size :]
    return decoded


def messages(data):
    """The messages in whole packets; anything else fails."""
    decoder = Decoder()
    found = [unpack(packet) for packet in decoder.feed(data)]
    assert not decoder.drops
    assert decoder.buffered == 0
    return found


def booted(values=FLAT, **changes):
    board = compiled_board(values, **changes)
    board.boot()
    return board


def ask(board, request, seq=1):
    return messages(board.receive(encode(pack(request, seq))))


def frames(board, count):
    assert ask(board, Start(count)) == [Ack(1, Type.START)]
    taken = [message for _ in range(count) for message in messages(board.frame())]
    assert not board.streaming
    return taken


def quantisation(values, amplitude=0.607, full_range=0.9, rtia=200.0):
    """How far off rounding to codes can be [ohm]: of V, of I, and of both on RCAL = 200 ohm."""
    step = full_range / CODES
    half_codes = step * np.sqrt(0.5)
    of_v = half_codes / amplitude
    of_i = half_codes / (amplitude / np.abs(values) * rtia)
    at_rcal = min(amplitude, 0.48, 0.8 * full_range / rtia * 200.0)
    of_rcal = half_codes / at_rcal + half_codes / (at_rcal / 200.0 * rtia)
    return np.abs(values) * (of_v + of_i + of_rcal + 1e-6)


# ---- packets ----


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
    assert decoded_in_c(encode(Packet(1, 1), version=2)) == []


# ---- who it is ----


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
    [{"n_measurements": 0}, {"n_measurements": 110}, {"n_electrodes": 7}, {"pga": 5}, {"rtia": 8}],
)
def test_a_configuration_that_cannot_be_does_not_boot(changes):
    with pytest.raises(AssertionError):
        compiled_board(**changes).boot()


# ---- what it measures ----


def complex_sensor():
    """Phases all around, so that a sign or a wrapped angle would show."""
    return FLAT * np.exp(2j * np.pi * np.arange(28) / 28.0)


@pytest.mark.parametrize("values", [FLAT + 0j, complex_sensor()], ids=["real", "complex"])
def test_a_frame_is_the_sensor_to_within_its_codes(values):
    board = booted(values)
    (frame,) = frames(board, 1)
    assert not board.afe.complaints
    assert not frame.status.any()
    error = np.abs(frame.impedance - values)
    assert (error <= quantisation(values)).all()
    assert error.max() > 1e-4  # there are codes indeed


def test_it_reads_what_the_model_of_the_instrument_reads():
    front_end = FrontEnd(
        floor=0.0, quantisation=True, clipping=True, excitation=0.607, pga_range=0.9, rtia=200.0
    )
    expected, _ = front_end.convert(FLAT + 0j, FLAT + 0j, np.random.default_rng(0))
    (frame,) = frames(booted(), 1)
    ratio = frame.impedance / expected
    assert np.abs(ratio - ratio.mean()).max() < 3e-7  # one factor, of the calibration
    assert abs(ratio.mean() - 1.0) < 2e-5


def test_the_part_is_set_up_for_40_khz_and_2048_points():
    board = booted()
    frames(board, 1)
    on_rcal, on_sensor = board.afe.seen[:2], board.afe.seen[2:]
    assert len(on_sensor) == 2 * 28
    for setting in board.afe.seen:
        assert setting["frequency"] == pytest.approx(40e3, abs=0.02)
        assert (setting["points"], setting["range"]) == (2048, 0.9)
    assert not any(setting["on_sensor"] for setting in on_rcal)
    assert all(setting["amplitude"] == pytest.approx(0.607) for setting in on_sensor)


def test_a_pair_takes_the_time_that_the_simulator_knows():
    first, second = frames(booted(), 2)
    assert first.duration / 28 == pytest.approx(10.6e-3, rel=0.01)
    assert first.duration < second.time - first.time == pytest.approx(28 * 10.6e-3)


@pytest.mark.parametrize(
    ("changes", "amplitude", "full_range", "rtia"),
    [
        ({"excitation": 1, "rtia": 1}, 0.121, 0.9, 1e3),
        ({"excitation": 2, "pga": 4}, 0.075, 0.133, 200.0),
        ({"excitation": 3, "pga": 3, "rtia": 2}, 0.015, 0.3, 5e3),
        ({"pga": 0}, 0.607, 0.9, 200.0),
    ],
)
def test_other_gains_measure_the_same(changes, amplitude, full_range, rtia):
    board = booted(**changes)
    (frame,) = frames(board, 1)
    assert not board.afe.complaints
    assert not frame.status.any()
    assert (np.abs(frame.impedance - FLAT) <= quantisation(FLAT, amplitude, full_range, rtia)).all()


def test_calibration_takes_out_what_the_part_is_off():
    board = compiled_board()
    board.afe.rtia_factor = 1.2 * np.exp(0.3j)
    board.afe.voltage_factor = 0.97 * np.exp(-0.1j)
    board.boot()
    (frame,) = frames(board, 1)
    assert not frame.status.any()
    assert (np.abs(frame.impedance - FLAT) <= 1.3 * quantisation(FLAT)).all()


def test_a_drift_is_taken_out_by_calibrating_again():
    board = booted()
    board.afe.rtia_factor = 1.05
    (off,) = frames(board, 1)
    assert np.allclose(off.impedance, FLAT / 1.05, rtol=1e-4)
    assert ask(board, Calibrate()) == [Ack(1, Type.CALIBRATE)]
    (good,) = frames(board, 1)
    assert (np.abs(good.impedance - FLAT) <= 1.1 * quantisation(FLAT)).all()


def test_calibrating_while_it_streams_waits_for_the_frame_to_end():
    board = booted()
    board.receive(encode(pack(Start(0), 1)))
    board.frame()
    board.poll(20)
    board.afe.rtia_factor = 1.05
    (ack,) = ask(board, Calibrate(), 9)
    assert ack == Ack(9, Type.CALIBRATE)
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


def test_four_electrodes_may_differ():
    protocol = Protocol.adjacent(8)
    drives = {row[:2] for row in protocol.table}
    values = np.linspace(-30.0, 40.0, len(protocol)) + 3j
    transfer = dict(zip(protocol.table, values, strict=True))
    transfer |= {drive + drive: 500.0 for drive in drives}
    afe = SimulatedAfe(transfer.__getitem__)
    board = CompiledFirmware(afe, config(protocol.table, period_us=500_000))
    board.boot()
    assert ask(board, GetTable()) == [Table.of(protocol)]
    (frame,) = frames(board, 1)
    assert np.abs(frame.impedance - values).max() < 0.02
    assert not afe.complaints


# ---- what it says of a measurement ----


def one_bad(value, row=3):
    values = FLAT.astype(complex)
    values[row] = value
    (frame,) = frames(booted(values), 1)
    others = np.arange(28) != row
    assert not frame.status[others].any()
    assert np.allclose(frame.impedance[others], FLAT[others], rtol=1e-4)
    return frame.impedance[row], Status(int(frame.status[row]))


def test_an_open_pair_is_open_and_shows_its_stray_capacitance():
    stray = 1.0 / (2j * np.pi * 40e3 * 100e-12)
    impedance, status = one_bad(stray)
    assert status == Status.OPEN
    assert impedance == pytest.approx(stray, rel=0.01)


def test_no_current_at_all_is_no_infinity():
    impedance, status = one_bad(1e12)
    assert status == Status.OPEN | Status.LOW_CURRENT
    assert abs(impedance) == pytest.approx(200.0 * 0.607 / 0.9 * CODES, rel=1e-3)


def test_a_current_of_a_few_codes_is_low():
    _, status = one_bad(2e6)
    assert Status.LOW_CURRENT in status


@pytest.mark.parametrize("value", [150.0, 20.0, 1e-3])
def test_too_much_current_is_clipped(value):
    _, status = one_bad(value)
    assert status == Status.CLIPPED


def test_a_transform_that_never_ends_is_a_timeout_of_that_row_alone():
    board = booted()
    board.afe.stuck = {PROTOCOL.table[5]}
    (frame,) = frames(board, 1)
    good = np.arange(28) != 5
    assert list(np.flatnonzero(frame.status)) == [5]
    assert frame.status[5] == Status.DFT_TIMEOUT
    assert np.isnan(frame.impedance[5])
    assert np.allclose(frame.impedance[good], FLAT[good], rtol=1e-4)


def test_a_part_that_lost_its_registers_is_set_up_again():
    board = booted()
    board.afe.reset()
    board.receive(encode(pack(Start(0), 1)))
    silent, event, good = messages(board.frame() + board.frame())
    assert (silent.status & Status.DFT_TIMEOUT).all()
    assert (event.level, event.text) == (1, "a frame of DFT timeouts: resetting the AD5940")
    assert (np.abs(good.impedance - FLAT) <= quantisation(FLAT)).all()
    assert (good.number, board.streaming) == (1, True)


def test_a_part_that_is_not_there_is_said_and_start_refused():
    board = compiled_board()
    board.afe.present = False
    info, event = messages(board.boot())
    assert isinstance(info, Info)
    assert event == Event(2, 1, "the AD5940 does not answer: check SPI and its supply")
    assert ask(board, Start(1)) == [Ack(1, Type.START, Reply.FAILED)]
    assert ask(board, Calibrate()) == [Ack(1, Type.CALIBRATE, Reply.FAILED)]
    assert ask(board, Stop()) == [Ack(1, Type.STOP)]
    assert not board.streaming


def test_a_part_that_goes_away_ends_the_stream():
    board = booted()
    board.receive(encode(pack(Start(0), 1)))
    board.afe.present = False
    sent = b""
    while board.streaming:
        sent += board.frame()
    assert [type(message) for message in messages(sent)] == [FrameData, Event, Event]
    assert ask(board, Start(1)) == [Ack(1, Type.START, Reply.FAILED)]


# ---- requests ----


def test_start_counts_frames():
    taken = frames(booted(), 3)
    assert [frame.number for frame in taken] == [0, 1, 2]
    assert np.allclose(np.diff([frame.time for frame in taken]), 28 * 10.6e-3)


def test_requests_may_be_repeated():
    board = booted()
    assert ask(board, Start(2), 4) == ask(board, Start(2), 4) == [Ack(4, Type.START)]
    board.frame()
    assert ask(board, Start(2), 4) == [Ack(4, Type.START)]
    numbers = []
    while board.streaming:
        numbers += [message.number for message in messages(board.frame())]
    assert numbers == [1, 2]
    assert ask(board, Stop(), 5) == ask(board, Stop(), 5) == [Ack(5, Type.STOP)]


def test_stop_ends_the_frame_that_is_being_measured():
    board = booted()
    board.receive(encode(pack(Start(0), 1)))
    board.frame()
    board.poll(20)
    assert ask(board, Stop(), 2) == [Ack(2, Type.STOP)]
    assert messages(board.poll(1000)) == []
    (frame,) = frames(board, 1)
    assert frame.number == 1
    assert not frame.status.any()
    assert not board.afe.complaints


@pytest.mark.parametrize("type_", [0x00, 0x06, 0x7F, Type.FRAME, 0xFF])
def test_an_unknown_request_is_told_so(type_):
    sent = booted().receive(encode(Packet(type_, 300, b"x" * 1000)))
    assert messages(sent) == [Ack(300, type_, Reply.UNKNOWN_TYPE)]


@pytest.mark.parametrize(
    ("type_", "payload"),
    [
        (Type.HELLO, b"x"),
        (Type.START, b""),
        (Type.START, b"123"),
        (Type.START, b"12345"),
        (Type.STOP, b"x"),
        (Type.GET_TABLE, b"1234"),
        (Type.CALIBRATE, b"\0"),
    ],
)
def test_a_malformed_request_is_told_so_and_changes_nothing(type_, payload):
    board = booted()
    sent = board.receive(encode(Packet(type_, 7, payload)))
    assert messages(sent) == [Ack(7, type_, Reply.MALFORMED)]
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
        return Ack(packet.seq, packet.type, Reply.UNKNOWN_TYPE)
    if len(packet.payload) != good[packet.type]:
        return Ack(packet.seq, packet.type, Reply.MALFORMED)
    if packet.type in {Type.HELLO, Type.GET_TABLE}:
        return Info if packet.type == Type.HELLO else Table
    return Ack(packet.seq, packet.type)


def fuzzer():
    """The firmware as a program; with the compiler's sanitizers, if it has them."""
    try:
        return build(
            "firmware_fuzz.c", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover"
        )
    except AssertionError:
        return build("firmware_fuzz.c", "-O1")


@pytest.mark.parametrize("seed", range(3))
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


def test_a_slow_line_loses_frames_whole_and_counts_them():
    board = booted()
    board.receive(encode(pack(Start(0), 1)))
    board.at_once, sent = 7, b""
    rate = 110 / board.info.period * 1e-6  # bytes per us; a frame has 284
    started, asked = board.afe.now, 0
    while board.number < 40:
        board.line = int((board.afe.now - started) * rate) - len(sent)
        sent += board.poll()
        if board.number == asked + 10:
            asked = board.number
            board._incoming += encode(pack(Hello(), asked))
    board.line = None
    sent += board.frame()
    found = messages(sent)
    numbers = [message.number for message in found if isinstance(message, FrameData)]
    assert len([message for message in found if isinstance(message, Info)]) == 4
    assert 10 <= len(numbers) <= 17  # 41 * 110 / 284 at most
    assert all(1 <= gap <= 5 for gap in np.diff(numbers))


# ---- behind a port ----


def test_the_host_counts_the_frames_that_the_board_skipped():
    board, port = connected(compiled_board())
    stream = board.frames()
    numbers = [next(stream).number for _ in range(2)]
    port.firmware.skip()  # measured, and kept while the line is blocked
    port.firmware.skip()
    numbers += [next(stream).number for _ in range(2)]
    assert numbers == [0, 1, 2, 4]
    assert board.lost == 1
    assert board.counts.dropped == {}


def test_the_host_talks_to_it_over_a_pseudo_terminal():
    with compiled_terminal() as terminal, open_board(f"serial:{terminal.path}") as board:
        taken = take(board, 6)
        assert board.protocol == PROTOCOL
        assert [frame.number for frame in taken] == list(range(6))
        assert np.allclose([frame.impedance for frame in taken], FLAT, atol=0.03)
        assert np.allclose(np.diff([frame.time for frame in taken]), board.info.period)
        assert (board.lost, board.counts.dropped) == (0, {})
        assert terminal.firmware.afe.complaints == []


def test_the_host_is_told_that_the_part_is_missing():
    board = compiled_board()
    board.afe.present = False
    with pytest.raises(DeviceError, match="refused START: failed"):
        take(connected(board)[0], 1)


def test_it_measures_the_simulated_sensor():
    simulator = Simulator(SensorDesign.reference(), resolution="fast")
    values = simulator.measure(Scene()).impedance
    board = CompiledFirmware(SimulatedAfe(sensor(values, simulator.protocol)))
    board.boot()
    (frame,) = frames(board, 1)
    assert not frame.status.any()
    assert (np.abs(frame.impedance - values) <= quantisation(values)).all()
