"""The pipeline that ships, live: the same frames, the same estimates."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from eitskin.cli.main import app
from eitskin.datasets import State
from eitskin.frame import Frame
from eitskin.geometry import Bend
from eitskin.hardware import Script, Step, open_board, run_live
from eitskin.simulator import Scene, Touch
from eitskin.training import Pipeline

from live_fakes import FakeBoard

STEPS = (
    Step(Scene(), 6),
    Step(Scene(Bend(20.0)), 4),
    Step(Scene(Bend(20.0), (Touch(0.05, 0.02),)), 4),
)
FAULTS = "faults=nan_channel@9:4,lost_frame@8"


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.load("reference.eitmodel")


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
def test_live_estimates_are_those_of_the_same_frames_offline(pipeline):
    pipeline.reset()
    uri = f"virtual:?speed=max&instrument=ad5940&seed=3&{FAULTS}"
    with open_board(uri, scene=Script(STEPS, repeat=False)) as board:
        readings = list(itertools.islice(run_live(board, pipeline, newest=False), 13))
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


def test_one_value_of_the_wrong_sign_is_left_out_and_many_are_no_sensor_at_rest(pipeline):
    layout = pipeline.layout
    noisy = layout.reference * (1 + 2e-4 * np.random.default_rng(0).standard_normal(28))
    good = Frame(noisy, layout.protocol, frequency=layout.frequency)
    numbers = np.arange(28)
    for turned in (numbers == 5, numbers >= 0, numbers >= 13):
        values = np.where(turned, -noisy, noisy if turned[5] else np.nan)
        later = dataclasses.replace(good, impedance=values, number=1, time=0.3)
        pipeline.reset()
        first, second = run_live(FakeBoard([good, later]), pipeline)
        assert not first.estimate.problems
        if turned.sum() == 1:
            (told,) = second.estimate.problems
            assert "sign changed" in told
            assert layout.protocol.labels[5] in told
        else:
            assert second.estimate is None
            assert "changed their sign" in second.problem
