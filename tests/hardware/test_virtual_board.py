"""The virtual board: its script, noise and pace, and its firmware."""

import dataclasses
import itertools

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, DeviceError
from eitskin.geometry import Bend, Disc, Hinge, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.hardware import Connection, Script, SerialBoard, Step, open_board
from eitskin.hardware.protocol.frame_parts import FrameData
from eitskin.hardware.protocol.messages import Ack, GetTable, Start, pack, unpack
from eitskin.hardware.protocol.packets import Decoder, MessageType, Packet, encode
from eitskin.hardware.virtual.fault_table import read_faults
from eitskin.hardware.virtual.memory_line import MemoryLine
from eitskin.hardware.virtual.stage import SimulatedSensor, Stage
from eitskin.hardware.virtual.virtual_board import VirtualBoard, virtual_terminal
from eitskin.simulator import (
    FourTerminalMeter,
    Instrument,
    Protocol,
    Scene,
    Simulator,
    Status,
    Touch,
)

from loopback import FLAT, PROTOCOL, FakeSimulator, firmware, matrix_of_pairs, take, virtual

FLAT_MATRIX = matrix_of_pairs(FLAT)

# ---- virtual boards ----


def test_a_script_changes_the_scene_while_the_board_runs():
    bent, flat = Scene(bend=Bend(20.0)), Scene()
    script = Script((Step(flat, 2), Step(bent, 3)))
    simulator = FakeSimulator()
    with open_board("virtual:", speed="max", scene=script, snr_db=np.inf, simulator=simulator) as b:
        ratios = [frame.impedance[0].real / FLAT[0] for frame in take(b, 10)]
    assert np.allclose(ratios, [1, 1, 1.02, 1.02, 1.02] * 2)
    assert simulator.computed == 2


def test_scenes_may_come_from_any_function():
    stage = Stage(SimulatedSensor(FakeSimulator()).solve, lambda now: Scene(bend=Bend(float(now))))
    assert np.allclose(PROTOCOL.measure(stage.impedance_at_frame(30)), FLAT * 1.03)


def test_scripts_and_single_scenes_are_read_from_toml(tmp_path):
    (tmp_path / "scene.toml").write_text("[bend]\nangle_deg = 20.0\n")
    (tmp_path / "script.toml").write_text(
        "repeat = false\n[[steps]]\nframes = 3\n"  # flat and untouched where nothing is said
        "[[steps]]\nframes = 2\n[steps.scene.bend]\nangle_deg = 20.0\n"
    )
    step = Step(Scene(bend=Bend(20.0)), 2)
    script = Script((Step(Scene(), 3), step), repeat=False)
    assert Script.from_toml(tmp_path / "script.toml") == script
    assert Script.from_toml(tmp_path / "scene.toml")(5) == step.scene


def test_noise_is_that_of_the_seed_and_of_the_frame():
    sensors = [SimulatedSensor(FakeSimulator(), Instrument(60.0), seed) for seed in (3, 3, 4)]
    one, same, other = (sensor.measure(FLAT_MATRIX, 5)[0] for sensor in sensors)
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    assert not np.array_equal(one, sensors[0].measure(FLAT_MATRIX, 6)[0])
    residual = np.array(
        [sensors[0].measure(FLAT_MATRIX, number)[0] - FLAT for number in range(300)]
    )
    assert residual.real.std() == pytest.approx(820.0 * 1e-3, rel=0.03)


