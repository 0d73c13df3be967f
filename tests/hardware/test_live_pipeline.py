"""The pipeline that ships, live on every kind of board: the same frames, the same estimates."""

import contextlib
import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
from typer.testing import CliRunner

from eitskin.cli.main import app
from eitskin.datasets import ShardWriter, State
from eitskin.frame import Frame
from eitskin.geometry import Bend, SensorDesign
from eitskin.hardware import Script, Step, open_board, run_live
from eitskin.hardware.streams import reading_record
from eitskin.hardware.virtual.memory_line import MemoryLine
from eitskin.hardware.virtual.pseudo_terminal import PseudoTerminal
from eitskin.simulator import Scene, Simulator, Touch
from eitskin.training import Pipeline

from compiled_firmware import CompiledFirmware, config
from live_fakes import FakeBoard
from loopback import PROTOCOL
from simulated_afe import SimulatedAfe

STEPS = (
    Step(Scene(), 6),
    Step(Scene(Bend(20.0)), 4),
    Step(Scene(Bend(20.0), (Touch(0.05, 0.02),)), 4),
)
SCRIPT = Script(STEPS, repeat=False)
FRAMES = sum(step.frames for step in STEPS)
FAULTS = "faults=nan_channel@9:4,lost_frame@8"


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.load("reference.eitmodel")


@pytest.fixture(scope="module")
def simulator():
    return Simulator(SensorDesign.reference(), resolution="fast")


@contextlib.contextmanager
def virtual_board(simulator, _):
    uri = f"virtual:?speed=max&instrument=ad5940&seed=3&{FAULTS}"
    with open_board(uri, scene=SCRIPT, simulator=simulator) as board:
        yield board


@contextlib.contextmanager
def firmware_board(simulator, _):
    """The firmware in C on an AD5940 that sees the script's scenes."""

    def impedance(row):
        scene = SCRIPT(firmware.number)
        return simulator.measure(scene).impedance[PROTOCOL.table.index(tuple(row))]

    firmware = CompiledFirmware(SimulatedAfe(impedance), config())
    with (
        PseudoTerminal(MemoryLine(firmware)) as terminal,
        open_board(f"serial:{terminal.path}") as board,
    ):
        yield board


@contextlib.contextmanager
def replay_board(simulator, folder):
    with virtual_board(simulator, folder) as board, ShardWriter(folder / "run") as writer:
        for frame in itertools.islice(board.frames(), FRAMES):
            writer.append(frame)
    with open_board(f"replay:{folder / 'run'}") as board:
        yield board


@pytest.fixture(params=[virtual_board, firmware_board, replay_board])
def board(request, simulator, tmp_path):
    with request.param(simulator, tmp_path) as opened:
        yield opened


def said(estimate):
    """Everything that an estimate says, to the last bit."""
    touches = [(*touch, touch.force, touch.deviation) for touch in estimate.touches]
    arrays = (estimate.probabilities, estimate.touch_map, touches)
    return (
        estimate.state,
        estimate.bend_angle_deg,
        estimate.bend_deviation_deg,
        estimate.problems,
        *(np.asarray(array).tobytes() for array in arrays),
    )


@pytest.mark.slow
def test_live_estimates_are_those_of_the_same_frames_offline(board, pipeline):
    pipeline.reset()
    readings = list(itertools.islice(run_live(board, pipeline, newest=False), FRAMES - 1))
    offline = Pipeline.load("reference.eitmodel")
    assert [said(offline.process(r.frame)) for r in readings] == [
        said(r.estimate) for r in readings
    ]
    states = [reading.estimate.state for reading in readings]
    assert states[:6] == [State.IDLE] * 6
    assert set(states[6:9]) == {State.BEND}
    assert states[-3:] == [State.TOUCH] * 3
    ((x, y, _),) = readings[-1].estimate.touches
    assert np.hypot(x - 0.05, y - 0.02) < 4e-3
    assert readings[-1].estimate.bend_angle_deg == pytest.approx(20.0, abs=4.0)


