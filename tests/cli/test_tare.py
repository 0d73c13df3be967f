"""`eitskin tare`, and the commands that use its reference or tell a start that is not flat."""

import json
from functools import lru_cache

import numpy as np
import pytest
from command_line import run

from eitskin.datasets import ShardWriter
from eitskin.errors import DataError
from eitskin.hardware.virtual import virtual_board as virtual
from eitskin.simulator import Frame, Protocol, Simulator
from eitskin.training import Pipeline, StoredReference, Zero

FLAT = "virtual:?speed=max"
kept_simulator = lru_cache(Simulator)  # of the sensor that all of the boards have


@pytest.fixture(autouse=True)
def one_simulator(monkeypatch):
    monkeypatch.setattr(virtual, "Simulator", kept_simulator)


@pytest.fixture
def bent(tmp_path):
    path = tmp_path / "bent.toml"
    path.write_text("[bend]\nangle_deg = 30.0\n[[touches]]\nx = 0.04\ny = 0.02\nforce = 10.0\n")
    return f"{FLAT}&scene={path}"


def tare(path, board, *options):
    return run("tare", "reference.eitmodel", "--board", board, "--out", path, *options, code=0)


@pytest.fixture
def reference(tmp_path):
    path = tmp_path / "mine.json"
    tare(path, FLAT, "--frames", 8)
    return path


def test_the_reference_knows_its_board_and_zero(reference):
    stored = StoredReference.read(reference)
    assert (stored.zero, stored.frames, stored.source) == (Zero.FLAT, 8, FLAT)
    assert bytes.fromhex(stored.board) == b"eitskin-0000"
    assert 0 < stored.noise < 2e-3


def test_the_reference_may_be_that_of_a_dataset(tmp_path):
    path, flat = tmp_path / "r.json", 1.1 * Pipeline.load("reference.eitmodel").layout.reference
    with ShardWriter(tmp_path / "run") as writer:
        writer.append(Frame(flat, Protocol.pairwise(8)))
    words = ("--dataset", tmp_path / "run", "--mounted", "--out", path)
    run("tare", "reference.eitmodel", *words, code=0)
    np.testing.assert_allclose(StoredReference.read(path).impedance, flat, rtol=1e-6)


def test_a_bent_sensor_is_no_flat_reference_but_a_mounted_one(bent, tmp_path):
    path = tmp_path / "mounted.json"
    with pytest.raises(DataError, match="--mounted"):
        tare(path, bent)
    assert not path.exists()
    said = json.loads(tare(path, bent, "--mounted", "--json", "--frames", 4).stdout)
    assert (said["zero"], said["frames"]) == ("as mounted", 4)


@pytest.mark.slow
def test_check_tells_a_sensor_that_does_not_start_flat(bent, reference):
    check = ("check", "--frames", 4, "--json", "--board")
    (finding,) = json.loads(run(*check, bent, code=4).stdout)["findings"]
    assert finding["what"] == "not flat"
    assert "eitskin tare" in finding["message"]
    (finding,) = json.loads(run(*check, bent, "--reference", reference, code=4).stdout)["findings"]
    assert "1 touch" in finding["message"]
    run(*check, FLAT, "--reference", reference, code=0)


@pytest.mark.slow
def test_live_estimates_a_bent_start_by_its_reference(bent, reference):
    live = ("live", "reference.eitmodel", "--board", bent, "--frames", 2, "--every-frame", "--json")
    lines = [json.loads(line) for line in run(*live).stdout.splitlines()]
    assert {(line["state"], line["bend_angle_deg"]) for line in lines} == {(None, None)}
    assert "does not look flat" in lines[0]["problems"][0]
    lines = run(*live, "--reference", reference).stdout.splitlines()
    known = json.loads(lines[-1])
    assert (known["state"], known["zero"], known["problems"]) == ("touch", "flat", [])
    assert known["bend_angle_deg"] == pytest.approx(30.0, abs=4.0)


@pytest.mark.slow
def test_calibration_with_a_reference_needs_no_flat_sensor(reference, tmp_path):
    angles = [-20, 15, 30, 50]
    script = tmp_path / "bends.toml"
    step = "[[steps]]\nframes = 2\n[steps.scene.bend]\nangle_deg = {:.1f}\n"
    script.write_text("repeat = false\n" + "".join(step.format(angle) for angle in angles))
    mine = tmp_path / "mine.eitmodel"
    named = ("--angles", ",".join(map(str, angles)), "--frames", 2, "--no-prompt", "--out", mine)
    board = ("--board", f"{FLAT}&scene={script}", "--reference", reference, "--json")
    said = json.loads(run("calibrate", "reference.eitmodel", *named, *board).stdout)
    assert said["residual_deg"] < 0.5
    assert max(said["error_after_deg"]) < 0.7 * max(said["error_before_deg"])
