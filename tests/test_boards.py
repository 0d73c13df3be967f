"""Boards: one suite for all of them, then what each can do and what can go wrong with it."""

import dataclasses
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import serial

from eitskin.datasets import Dataset, ShardWriter, write_shard
from eitskin.geometry import Bend, ConfigurationError, DataError, DeviceError, SensorDesign
from eitskin.hardware import ReplayBoard, Script, SerialBoard, Step, open_board
from eitskin.hardware.faults import FAULTS, BitFlip, DroppedByte, LostFrame, NanChannel
from eitskin.hardware.messages import Ack, Event, FrameData, Table, Type, pack, unpack
from eitskin.hardware.packets import Decoder, Packet, encode
from eitskin.hardware.port import open_port
from eitskin.hardware.pseudo_terminal import Pace, PseudoTerminal
from eitskin.hardware.script import SimulatedSensor
from eitskin.hardware.virtual import VirtualFirmware, virtual_terminal
from eitskin.simulator import Frame, Protocol, Scene, Simulator, Status, Touch, WhiteNoise

PROTOCOL = Protocol.pairwise(8)
FLAT = np.linspace(400.0, 820.0, 28)


class FakeSimulator:
    """Impedances that depend on the bend angle alone; counts the scenes it computes."""

    protocol = PROTOCOL
    full_scale = 820.0

    def __init__(self):
        self.computed = 0

    def measure(self, scene):
        self.computed += 1
        return Frame(FLAT * (1.0 + 1e-3 * scene.bend.angle_deg), PROTOCOL)


def virtual(**options):
    return open_board("virtual:?speed=max", simulator=FakeSimulator(), **options)


def take(board, count, **options):
    return list(itertools.islice(board.frames(**options), count))


class Loopback:
    """A port with a firmware right behind it, and a clock that only waiting moves."""

    def __init__(self, firmware):
        self.firmware, self.now, self.closed = firmware, 0.0, False
        self.waiting = bytearray(firmware.boot())
        self.deaf = 0  # requests that the board does not hear
        self.heard = []

    def clock(self):
        return self.now

    @property
    def in_waiting(self):
        return len(self.waiting)

    def read(self, size=1):
        if not self.waiting and self.firmware.streaming:
            self.waiting += self.firmware.frame()
            self.now += self.firmware.info.period
        elif not self.waiting:
            self.now += 0.05
        data = bytes(self.waiting[:size])
        del self.waiting[:size]
        return data

    def write(self, data):
        self.heard += Decoder().feed(data)
        if self.deaf:
            self.deaf -= 1
        else:
            self.waiting += self.firmware.receive(data)

    def reset_input_buffer(self):
        self.waiting.clear()

    def close(self):
        self.closed = True


def firmware(faults=(), sensor=lambda _: FLAT, **changes):
    board = VirtualFirmware(sensor, PROTOCOL, faults=faults)
    board.info = dataclasses.replace(board.info, **changes)
    return board


def connected(board_firmware, **state):
    port = Loopback(board_firmware)
    vars(port).update(state)
    return SerialBoard(port, "serial:loopback", clock=port.clock), port


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording") / "run"
    rng = np.random.default_rng(1)
    with ShardWriter(folder) as writer:
        for number in range(12):
            status = np.zeros(28, np.uint8)
            status[number] = Status.CLIPPED
            impedance = FLAT + rng.normal(0, 0.1, 28)
            writer.append(Frame(impedance, PROTOCOL, 0.3 * number, number, 7, status=status))
    return folder


@pytest.fixture(params=["virtual", "replay", "loopback"])
def board(request, recording):
    if request.param == "virtual":
        opened = virtual()
    elif request.param == "replay":
        opened = open_board(f"replay:{recording}")
    else:
        opened, _ = connected(firmware())
    with opened:
        yield opened


# ---- every board ----


def test_gives_frames_of_its_protocol_in_order(board):
    frames = take(board, 10)
    assert board.protocol == PROTOCOL
    assert all(frame.protocol == PROTOCOL for frame in frames)
    assert [frame.number for frame in frames] == list(range(10))
    assert np.allclose([frame.impedance for frame in frames], FLAT, atol=2.0)
    assert len({frame.session for frame in frames}) == 1
    times = [frame.time for frame in frames]
    assert np.allclose(np.diff(times), board.info.period)