@pytest.mark.slow
def test_a_recording_replays_to_identical_lines(tmp_path):
    """Through the command, with lost frames, values that are none, and a restart."""
    scene = tmp_path / "script.toml"
    scene.write_text(
        "repeat = false\n[[steps]]\nframes = 4\n[steps.scene]\n"
        "[[steps]]\nframes = 3\n[steps.scene.bend]\nangle_deg = 20.0\n"
        "[[steps]]\nframes = 9\n[steps.scene]\n[[steps.scene.touches]]\nx = 0.05\ny = 0.02\n"
    )
    uri = f"virtual:?speed=max&scene={scene}&faults=lost_frame@5,inf_channel@8:4,reboot@12"

    def lines(*arguments):
        result = CliRunner().invoke(app, ["live", "reference.eitmodel", "--json", *arguments])
        assert result.exit_code == 0, result.output
        found = [json.loads(line) for line in result.stdout.splitlines()]
        moment = ("wall_time", "latency_ms", "rate_hz", "dropped", "skipped", "reconnections")
        return [{k: v for k, v in line.items() if k not in moment} for line in found]

    folder = tmp_path / "run"
    live = lines("--board", uri, "--frames", "14", "--record", str(folder))
    assert lines("--board", f"replay:{folder}") == live
    assert {line["session"] for line in live} == {1, 2}
    assert live[-1]["lost"] == 1
    assert live[8]["bad_channels"] == {"0-5": "not finite"}
    assert {line["state"] for line in live} == {"idle", "bend", "touch"}


# ---- hostile sessions ----


SESSIONS, HOSTILE_FRAMES = 20, 10
ODD_NUMBERS = (0, 5_000_000, 2**31, 2**32 - 1)
ODD_TIMES = (math.nan, math.inf, -math.inf, -1e308, 1e308, 4294.967295, 0.0)
ODD_VALUES = (math.nan, math.inf, -math.inf, 0.0, 1e-300, 1e300, -1.0, 500.0)


def damaged(good, rng):
    """Frame with one fault, or several."""
    values, count = good.impedance.copy(), len(good.impedance)
    chosen = rng.random(count) < rng.choice([0.04, 0.5, 1.0])
    faults = {
        "sign": lambda: np.where(chosen, -values, values),
        "values": lambda: np.where(chosen, rng.choice(ODD_VALUES), values),
        "factor": lambda: np.where(chosen, values * 10 ** rng.uniform(-12, 12), values),
        "phase": lambda: values * np.exp(2j * np.pi * rng.random()),
        "order": lambda: rng.permutation(values),
        "touch": lambda: values * (1 + 0.2 * rng.standard_normal(count)),
    }
    made = faults[rng.choice(list(faults))]()
    changes = {"impedance": made}
    if rng.random() < 0.3:
        changes["time"] = float(rng.choice(ODD_TIMES))
    if rng.random() < 0.3:
        changes["number"] = int(rng.choice(ODD_NUMBERS))
    if rng.random() < 0.1:
        changes["session"] = int(rng.integers(0, 2**16))
    if rng.random() < 0.2:
        changes["status"] = rng.integers(0, 256, count).astype(np.uint8) * chosen
    return dataclasses.replace(good, **changes)


def hostile_frames(pipeline, seed):
    """Frames of a session, most of them damaged after the first."""
    rng, layout = np.random.default_rng(seed), pipeline.layout
    for number in range(HOSTILE_FRAMES):
        impedance = layout.reference * (1 + 2e-4 * rng.standard_normal(len(layout.reference)))
        good = Frame(impedance, layout.protocol, 0.3 * number, number, frequency=layout.frequency)
        yield damaged(good, rng) if number and rng.random() < 0.7 else good


def survived(pipeline, seed):
    pipeline.reset()
    readings = list(run_live(FakeBoard(list(hostile_frames(pipeline, seed))), pipeline))
    assert len(readings) == HOSTILE_FRAMES
    for reading in readings:
        assert (reading.estimate is None) == bool(reading.problem)
        assert reading_record(reading, FakeBoard.counts)["version"]
    return sum(reading.estimate is not None for reading in readings)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # overflow: values of 1e300 ohm
def test_hostile_sessions_end_in_nothing_but_readings(pipeline):
    assert sum(survived(pipeline, seed) for seed in range(SESSIONS)) > SESSIONS


def test_one_value_of_the_wrong_sign_is_left_out_and_told(pipeline):
    good = next(hostile_frames(pipeline, 0))
    values = good.impedance.copy()
    values[5] *= -1
    frames = [good, dataclasses.replace(good, impedance=values, number=1, time=0.3)]
    pipeline.reset()
    first, second = run_live(FakeBoard(frames), pipeline)
    assert not first.estimate.problems
    (told,) = second.estimate.problems
    assert pipeline.layout.protocol.labels[5] in told
    assert "sign changed" in told


@pytest.mark.slow
@pytest.mark.parametrize("unknown", [0, 13])
def test_values_of_the_wrong_sign_are_no_sensor_at_rest(pipeline, unknown):
    good = next(hostile_frames(pipeline, 0))
    reversed_ = np.where(np.arange(len(good.impedance)) < unknown, np.nan, -good.impedance)
    frames = [good, dataclasses.replace(good, impedance=reversed_, number=1, time=0.3)]
    pipeline.reset()
    first, second = run_live(FakeBoard(frames), pipeline)
    assert first.problem == ""
    assert second.estimate is None
    assert "changed their sign" in second.problem
