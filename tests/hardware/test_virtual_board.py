"""The virtual board: its script, noise and pace, and its firmware."""

import dataclasses
import itertools

import numpy as np
import pytest

from eitskin.errors import DeviceError
from eitskin.geometry import Bend, Disc, Hinge, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.hardware import Connection, Script, SerialBoard, Stage, Step, VirtualBoard, open_board
from eitskin.hardware.protocol.messages import Ack, GetTable, Start, pack, unpack
from eitskin.hardware.protocol.packets import Decoder, FrameData, MessageType, Packet, encode
from eitskin.hardware.virtual.fault_table import read_faults
from eitskin.hardware.virtual.memory_line import MemoryLine
from eitskin.hardware.virtual.stage import SimulatedSensor
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
BENT = Step(Scene(bend=Bend(20.0)), 2)

# ---- scenes ----


def test_scripts_are_read_from_toml_and_change_the_scene(tmp_path):
    (tmp_path / "scene.toml").write_text("[bend]\nangle_deg = 20.0\n")
    (tmp_path / "script.toml").write_text(
        "repeat = false\n[[steps]]\nframes = 3\n"  # flat and untouched where nothing is said
        "[[steps]]\nframes = 2\n[steps.scene.bend]\nangle_deg = 20.0\n"
    )
    script = Script((Step(Scene(), 3), BENT), repeat=False)
    assert Script.from_toml(tmp_path / "script.toml") == script
    assert [script(number) for number in (2, 3, 9)] == [Scene(), BENT.scene, BENT.scene]
    assert Script.from_toml(tmp_path / "scene.toml")(5) == BENT.scene
    script = Script((Step(Scene(), 2), dataclasses.replace(BENT, frames=3)))
    simulator = FakeSimulator()
    with open_board("virtual:", speed="max", scene=script, snr_db=np.inf, simulator=simulator) as b:
        ratios = [frame.impedance[0].real / FLAT[0] for frame in take(b, 10)]
    assert np.allclose(ratios, [1, 1, 1.02, 1.02, 1.02] * 2)
    assert simulator.computed == 2
    stage = Stage(SimulatedSensor(FakeSimulator()).solve, lambda now: Scene(bend=Bend(float(now))))
    assert np.allclose(PROTOCOL.measure(stage.impedance_at_frame(30)), FLAT * 1.03)


# ---- measurements ----


def test_a_virtual_board_is_one_session_of_its_seed_and_instrument():
    sensors = [SimulatedSensor(FakeSimulator(), Instrument(60.0), seed) for seed in (3, 3, 4)]
    one, same, other = (sensor.measure(FLAT_MATRIX, 5)[0] for sensor in sensors)
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    noisy = [sensors[0].measure(FLAT_MATRIX, number)[0] for number in range(300)]
    assert (np.array(noisy) - FLAT).real.std() == pytest.approx(820.0 * 1e-3, rel=0.03)
    assert np.std(noisy, axis=0).min() > 0.0
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
    sim = Simulator(SensorDesign.reference(), "coarse")
    meter = FourTerminalMeter(sink=2e-3, idle=1e-3, scale=4.0)
    sensor = SimulatedSensor(sim, dataclasses.replace(Instrument.ideal(), meter=meter))
    loaded = meter.transfer_impedance(sim.model.impedance(), sim.protocol)
    measured, status = sensor.measure(sensor.solve(Scene()), 0)
    assert measured == pytest.approx(4.0 * loaded, rel=1e-9)
    assert np.abs(loaded / sim.measure(Scene()).impedance - 1.0).min() > 0.05
    assert not status.any()
    small = Instrument(snr_db=0.0, clipping=True, excitation=0.607, pga_range=0.3)
    with virtual(instrument=small) as board:
        assert (next(board.frames()).status == Status.CLIPPED).all()
    with virtual(instrument="ad5940") as board:  # 40 pF are 99 kohm: 1.6 ohm beside 400
        assert (next(board.frames()).impedance.imag < -0.5).all()