def test_counts_what_it_gives(board):
    take(board, 5)
    assert (board.counts.frames, board.lost, board.counts.dropped) == (5, 0, {})


def test_says_who_it_is(board):
    assert board.info.frequency == 40e3
    assert (board.info.n_electrodes, board.info.n_measurements) == (8, 28)
    assert board.info.table_crc32 == Table.of(PROTOCOL).crc32


def test_closing_twice_does_nothing(board):
    take(board, 1)
    board.close()
    board.close()


# ---- opening ----


@pytest.mark.parametrize(
    ("uri", "complaint"),
    [
        ("ttyACM0", "expected a board as serial:PORT"),
        ("virtuel:", "did you mean 'virtual:'"),
        ("serial:", "needs a port, such as serial:/dev/ttyACM0"),
        ("replay:", "needs a dataset's folder"),
        ("replay:x?speed=fast", "speed must be one of real, max, got 'fast'"),
        ("virtual:?sped=max", "no option 'sped'; it has speed"),
        ("virtual:?seed=one", "option seed must be a number, got 'one'"),
        ("virtual:?simulator=x", "cannot be said in a URI"),
        ("virtual:scene.toml", r"write virtual:\?scene=scene.toml"),
        ("virtual:?speed=", "speed must be one of real, max, got ''"),
        ("virtual:?speed=fast", "speed must be one of real, max, got 'fast'"),
        ("virtual:?resolution=best", "resolution must be one of fast, standard, fine"),
        ("virtual:?faults=gremlins", "name among bit_flip, .*got 'gremlins'"),
        ("virtual:?scene=missing.toml", "missing.toml"),
    ],
)
def test_a_uri_that_cannot_be_says_what_to_write(uri, complaint):
    with pytest.raises(ConfigurationError, match=complaint):
        open_board(uri)


def test_an_option_that_no_board_has_is_refused_before_anything_opens():
    with pytest.raises(ConfigurationError, match="replay: has no option 'sped'; it has speed"):
        open_board("replay:nowhere", sped="max")


def test_a_missing_port_is_named(tmp_path):
    with pytest.raises(DeviceError, match="there is none of this name; check the cable"):
        open_board(f"serial:{tmp_path}/ttyACM0")


def test_a_file_is_no_port(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match="check that it is a serial port"):
        open_board(f"serial:{tmp_path}/file")


def test_a_port_in_use_is_refused_and_reopens_when_free():
    with virtual_terminal(speed="max", simulator=FakeSimulator()) as terminal:
        uri = f"serial:{terminal.path}"
        with open_board(uri) as first:
            with pytest.raises(DeviceError, match="another program uses it"):
                open_board(uri)
            before = take(first, 3)
        with open_board(uri) as second:
            after = take(second, 3)
    assert after[0].number > before[-1].number
    assert after[0].session == before[0].session
    assert (second.lost, second.counts.frames) == (0, 3)


# ---- virtual boards ----


def test_a_script_changes_the_scene_while_the_board_runs():
    bent, flat = Scene(bend=Bend(20.0)), Scene()
    script = Script((Step(flat, 2), Step(bent, 3)))
    simulator = FakeSimulator()
    with open_board("virtual:", speed="max", scene=script, snr_db=np.inf, simulator=simulator) as b:
        ratios = [frame.impedance[0].real / FLAT[0] for frame in take(b, 10)]
    assert np.allclose(ratios, [1, 1, 1.02, 1.02, 1.02] * 2)
    assert simulator.computed == 2


def test_a_script_without_repeat_stays_at_its_last_scene():
    bent, flat = Scene(bend=Bend(20.0)), Scene()
    script = Script((Step(flat, 2), Step(bent, 1)), repeat=False)
    assert [script(number) for number in (0, 1, 2, 3, 99)] == [flat, flat, bent, bent, bent]


def test_scenes_may_come_from_any_function():
    sensor = SimulatedSensor(FakeSimulator(), lambda number: Scene(bend=Bend(float(number))))
    assert np.allclose(sensor(30), FLAT * 1.03)


