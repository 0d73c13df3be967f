"""`eitskin instrument fit`: a board's instrument from flat frames, used again in simulation."""

import json

import numpy as np
import pytest
from command_line import run

from eitskin.datasets import Dataset, State, save_dataset
from eitskin.errors import DataError
from eitskin.geometry import SensorDesign
from eitskin.simulator import FourTerminalMeter, Instrument, Protocol, Scene, Simulator

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


@pytest.mark.slow
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