def test_a_virtual_board_is_one_session_of_its_instrument_and_drifts_along_its_frames():
    steady = Instrument(snr_db=0.0, gain=0.002, reciprocity=0.004)
    sensor = SimulatedSensor(FakeSimulator(), steady, seed=3)
    first, _ = sensor.measure(FLAT_MATRIX, 0)
    assert np.array_equal(sensor.measure(FLAT_MATRIX, 1000)[0], first)
    assert not np.allclose(first, FLAT, rtol=1e-4)
    drifting = Instrument(snr_db=0.0, drift=0.002)
    sensor = SimulatedSensor(FakeSimulator(), drifting, seed=3, period=0.5)
    session = drifting.session(
        PROTOCOL, 820.0, np.random.default_rng(np.random.SeedSequence(3, spawn_key=(0,)))
    )
    factor = np.exp(session.drift(np.array([500.0]))[0])
    assert abs(factor - 1.0) > 1e-5
    assert np.allclose(sensor.measure(FLAT_MATRIX, 1000)[0], FLAT * factor, rtol=1e-12)


def test_the_virtual_board_sends_the_status_of_its_instrument():
    small = Instrument(snr_db=0.0, clipping=True, excitation=0.607, pga_range=0.3)
    with virtual(instrument=small) as board:
        (frame,) = take(board, 1)
    assert (frame.status == Status.CLIPPED).all()


def test_a_virtual_board_loads_its_sensor_as_its_instrument_does():
    sim = Simulator(SensorDesign.reference(), "coarse")
    meter = FourTerminalMeter(sink=2e-3, idle=1e-3, scale=4.0)
    sensor = SimulatedSensor(sim, dataclasses.replace(Instrument.ideal(), meter=meter))
    loaded = meter.transfer_impedance(sim.model.impedance(), sim.protocol)
    measured, status = sensor.measure(sensor.solve(Scene()), 0)
    assert measured == pytest.approx(4.0 * loaded, rel=1e-9)
    assert np.abs(loaded / sim.measure(Scene()).impedance - 1.0).min() > 0.05
    assert not status.any()


def test_an_instrument_may_be_named_where_the_board_is():
    with open_board("virtual:?speed=max&instrument=ad5940", simulator=FakeSimulator()) as board:
        (frame,) = take(board, 1)
    assert (frame.impedance.imag < -0.5).all()  # 40 pF are 99 kohm: 1.6 ohm beside 400


def own_sensor(folder):
    """URI's options for a sensor of its own, and the simulator that it names."""
    design = SensorDesign(Rectangle(0.1, 0.05), 0.004, uniform(Rectangle(0.1, 0.05), 6))
    design.to_toml(folder / "own sensor.toml")
    return f"resolution=coarse&sensor={folder}/own sensor.toml", Simulator(design, "coarse")


@pytest.mark.parametrize(
    ("options", "scene"),
    [
        (lambda _: ("resolution=coarse", Simulator(SensorDesign.reference(), "coarse")), Scene()),
        (
            lambda _: ("resolution=fast", Simulator(SensorDesign.reference(), "fast")),
            Scene(touches=(Touch(0.05, 0.02),)),
        ),
        (own_sensor, Scene()),
        (
            lambda _: (
                "resolution=coarse&protocol=adjacent",
                Simulator(SensorDesign.reference(), "coarse", protocol=Protocol.adjacent(8)),
            ),
            Scene(),
        ),
    ],
    ids=["reference", "touch", "own sensor", "protocol"],
)
def test_the_virtual_board_measures_what_the_simulator_does(options, scene, tmp_path):
    said, simulator = options(tmp_path)
    with open_board(f"virtual:?speed=max&snr_db=inf&{said}", scene=scene) as board:
        assert board.protocol == simulator.protocol
        (frame,) = take(board, 1)
    assert frame.impedance == pytest.approx(simulator.measure(scene).impedance, rel=1e-6)


def test_a_virtual_board_is_paced_as_its_info_says():
    terminal = virtual_terminal(simulator=FakeSimulator())
    assert terminal.line.period == terminal.firmware.info.period == pytest.approx(0.2968)
    terminal.close()


# ---- firmware: bytes in, bytes out ----


def answers(board_firmware, *packets):
    return [
        unpack(packet)
        for sent in packets
        for packet in Decoder().feed(board_firmware.receive(encode(sent)))
    ]