RECTANGLE, DISC = Rectangle(0.1, 0.05), Disc(0.05)
OWN = SensorDesign(RECTANGLE, 0.004, uniform(RECTANGLE, 6))
ROUND = SensorDesign(DISC, 0.005, uniform(DISC, 8))
REFERENCE = SensorDesign.reference()
TOUCHED = Scene(touches=(Touch(0.05, 0.02),))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "simulator", "scene"),
    [
        ("resolution=fast", lambda: Simulator(REFERENCE, "fast"), TOUCHED),
        ("resolution=coarse&sensor=own sensor.toml", lambda: Simulator(OWN, "coarse"), Scene()),
        (
            "resolution=coarse&protocol=adjacent",
            lambda: Simulator(REFERENCE, "coarse", protocol=Protocol.adjacent(8)),
            Scene(),
        ),
        (
            "resolution=coarse&sensor=round.toml&fixture=hinge.toml",
            lambda: Simulator(ROUND, "coarse", Hinge(0.040, give=0.0)),
            BENT.scene,
        ),
    ],
)
def test_the_virtual_board_measures_what_the_simulator_does(
    options, simulator, scene, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    OWN.to_toml("own sensor.toml")
    ROUND.to_toml("round.toml")
    (tmp_path / "hinge.toml").write_text("span = 0.040\ngive = 0.0\n")
    with open_board(f"virtual:?speed=max&snr_db=inf&{options}", scene=scene) as board:
        (frame,) = take(board, 1)
    assert board.protocol == simulator().protocol
    assert frame.impedance == pytest.approx(simulator().measure(scene).impedance, rel=1e-6)


# ---- firmware: bytes in, bytes out ----


def answers(board_firmware, packet):
    sent = board_firmware.receive(encode(packet))
    return [unpack(packet) for packet in Decoder().feed(sent)]


def test_firmware_refuses_what_it_does_not_know_and_ends_after_its_count():
    assert answers(firmware(), Packet(0x42, 7)) == [Ack(7, 0x42, 2)]
    assert answers(firmware(), Packet(MessageType.START, 8, b"x")) == [Ack(8, MessageType.START, 2)]
    assert answers(firmware(), pack(Ack(1, 1), 9)) == [Ack(9, MessageType.ACK, 1)]
    large = firmware(protocol=Protocol.adjacent(32))  # whose table needs several packets
    assert answers(large, pack(GetTable(), 3)) == [Ack(3, MessageType.GET_TABLE, 4)]
    assert answers(large, pack(GetTable(928), 3)) == [Ack(3, MessageType.GET_TABLE, 2)]
    assert firmware().receive(b"\0\x03AT\r\n\0") == b""
    board = firmware()
    board.receive(encode(Packet(MessageType.START, 1, b"\x03\0\0\0")))
    streaming = [board.frame() and board.streaming for _ in range(3)]
    assert streaming == [True, True, False]


# ---- memory line ----


class Clock:
    """Time that only waiting moves [s]."""

    now = 0.0

    def __call__(self):
        return self.now

    def wait(self, seconds):
        self.now += max(seconds, 1e-6)


@pytest.fixture
def clock():
    return Clock()


def line(clock, faults="", period=0.0, simulation=0.0):
    """Line to a board that takes so long to simulate a frame [s]."""
    made = MemoryLine(firmware(read_faults(faults)), period, clock, clock.wait)
    measured = made.firmware.frame

    def frame():
        clock.now += simulation
        return measured()

    made.firmware.frame = frame
    return made


def test_the_board_is_never_ahead_of_its_host():
    with virtual(snr_db=np.inf) as board:
        assert [frame.number for frame in take(board, 3)] == [0, 1, 2]
        board.stage.set(Scene(Bend(20.0)))
        stream = board.frames(newest=True)
        bent = next(stream)
        assert bent.number == 3
        assert bent.impedance == pytest.approx(1.02 * FLAT, rel=1e-6)
        board.stage.play(Script((Step(Scene(), 1), Step(Scene(Bend(10.0)), 1))))
        ratios = [next(stream).impedance[0].real / FLAT[0] for _ in range(4)]
        assert ratios == pytest.approx([1.0, 1.01, 1.0, 1.01])
        assert (board.lost, board.counts.skipped, board.counts.dropped) == (0, 0, {})


def test_a_pulled_cable_comes_back_as_a_session_and_an_unplugged_board_when_cleared(clock):
    cable, waits = line(clock, "replug@4:2"), []

    def wait(seconds):
        waits.append(cable.cable)
        clock.wait(seconds)

    with VirtualBoard(cable) as board:
        frames = list(itertools.islice(Connection(board, wait=wait).frames(), 8))
        assert [frame.session for frame in frames] == [1] * 4 + [2] * 4
        assert waits[0] == 1  # it was out for a while
        assert (cable.cable, board.counts.reconnections) == (2, 1)
    board = VirtualBoard(line(clock, "unplug@2"))
    stream = board.frames()
    assert [next(stream).number for _ in range(2)] == [0, 1]
    with pytest.raises(DeviceError, match="went away"):
        next(stream)
    for _ in range(2):
        with pytest.raises(DeviceError, match="clear its faults"):
            board.reconnect()
    board.stage.clear()
    board.reconnect()
    assert next(board.frames()).session == 2


def test_delays_pass_by_the_clock_and_an_idle_line_makes_its_reader_wait(clock):
    delayed = line(clock, "stall@1:7")
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


@pytest.mark.parametrize(("period", "seconds"), [(0.0, 60.0), (0.3, 2.0)])
def test_a_frame_that_takes_long_to_simulate_is_no_stale_stream(clock, period, seconds):
    """The clock of a paced board goes on meanwhile."""
    slow = line(clock, period=period, simulation=seconds)
    with VirtualBoard(slow, clock=slow.now) as board:
        frames = take(board, 3)
    assert [each.number for each in frames] == [0, 1, 2]
    assert slow.now() < clock.now
    board_period = slow.firmware.info.period
    apart = board_period + seconds - 0.3 if period else board_period
    assert np.diff([each.time for each in frames]) == pytest.approx([apart] * 2)


def test_a_paced_board_gives_a_frame_when_it_is_due_and_skips_those_without_room(clock):
    paced = line(clock, period=0.3)
    paced.start()
    port = paced.connect("virtual:")
    port.write(encode(pack(Start(), 1)))
    port.reset_input_buffer()

    def numbers(now):
        """Numbers of the frames that wait in the port."""
        clock.now = now
        packets = Decoder().feed(port.read(port.in_waiting or 1))
        return [each.number for each in map(unpack, packets) if isinstance(each, FrameData)]

    clock.now = 0.29
    assert port.in_waiting == 0
    assert (port.read(9), clock.now) == (b"", pytest.approx(0.3))  # it waits for the frame alone
    assert numbers(0.3) == [0]
    assert numbers(1.25) == [1, 2, 3]
    late = numbers(300.05)
    assert late == list(range(4, 4 + len(late)))
    assert 10 < len(late) < 100
    assert numbers(300.35) == [1000]
