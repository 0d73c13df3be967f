"""Whole chains: the files of their cases, and errors from what commands print."""

import json
import sys

import numpy as np
import pytest

from eitskin.benchmarks.studies.data import chains
from eitskin.benchmarks.studies.data.chain_cases import (
    CASES,
    DESIGN,
    OWN_RECIPE,
    PRESS,
    RECIPE,
    SESSION,
)
from eitskin.datasets import Recipe, open_dataset, save_dataset
from eitskin.datasets.recordings.form import RecordingForm
from eitskin.datasets.recordings.recording import read_recording
from eitskin.hardware import Script
from eitskin.simulator import Scene

import small_dataset


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.folder)
def test_files_of_a_case_are_valid_and_of_one_sensor(case, tmp_path):
    case.write(tmp_path)
    recipe, own = (Recipe.from_toml(tmp_path / name) for name in (RECIPE, OWN_RECIPE))
    assert (recipe.sensor, recipe.measured_protocol) == (own.sensor, own.measured_protocol)
    assert (recipe.frames, own.frames) == (case.idle + case.touched, case.own)
    assert recipe.seed != own.seed
    session, press = Script.from_toml(tmp_path / SESSION), Scene.from_toml(tmp_path / PRESS)
    assert [session(number) for number in (0, 9, 10, 19)] == [Scene(), Scene(), press, press]
    assert recipe.sensor.outline.contains(np.array([case.press])).all()
    assert f"sensor={DESIGN}" in case.board()


def test_presses_written_as_a_table_are_read_as_they_were(tmp_path):
    data = small_dataset.make()
    pressed = data.select(np.flatnonzero(data.touch_count > 0))
    save_dataset(pressed, tmp_path / "simulated")
    chains.write_presses(tmp_path / "simulated", tmp_path / "own.csv")
    form = RecordingForm("before-during", length_unit="mm")
    read = read_recording(tmp_path / "own.csv", protocol=pressed.protocol, form=form)
    kept = open_dataset(tmp_path / "simulated")
    assert read.impedance == pytest.approx(kept.impedance.real, rel=1e-5)
    assert read.touch_reference == pytest.approx(kept.touch_reference.real, rel=1e-5)
    assert read.touch_x[:, 0] == pytest.approx(kept.touch_x[:, 0], abs=1e-6)


def test_errors_of_a_live_session_are_those_of_its_pressed_half():
    idle = {"state": "idle", "touches": [], "problems": []}
    near = {"state": "touch", "touches": [[0.053, 0.024, 1.0]], "problems": ["out of date"]}
    found = dict(chains.followed([idle, idle, near, idle], (0.050, 0.020)))
    assert found["live / states right [%]"] == 75.0
    assert found["live / error [mm]"] == pytest.approx(5.0)
    assert found["live / touches per pressed frame"] == 0.5
    assert found["live / problems"] == 1


def test_a_failed_command_keeps_its_last_line_and_no_errors(tmp_path, monkeypatch):
    code = "import sys; print('{}'); sys.exit('first\\nno such sensor')"
    monkeypatch.setattr(chains, "EITSKIN", (sys.executable, "-c", code))
    chain = chains.Chain(CASES[0], tmp_path, tmp_path)
    chain.pictured()
    (ran,) = chain.found.ran
    assert (ran.status, ran.said) == (1, "no such sensor")
    assert chain.found.errors == {}
    assert "no such sensor" in (tmp_path / "reconstruct.log").read_text()


def test_the_picture_is_judged_by_its_least_value_and_commands_run_once(tmp_path, monkeypatch):
    picture = {"pictures": [{"least_at_m": [CASES[0].press[0] + 0.003, CASES[0].press[1]]}]}
    for code in (f"print({json.dumps(picture)!r})", "import sys; sys.exit('ran again')"):
        monkeypatch.setattr(chains, "EITSKIN", (sys.executable, "-c", code))
        chain = chains.Chain(CASES[0], tmp_path, tmp_path)
        chain.pictured()
        assert chain.found.errors["reconstruct / error [mm]"] == pytest.approx(3.0)
        assert dict(chain.found.figures())["reconstruct, exit status"] == 0