def test_firmware_says_no_to_what_it_does_not_know():
    assert answers(firmware(), Packet(0x42, 7)) == [Ack(7, 0x42, 2)]
    assert answers(firmware(), Packet(MessageType.START, 8, b"x")) == [Ack(8, MessageType.START, 2)]
    assert answers(firmware(), pack(Ack(1, 1), 9)) == [Ack(9, MessageType.ACK, 1)]


def test_firmware_ignores_garbage():
    assert firmware().receive(b"\0\x03AT\r\n\0") == b""


def test_a_board_of_large_frames_refuses_the_whole_table():
    large = firmware(protocol=Protocol.adjacent(32))
    assert answers(large, pack(GetTable(), 3)) == [Ack(3, MessageType.GET_TABLE, 4)]
    assert answers(large, pack(GetTable(928), 3)) == [Ack(3, MessageType.GET_TABLE, 2)]


@pytest.mark.slow
def test_a_round_sensor_bends_on_the_fixture_that_is_given(tmp_path):
    disc = SensorDesign(Disc(0.05), 0.005, uniform(Disc(0.05), 8))
    disc.to_toml(tmp_path / "disc.toml")
    (tmp_path / "hinge.toml").write_text("span = 0.040\ngive = 0.0\n")
    uri = f"virtual:?sensor={tmp_path}/disc.toml&resolution=coarse&speed=max&snr_db=inf"
    with open_board(uri) as board, pytest.raises(ConfigurationError, match="rectangular"):
        board.stage.set(Scene(bend=Bend(20.0)))
    with open_board(f"{uri}&fixture={tmp_path}/hinge.toml") as board:
        board.stage.set(Scene(bend=Bend(20.0)))
        frame = next(board.frames())
    expected = Simulator(disc, "coarse", Hinge(0.040, give=0.0)).measure(Scene(bend=Bend(20.0)))
    assert frame.impedance == pytest.approx(expected.impedance, rel=1e-6)


def test_start_with_a_count_ends_after_it():
    board = firmware()
    board.receive(encode(Packet(MessageType.START, 1, b"\x03\0\0\0")))
    for _ in range(3):
        assert board.streaming
        board.frame()
    assert not board.streaming


# ---- memory line ----


class Clock:
    """Time that only waiting moves [s]."""

    now = 0.0

    def __call__(self):
        return self.now

    def wait(self, seconds):
        self.now += max(seconds, 1e-6)


def line(faults="", clock=None, period=0.0, **options):
    clock = clock or Clock()
    return MemoryLine(firmware(read_faults(faults), **options), period, clock, clock.wait)


def test_the_board_is_never_ahead_of_its_host():
    with virtual(snr_db=np.inf) as board:
        assert [frame.number for frame in take(board, 3)] == [0, 1, 2]
        board.stage.set(Scene(Bend(20.0)))
        (bent,) = take(board, 1)
        assert bent.number == 3
        assert bent.impedance == pytest.approx(1.02 * FLAT, rel=1e-6)
        stream = board.frames()
        next(stream)
        board.stage.set(Scene(Bend(40.0)))
        assert next(stream).impedance == pytest.approx(1.04 * FLAT, rel=1e-6)
        board.stage.play(Script((Step(Scene(), 1), Step(Scene(Bend(10.0)), 1))))
        ratios = [next(stream).impedance[0].real / FLAT[0] for _ in range(4)]
        assert ratios == pytest.approx([1.0, 1.01, 1.0, 1.01])
        assert (board.lost, board.counts.skipped, board.counts.dropped) == (0, 0, {})


def test_the_newest_frame_is_the_next_where_none_waits():
    with virtual() as board:
        stream = board.frames(newest=True)
        assert [next(stream).number for _ in range(5)] == list(range(5))
        assert board.counts.skipped == 0