def test_scripts_and_single_scenes_are_read_from_toml(tmp_path):
    (tmp_path / "scene.toml").write_text("[bend]\nangle_deg = 20.0\n")
    (tmp_path / "script.toml").write_text(
        "repeat = false\n[[steps]]\nframes = 2\n[steps.scene.bend]\nangle_deg = 20.0\n"
    )
    step = Step(Scene(bend=Bend(20.0)), 2)
    assert Script.from_toml(tmp_path / "script.toml") == Script((step,), repeat=False)
    assert Script.from_toml(tmp_path / "scene.toml")(5) == step.scene
    with pytest.raises(ConfigurationError, match="at least one step"):
        Script(())
    with pytest.raises(ConfigurationError, match="at least one frame"):
        Step(Scene(), 0)


def test_noise_is_that_of_the_seed_and_of_the_frame():
    sensors = [
        SimulatedSensor(FakeSimulator(), lambda _: Scene(), WhiteNoise(60.0), seed)
        for seed in (3, 3, 4)
    ]
    assert np.array_equal(sensors[0](5), sensors[1](5))
    assert not np.array_equal(sensors[0](5), sensors[2](5))
    assert not np.array_equal(sensors[0](5), sensors[0](6))
    residual = np.array([sensors[0](number) - FLAT for number in range(300)])
    assert residual.real.std() == pytest.approx(820.0 * 1e-3, rel=0.03)


def test_the_virtual_board_measures_what_the_simulator_does():
    scene = Scene(touches=(Touch(0.05, 0.02),))
    with open_board("virtual:?speed=max&resolution=fast&snr_db=inf", scene=scene) as board:
        (frame,) = take(board, 1)
    expected = Simulator(SensorDesign.reference(), resolution="fast").measure(scene)
    assert np.allclose(frame.impedance, expected.impedance, rtol=1e-6)


def test_pace_is_one_frame_a_period_without_bursts():
    now = [0.0]
    pace = Pace(0.3, clock=lambda: now[0])
    assert pace.remaining() == pytest.approx(0.3)
    now[0] = 0.4
    assert pace.remaining() == 0.0
    pace.advance()
    assert pace.remaining() == pytest.approx(0.2)  # due at 0.6: late once, not late for ever
    now[0] = 9.0
    pace.advance()
    pace.advance()
    assert pace.remaining() == pytest.approx(0.3)  # what was missed is not caught up


def test_a_paced_board_sends_no_frame_before_it_is_due():
    terminal = PseudoTerminal(firmware(), Pace(0.01))
    with terminal, open_board(f"serial:{terminal.path}") as board:
        began = time.monotonic()
        last = take(board, 4)[-1].number
        assert time.monotonic() - began >= (last + 1) * 0.01


def test_a_virtual_board_is_paced_as_its_info_says():
    terminal = virtual_terminal(simulator=FakeSimulator())
    assert terminal._pace.period == terminal._firmware.info.period == pytest.approx(0.2968)
    terminal.close()


def test_real_period_is_28_pairs_of_10_6_ms():
    assert firmware().info.period == pytest.approx(0.2968)


def test_a_paced_board_skips_frames_that_nobody_reads():
    measured, full = firmware(), threading.Event()
    skip = measured.skip

    def counted_skip():
        skip()
        if measured._number > 1500:
            full.set()

    measured.skip = counted_skip
    terminal = PseudoTerminal(measured, Pace(1e-4))
    with terminal, open_board(f"serial:{terminal.path}") as board:
        frames = board.frames()
        next(frames)
        assert full.wait(20.0)
        numbers = [next(frames).number for _ in range(1000)]
    assert board.lost > 100
    assert board.lost == numbers[-1] - 1000


# ---- firmware: bytes in, bytes out ----


def answers(board_firmware, *packets):
    return [
        unpack(packet)
        for sent in packets
        for packet in Decoder().feed(board_firmware.receive(encode(sent)))
    ]


def test_firmware_says_no_to_what_it_does_not_know():
    assert answers(firmware(), Packet(0x42, 7)) == [Ack(7, 0x42, 2)]
    assert answers(firmware(), Packet(Type.START, 8, b"x")) == [Ack(8, Type.START, 2)]
    assert answers(firmware(), pack(Ack(1, 1), 9)) == [Ack(9, Type.ACK, 1)]


def test_firmware_ignores_garbage():
    assert firmware().receive(b"\0\x03AT\r\n\0") == b""


