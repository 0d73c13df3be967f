"""`eitskin setup`: all steps against a virtual board, and what is kept of one that ends early."""

import json
import re
from functools import lru_cache

import numpy as np
import pytest
from typer.testing import CliRunner

from eitskin.cli.commands.own_sensor import setup as setup_command
from eitskin.cli.commands.own_sensor.poses import (
    as_dataset,
    bent_pose,
    place_map,
    press_places,
    pressed_pose,
)
from eitskin.cli.main import app
from eitskin.datasets import State, open_dataset
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry import SensorDesign
from eitskin.hardware.virtual import virtual_board
from eitskin.simulator import Frame, Protocol, Simulator
from eitskin.training import Pipeline

from loopback import FLAT, FakeSimulator

BOARD = "virtual:?speed=max"
DESIGN = SensorDesign.reference()


def run(*words, typed="", code=0):
    ran = CliRunner().invoke(app, ["setup", *map(str, words)], input=typed)
    if code is not None:
        assert ran.exit_code == code, (ran.output, ran.exception)
    return ran


@pytest.mark.slow
def test_a_virtual_sensor_is_set_up_without_a_question(tmp_path, monkeypatch):
    monkeypatch.setattr(virtual_board, "Simulator", lru_cache(Simulator))
    mine = tmp_path / "mine.eitmodel"
    # Frames differ with how fast they are read, and 45 deg is told to half a degree.
    few = ("--angles", "-15,10,25", "--presses", 2, "--frames", 4)
    quietly = ("--no-prompt", "--json", "-q")
    said = json.loads(
        run("reference.eitmodel", "--out", mine, "--board", BOARD, *few, *quietly).stdout
    )
    assert said["adaptation"]["bends"] == 12
    assert said["next"].startswith(f"eitskin live {mine} --board '{BOARD}' --reference")
    assert Pipeline.load(mine).calibration["residual_deg"] < 0.5
    data = open_dataset(tmp_path / "mine-frames")
    assert [int((data.state == state).sum()) for state in State] == [12, 8, 12]
    assert np.isfinite(data.touch_reference[data.state == State.TOUCH]).all()


def test_steps_are_skipped_and_what_ends_early_is_told(tmp_path, monkeypatch):
    """The angles are taken, and Ctrl-C ends the set-up at the first press."""
    monkeypatch.setattr(virtual_board, "Simulator", lambda *_, **__: FakeSimulator())
    mine = tmp_path / "mine.eitmodel"

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(setup_command.Setup, "_press", interrupted)
    words = ("reference.eitmodel", "--out", mine, "--board", BOARD, "--angles", "20")
    ended = run(*words, typed="s\ns\n\n\n\n\n\n", code=None)
    assert ended.exit_code != 0
    assert "mine-frames" in "".join(ended.output.split())  # lines end anywhere in a long path
    assert "eitskin adapt reference.eitmodel" in ended.output
    assert not mine.exists()
    assert len(open_dataset(tmp_path / "mine-frames")) == 16
    assert sorted(each.name for each in tmp_path.iterdir()) == ["mine-frames"]


def test_a_board_that_is_typed_keeps_its_capitals_and_a_wrong_number_is_told(tmp_path):
    words = ("reference.eitmodel", "--out", tmp_path / "mine.eitmodel")
    ended = run(*words, typed="99\nserial:/dev/ttyNONE\n\n\n" + "s\n" * 4, code=None)
    said = " ".join(ended.output.split())
    assert "got '99'" in said
    assert said.count("/dev/ttyNONE") > 1, "typed, and in what opening it says"
    skipped = run(*words, "--board", BOARD, typed="s\n" * 4, code=None)
    assert isinstance(skipped.exception, ConfigurationError)
    assert "nothing was kept" in str(skipped.exception)
    assert not list(tmp_path.iterdir())


def test_places_are_on_the_map_and_frames_in_poses_are_a_dataset_with_a_reference():
    places = np.array(press_places(DESIGN, 10))
    away = np.linalg.norm(places[:, None] - places, axis=2) + np.eye(10)
    assert away.min() > 0.02
    assert DESIGN.outline.contains(places).all()
    lines = place_map(DESIGN, places.tolist()).splitlines()
    line = [
        next(k for k, each in enumerate(lines) if re.search(rf"(?<!\d){number}(?!\d)", each))
        for number in range(1, 11)
    ]
    assert line[int(places[:, 1].argmax())] < line[int(places[:, 1].argmin())]
    protocol, poses = Protocol.pairwise(8), [bent_pose(0.0), bent_pose(20.0), bent_pose(0.0)]
    poses.append(pressed_pose("1", 0.03, 0.02))
    scale = [1.0, 1.2, 1.01, 1.05]
    taken = [
        (Frame(FLAT * each, protocol, number=k), pose.label)
        for k, (each, pose) in enumerate(zip(scale, poses, strict=True))
    ]
    data = as_dataset(taken, DESIGN)
    assert data.state.tolist() == [State.IDLE, State.BEND, State.IDLE, State.TOUCH]
    np.testing.assert_allclose(data.reference[0], 1.005 * FLAT, rtol=1e-6)
    np.testing.assert_allclose(data.touch_reference[3], 1.01 * FLAT, rtol=1e-6)
    assert data.touch_x[3, 0] == pytest.approx(0.03)
    assert np.isnan(data.touch_reference[:3]).all()
    with pytest.raises(DataError, match="flat, untouched"):
        as_dataset(taken[1:2], DESIGN)