def test_a_pulled_cable_ends_the_port_and_comes_back_as_another_session():
    clock = Clock()
    cable = line("replug@4:2", clock)
    with VirtualBoard(cable) as board:
        waits = []

        def wait(seconds):
            waits.append(cable.cable)
            clock.wait(seconds)

        frames = list(itertools.islice(Connection(board, wait=wait).frames(), 8))
        assert [frame.session for frame in frames] == [1] * 4 + [2] * 4
        assert waits[0] == 1  # it was out for a while
        assert (cable.cable, board.counts.reconnections) == (2, 1)


def test_an_unplugged_board_stays_away_until_its_faults_are_cleared():
    board = VirtualBoard(line("unplug@2"))
    stream = board.frames()
    take_two = [next(stream).number for _ in range(2)]
    assert take_two == [0, 1]
    with pytest.raises(DeviceError, match="went away"):
        next(stream)
    for _ in range(2):
        with pytest.raises(DeviceError, match="clear its faults"):
            board.reconnect()
    board.stage.clear()
    board.reconnect()
    assert next(board.frames()).session == 2
    board.close()
    board.close()


def test_delays_pass_by_the_clock_and_an_idle_line_makes_its_reader_wait():
    clock = Clock()
    delayed = line("stall@1:7", clock)
    delayed.start()
    port = delayed.connect("virtual:")
    port.reset_input_buffer()
    assert (port.read(9), clock.now) == (b"", 0.05)
    with SerialBoard(lambda: delayed.connect("virtual:"), "virtual:", clock) as board:
        stream = board.frames()
        next(stream)
        next(stream)
        before = clock.now
        with pytest.raises(DeviceError, match="stale"):
            next(stream)
        assert clock.now - before == pytest.approx(3 * 0.2968, abs=0.051)


def slow_line(clock, seconds, **options):
    """Line to a board that takes so long to simulate a frame."""
    slow = line(clock=clock, **options)
    measured = slow.firmware.frame

    def frame():
        clock.wait(seconds)
        return measured()

    slow.firmware.frame = frame
    return slow


def test_a_frame_that_takes_long_to_simulate_is_no_stale_stream():
    clock = Clock()
    slow = slow_line(clock, 60.0)
    with VirtualBoard(slow, clock=slow.now) as board:
        assert [each.number for each in take(board, 3)] == [0, 1, 2]
    assert slow.now() < clock.now


def numbers_of(port):
    """Numbers of the frames that wait in a port."""
    packets = Decoder().feed(port.read(port.in_waiting or 1))
    return [message.number for message in map(unpack, packets) if isinstance(message, FrameData)]


def started(paced):
    paced.start()
    port = paced.connect("virtual:")
    port.write(encode(pack(Start(), 1)))
    port.reset_input_buffer()
    return port


def test_a_paced_board_gives_a_frame_when_it_is_due_and_not_before():
    clock = Clock()
    port = started(line(clock=clock, period=0.3))
    clock.now = 0.29
    assert port.in_waiting == 0
    assert (port.read(9), clock.now) == (b"", pytest.approx(0.3))  # it waits for the frame alone
    assert numbers_of(port) == [0]
    clock.now = 1.25
    assert numbers_of(port) == [1, 2, 3]


def test_a_paced_board_skips_frames_that_its_host_has_no_room_for():
    clock = Clock()
    port = started(line(clock=clock, period=0.3))
    clock.now = 300.05
    late = numbers_of(port)
    assert late == list(range(len(late)))
    assert 10 < len(late) < 100
    clock.now = 300.35
    assert numbers_of(port) == [1000]


def test_a_frame_that_takes_long_to_simulate_moves_the_clock_of_a_paced_board():
    clock = Clock()
    slow = slow_line(clock, 2.0, period=0.3)
    with VirtualBoard(slow, clock=slow.now) as board:
        times = [each.time for each in take(board, 3)]
    period = slow.firmware.info.period
    assert np.diff(times) == pytest.approx([period + 1.7] * 2)