def test_start_with_a_count_ends_after_it():
    board = firmware()
    board.receive(encode(Packet(Type.START, 1, b"\x03\0\0\0")))
    for _ in range(3):
        assert board.streaming
        board.frame()
    assert not board.streaming


# ---- what goes wrong on the wire ----


@pytest.mark.parametrize("fault", [BitFlip(3, 500), DroppedByte(3, 100), LostFrame(3)])
def test_a_damaged_frame_is_lost_and_counted(fault):
    board, _ = connected(firmware([fault]))
    assert [frame.number for frame in take(board, 6)] == [0, 1, 2, 4, 5, 6]
    assert board.lost == 1


def test_late_and_repeated_frames_are_dropped():
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)
    second = port.firmware.frame()
    third = port.firmware.frame()
    port.waiting += third + second + third
    assert [next(frames).number for _ in range(2)] == [2, 3]
    assert (board.lost, board.counts.dropped) == (1, {"repeated or late frame": 2})


def test_frame_numbers_may_wrap():
    board, port = connected(firmware())
    port.firmware._number = 2**32 - 2
    assert [frame.number for frame in take(board, 4)] == [2**32 - 2, 2**32 - 1, 0, 1]
    assert board.lost == 0


def test_a_value_that_is_not_finite_is_marked_and_the_frame_kept():
    board, _ = connected(firmware([NanChannel(1, 4)]))
    good, bad = take(board, 2)
    assert not good.status.any()
    assert np.flatnonzero(bad.status).tolist() == [4]
    assert bad.status[4] == Status.NOT_FINITE
    assert np.isnan(bad.impedance[4])
    assert np.isfinite(np.delete(bad.impedance, 4)).all()


def test_infinity_is_marked_too():
    board, _ = connected(firmware(sensor=lambda _: np.where(FLAT > 819, complex(0, np.inf), FLAT)))
    (frame,) = take(board, 1)
    assert np.flatnonzero(frame.status).tolist() == [27]


def test_an_open_electrode_opens_its_seven_pairs():
    with virtual(faults="open_electrode@1:3") as board:
        good, bad = take(board, 2)
    with_three = [3 in row for row in PROTOCOL.table]
    assert not good.status.any()
    assert np.array_equal(bad.status == Status.OPEN, with_three)
    assert np.abs(bad.impedance[with_three]) == pytest.approx(39.8e3, rel=1e-3)


def test_every_fault_can_be_named():
    for name, kind in FAULTS.items():
        with virtual(faults=f"{name}@50:1") as board:
            assert board._closed is False
        assert kind().frame == 5


def test_silence_for_three_periods_is_a_stale_stream():
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)
    port.firmware.streaming = False
    began = port.now
    with pytest.raises(DeviceError, match=r"stale, no frame came for 3 periods of 0\.297 s"):
        next(frames)
    assert 3 * 0.2968 <= port.now - began < 3 * 0.2968 + 0.1


def test_chatter_without_frames_is_stale_too():
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)
    port.firmware.frame = lambda: encode(pack(Event(1, 2, "busy"), 0))
    with pytest.raises(DeviceError, match="stale"):
        next(frames)
    assert {event.text for event in board.events} == {"busy"}


def test_a_restarted_board_is_a_new_session():
    board, port = connected(firmware())
    frames = board.frames()
    before = [next(frames) for _ in range(3)]
    port.waiting += port.firmware.boot()
    after = [next(frames) for _ in range(2)]
    assert after[0].session == before[0].session + 1
    assert [frame.number for frame in after] == [0, 1]
    assert board.lost == 0


def test_a_restart_with_another_table_is_an_error():
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)
    port.firmware.info = dataclasses.replace(port.firmware.info, table_crc32=1)
    port.waiting += port.firmware.boot()
    with pytest.raises(DeviceError, match="another measurement table; connect again"):
        next(frames)


def test_the_newest_frame_overtakes_the_others():
    board, port = connected(firmware())
    frames = board.frames(newest=True)
    next(frames)
    port.waiting += b"".join(port.firmware.frame() for _ in range(5))
    assert next(frames).number == 5
    assert (board.counts.skipped, board.lost, board.counts.frames) == (4, 0, 2)


def test_the_newest_frame_is_found_behind_a_long_queue():
    board, port = connected(firmware())
    frames = board.frames(newest=True)
    next(frames)
    port.waiting += b"".join(port.firmware.frame() for _ in range(200))
    assert next(frames).number == 200
    assert board.counts.skipped == 199


