"""Commands that take references and fit meters: tare, check, calibrate, instrument."""

import json
from functools import lru_cache

import numpy as np
import pytest
from command_line import run

from eitskin.datasets import Dataset, ShardWriter, State, save_dataset
from eitskin.errors import DataError
from eitskin.geometry import SensorDesign
from eitskin.hardware.virtual import virtual_board as virtual
from eitskin.simulator import FourTerminalMeter, Frame, Instrument, Protocol, Scene, Simulator
from eitskin.training import Pipeline, StoredReference, Zero

pytestmark = pytest.mark.slow

FLAT = "virtual:?speed=max&resolution=coarse"
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


def test_references_know_board_zero_and_dataset(reference, tmp_path):
    stored = StoredReference.read(reference)
    assert (stored.zero, stored.frames, stored.source) == (Zero.FLAT, 8, FLAT)
    assert bytes.fromhex(stored.board) == b"eitskin-0000"
    assert 0 < stored.noise < 2e-3
    path, flat = tmp_path / "r.json", 1.1 * Pipeline.load("reference.eitmodel").layout.reference
    with ShardWriter(tmp_path / "run") as writer:
        writer.append(Frame(flat, Protocol.pairwise(8)))
    words = ("--dataset", tmp_path / "run", "--mounted", "--out", path)
    run("tare", "reference.eitmodel", *words, code=0)
    np.testing.assert_allclose(StoredReference.read(path).impedance, flat, rtol=1e-6)


def test_a_bent_start_is_no_flat_one_and_taken_by_its_reference(bent, reference, tmp_path):
    path = tmp_path / "mounted.json"
    with pytest.raises(DataError, match="--mounted"):
        tare(path, bent)
    assert not path.exists()
    said = json.loads(tare(path, bent, "--mounted", "--json", "--frames", 4).stdout)
    assert (said["zero"], said["frames"]) == ("as mounted", 4)
    check = ("check", "--frames", 4, "--json", "--board")
    (finding,) = json.loads(run(*check, bent, code=4).stdout)["findings"]
    assert finding["what"] == "not flat"
    assert "eitskin tare" in finding["message"]
    (finding,) = json.loads(run(*check, bent, "--reference", reference, code=4).stdout)["findings"]
    assert "1 touch" in finding["message"]
    run(*check, FLAT, "--reference", reference, code=0)
    live = ("live", "reference.eitmodel", "--board", bent, "--frames", 2, "--every-frame", "--json")
    lines = [json.loads(line) for line in run(*live).stdout.splitlines()]
    assert {(line["state"], line["bend_angle_deg"]) for line in lines} == {(None, None)}
    assert "does not look flat" in lines[0]["problems"][0]
    lines = run(*live, "--reference", reference).stdout.splitlines()
    known = json.loads(lines[-1])
    assert (known["state"], known["zero"], known["problems"]) == ("touch", "flat", [])
    assert known["bend_angle_deg"] == pytest.approx(30.0, abs=4.0)


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


# Meters fitted to a rig


RING = Protocol.adjacent(8, shared=True)
RIG = FourTerminalMeter(sink=4e-3, idle=6e-4, scale=3.0, reads="signed")


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """Folder with the reference sensor's design, its protocol, and flat frames on a rig."""
    folder = tmp_path_factory.mktemp("rig")
    design = SensorDesign.reference()
    design.to_toml(folder / "sensor.toml")
    RING.to_file(folder / "ring.csv")
    sim = Simulator(design, "coarse", protocol=RING)
    flat, _ = RIG.reading(RIG.transfer_impedance(sim.model.impedance(), RING))
    noise = np.random.default_rng(0).standard_normal((20, len(RING)))
    np.savez(folder / "flat.npz", u=flat.real + 1e-4 * np.abs(flat).max() * noise)
    return folder, flat


def fit(folder, *arguments):
    return run("instrument", "fit", folder / "sensor.toml", *arguments, code=0)


def test_a_rig_is_fitted_and_simulated_as_it_reads(rig, tmp_path):
    folder, flat = rig
    out = tmp_path / "rig.toml"
    source = (folder / "flat.npz", "--values", "u", "--protocol", folder / "ring.csv")
    terms = ("--terms", "source,sink,idle", "--first", 15)
    result = fit(folder, *source, *terms, "--out", out, "--json")
    said = json.loads(result.stdout)
    found = {each["name"]: each for each in said["parameters"]}
    assert "source" not in found
    assert "need them: source\n" in result.stderr
    for name, true in (("sink", 4e-3), ("idle", 6e-4), ("scale", 3.0)):
        error = abs(found[name]["value"] - true)
        assert error < 5.0 * found[name]["standard_error"] < 0.5 * true
    for frames in said["agreement"].values():
        assert frames["meter"]["residual"] < 1e-3
        assert frames["ideal"]["residual"] > 0.1
    board = Instrument.from_toml(out)
    assert board.snr_db == pytest.approx(80.0, abs=1.0)
    sim = Simulator(SensorDesign.reference(), "coarse", protocol=RING)
    frame = sim.measure(Scene(), board, np.random.default_rng(0))
    assert frame.impedance.real == pytest.approx(flat.real, abs=2e-3 * np.abs(flat).max())
    assert not frame.impedance.imag.any()


def test_flat_frames_of_a_dataset_are_those_before_touches_or_idle(rig, tmp_path):
    folder, flat = rig
    state = np.array([State.TOUCH, State.IDLE])
    frames = np.array([1.1 * flat, flat])
    save_dataset(Dataset.from_arrays(frames, protocol=RING, state=state), tmp_path / "idle")
    options = ("--terms", "sink", "--keep-all", "--out", tmp_path / "rig.toml")
    result = fit(folder, tmp_path / "idle", *options)
    assert "1 flat frames (idle)" in result.stderr
    assert "not identifiable" in result.stdout  # one load has no way back
    save_dataset(Dataset.from_arrays(frames, protocol=RING, state=state[[0, 0]]), tmp_path / "x")
    with pytest.raises(DataError):
        fit(folder, tmp_path / "x", *options)