def test_frames_that_lay_unread_for_long_are_not_given_out_as_new():
    board, port = connected(firmware())
    frames = board.frames(newest=True)
    next(frames)
    port.waiting += b"".join(port.firmware.frame() for _ in range(5))
    for _ in range(100):
        port.firmware.skip()  # its queues were full
    port.now += 60.0
    assert next(frames).number > 105
    assert board.counts.frames + board.counts.skipped + board.lost == next(frames).number


def test_frames_from_before_the_start_are_never_given_out():
    board, port = connected(firmware())
    port.firmware.receive(encode(Packet(Type.START, 1, bytes(4))))
    port.waiting += b"".join(port.firmware.frame() for _ in range(5))
    assert take(board, 1)[0].number == 5


# ---- what goes wrong on connecting ----


@pytest.mark.parametrize("deaf", [1, 2])
def test_a_request_is_repeated_under_the_same_number(deaf):
    _, port = connected(firmware(), deaf=deaf)
    hellos = [packet.seq for packet in port.heard if packet.type == Type.HELLO]
    assert hellos == hellos[:1] * (deaf + 1)


def test_no_answer_in_three_tries_is_an_error():
    port = Loopback(firmware())
    port.deaf = 99
    with pytest.raises(DeviceError, match=r"an answer to HELLO within 0\.5 s, none came in 3"):
        SerialBoard(port, "serial:x", clock=port.clock)
    assert 1.5 <= port.now < 1.8
    assert [packet.type for packet in port.heard].count(Type.HELLO) == 3
    assert port.closed


def test_a_streaming_board_that_never_answers_is_an_error_too():
    port = Loopback(firmware())
    port.firmware.receive(encode(Packet(Type.START, 1, bytes(4))))
    port.deaf = 99
    with pytest.raises(DeviceError, match="none came"):
        SerialBoard(port, "serial:x", clock=port.clock)


def test_a_board_already_streaming_connects():
    streaming = firmware()
    port = Loopback(streaming)
    streaming.receive(encode(Packet(Type.START, 1, bytes(4))))
    board = SerialBoard(port, "serial:x", clock=port.clock)
    assert len(take(board, 3)) == 3
    assert board.lost == 0


def answering(response):
    """A port whose board answers every request with the same bytes."""
    port = Loopback(firmware())
    port.firmware.receive = lambda _: response
    return port


@pytest.mark.parametrize(
    ("response", "complaint"),
    [
        (encode(Packet(Type.INFO, 0), version=2), "another version of the protocol"),
        (encode(Packet(Type.INFO, 0, b"hello")), "it sent INFO of 5 bytes"),
        (b"\0RzMag: 600.0 Ohm\0", "bad stuffing.*baud rate"),
        (encode(pack(Ack(1, Type.HELLO, 3), 0)), "refused HELLO: busy"),
        (encode(pack(Ack(1, Type.HELLO, 77), 0)), "refused HELLO: status 77"),
    ],
)
def test_a_board_that_speaks_otherwise_is_told_apart(response, complaint):
    port = answering(response)
    with pytest.raises(DeviceError, match=complaint):
        SerialBoard(port, "serial:x", clock=port.clock)


@pytest.mark.parametrize(
    "changes", [{"table_crc32": 1}, {"n_measurements": 27}, {"n_electrodes": 4}]
)
def test_a_table_that_contradicts_info_is_an_error(changes):
    with pytest.raises(DeviceError, match=r"contradicts itself|table cannot be"):
        connected(firmware(**changes))


def test_a_frame_of_another_length_is_dropped():
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)
    short = FrameData(1, 0.0, 0.0, np.ones(3, np.complex64), np.zeros(3, np.uint8))
    port.waiting += encode(pack(short, 0))
    assert next(frames).number == 1
    assert board.counts.dropped == {"malformed message": 1}


def test_calibration_is_acknowledged():
    board, port = connected(firmware())
    board.calibrate()
    assert port.heard[-1].type == Type.CALIBRATE


def test_the_answer_to_an_earlier_request_is_no_answer_to_this_one():
    board, port = connected(firmware())
    port.deaf = 99
    port.waiting += encode(pack(Ack(1, Type.CALIBRATE, 4), 0))
    with pytest.raises(DeviceError, match="an answer to CALIBRATE"):
        board.calibrate()


# ---- cables ----


def test_unplugging_is_one_device_error():
    numbers = []
    with virtual(faults="unplug@4") as board:
        with pytest.raises(DeviceError, match=r"the board went away.*connect again"):
            numbers += [frame.number for frame in board.frames()]
        with pytest.raises(DeviceError, match="went away"):
            next(board.frames())
    assert numbers == list(range(len(numbers)))


@pytest.mark.parametrize("error", [serial.SerialException("gone"), OSError(5, "gone"), TypeError()])
@pytest.mark.parametrize("method", ["read", "in_waiting"])
def test_each_way_a_port_dies_is_the_same_error(error, method, monkeypatch):
    board, port = connected(firmware())
    frames = board.frames()
    next(frames)

    def die(*_):
        raise error

    monkeypatch.setattr(Loopback, method, property(die) if method == "in_waiting" else die)
    with pytest.raises(DeviceError, match="went away"):
        next(frames)
    board.close()
    assert port.closed


def test_closing_while_another_thread_reads_ends_its_reading():
    failures, first = [], threading.Event()
    board = virtual()

    def read():
        try:
            for _ in board.frames():
                first.set()
        except DeviceError as error:
            failures.append(str(error))

    thread = threading.Thread(target=read)
    thread.start()
    assert first.wait(10.0)
    board.close()
    thread.join(10.0)
    assert not thread.is_alive()
    assert len(failures) == 1


def test_a_closed_board_says_so():
    board, _ = connected(firmware())
    board.close()
    with pytest.raises(DeviceError, match="is closed; open it again"):
        next(board.frames())


def open_files():
    return len(list(Path("/dev/fd").iterdir()))


def test_no_file_stays_open():
    before = open_files()
    for _ in range(3):
        with virtual(faults="unplug@2") as board, pytest.raises(DeviceError):
            take(board, 5)
        virtual_terminal(simulator=FakeSimulator()).close()
    assert open_files() == before


# ---- recordings ----


def test_a_recording_keeps_its_status_and_session(recording):
    with open_board(f"replay:{recording}") as board:
        frames = list(board.frames())
    assert len(frames) == 12
    assert [int(np.flatnonzero(frame.status)[0]) for frame in frames] == list(range(12))
    assert {frame.session for frame in frames} == {7}


def test_a_recording_without_protocol_cannot_be_replayed(tmp_path):
    path = tmp_path / "shard-00000.h5"
    write_shard(path, Dataset.from_arrays(np.ones((4, 28), np.complex64)), 0)
    with pytest.raises(DataError, match=r"does not say which electrodes.*--protocol"):
        open_board(f"replay:{path}")


def test_no_recording_is_an_error(tmp_path):
    with pytest.raises(DataError, match="not a complete dataset"):
        open_board(f"replay:{tmp_path}")


def test_real_speed_waits_as_the_recording_did(recording):
    now, waits = [0.0], []

    def wait(seconds):
        waits.append(seconds)
        now[0] += seconds

    board = ReplayBoard(str(recording), speed="real", clock=lambda: now[0], wait=wait)
    for frame in itertools.islice(board.frames(), 4):
        now[0] += 0.1 if frame.number else 0.0  # time that the listener takes
    assert waits == pytest.approx([0.0, 0.3, 0.2, 0.2])


# ---- the command ----


def test_eitskin_board_serves_one_host_after_the_other_until_interrupted():
    script = "import typer; from eitskin.cli.board import command; typer.run(command)"
    process = subprocess.Popen(
        [sys.executable, "-c", script, "--speed", "max", "--quiet"],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    with process:
        try:
            uri = process.stdout.readline().strip()
            assert uri.startswith("serial:/dev/")
            numbers = []
            for _ in range(2):
                with open_board(uri) as board:
                    numbers += [frame.number for frame in take(board, 5)]
            assert numbers == sorted(set(numbers))
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 130
        finally:
            process.kill()


def test_ports_are_opened_without_flow_control():
    with virtual_terminal(speed="max", simulator=FakeSimulator()) as terminal:
        port = open_port(terminal.path, "serial:x")
        assert (port.baudrate, port.xonxoff, port.rtscts, port.exclusive) == (
            921600,
            False,
            False,
            True,
        )
        port.close()
