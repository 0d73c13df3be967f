"""Importing measured recordings: synthetic ones in every format, and real ones where present."""

import os
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from typer.testing import CliRunner

from eitskin.cli.main import app
from eitskin.datasets import (
    UNKNOWN_STATE,
    RecordingNames,
    State,
    open_dataset,
    read_recording,
    save_dataset,
)
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol

DATA = Path(os.environ.get("EITSKIN_DATA", Path(__file__).parents[3] / "shared" / "data"))

PRESSED = np.arange(12.0).reshape(3, 4) + 100.0
UNTOUCHED = PRESSED + 1.0
PLACES = np.array([[0.01, 0.02, 0.001], [np.nan, np.nan, np.nan], [-0.03, 0.04, 0.002]])


def write(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def real(name):
    path = DATA / name
    if not path.is_file():
        pytest.skip(f"{path} is not there; set EITSKIN_DATA to the folder of real recordings")
    return path


CSV = """state, angle_deg, x, y, force, t, v0, v1, v2, r0, r1, r2
idle, 0, , , , 0.0, 1, 2+1j, 3, 10, 20, 30
touch, , 0.05, 0.02, 9, 0.5, 4, 5, 6, 11, 21, 31
, -5, , , , 1.0, 7, 8, 9, 12, 22, 32
"""


def test_csv_with_everything(tmp_path):
    data = read_recording(
        write(tmp_path, "run.csv", CSV),
        RecordingNames(touch_reference="r"),
        Protocol.pairwise(3),
        frequency=10e3,
    )
    assert data.source == "measured"
    assert data.frequency == 10e3
    assert np.array_equal(data.impedance, [[1, 2 + 1j, 3], [4, 5, 6], [7, 8, 9]])
    assert np.array_equal(data.touch_reference[:, 0], [10, 11, 12])
    # The mean of the untouched readings that are not known to be bent.
    assert np.array_equal(data.reference, [[10.5, 20.5, 30.5]])
    assert data.state.tolist() == [State.IDLE, State.TOUCH, UNKNOWN_STATE]
    assert np.array_equal(data.bend_angle_deg, np.float32([0, np.nan, -5]), equal_nan=True)
    assert np.array_equal(data.touch_x[:, 0], np.float32([np.nan, 0.05, np.nan]), equal_nan=True)
    assert np.array_equal(data.touch_y[:, 0], np.float32([np.nan, 0.02, np.nan]), equal_nan=True)
    assert data.touch_force[1, 0] == 9
    assert np.isnan(data.touch_x[:, 1:]).all()
    assert data.time.tolist() == [0.0, 0.5, 1.0]
    assert data.frame(1).protocol == Protocol.pairwise(3)


def test_csv_with_nothing_but_values_of_many_channels(tmp_path):
    header = ",".join(f"ch{i}" for i in range(40))
    row = ",".join(str(i) for i in range(40))
    path = write(tmp_path, "run.csv", f"\ufeff{header}\n{row}\n{row}\n")
    data = read_recording(path, RecordingNames(values="ch"))
    assert data.impedance.shape == (2, 40)
    assert np.array_equal(data.impedance[1], np.arange(40))
    assert data.protocol is None
    assert np.array_equal(data.reference, data.impedance[:1])
    assert (data.state == UNKNOWN_STATE).all()
    assert np.isnan(data.touch_reference).all()


@pytest.mark.parametrize("ending", [".mat", ".npz"])
def test_matrices_with_positions(tmp_path, ending):
    path = tmp_path / f"run{ending}"
    variables = {"down": PRESSED, "up": UNTOUCHED, "places": PLACES, "t": np.arange(3.0)}
    if ending == ".mat":
        savemat(path, variables)
    else:
        np.savez(path, **variables)
    data = read_recording(path, RecordingNames("down", "up", "places"))
    assert np.array_equal(data.impedance, PRESSED)
    assert np.array_equal(data.touch_reference, UNTOUCHED)
    assert np.array_equal(data.reference[0], UNTOUCHED.mean(axis=0))
    assert np.array_equal(data.touch_x[:, 0], np.float32(PLACES[:, 0]), equal_nan=True)
    assert np.array_equal(data.touch_y[:, 0], np.float32(PLACES[:, 1]), equal_nan=True)
    assert data.state.tolist() == [State.TOUCH, UNKNOWN_STATE, State.TOUCH]
    assert data.time.tolist() == [0.0, 1.0, 2.0]
    save_dataset(data, tmp_path / "set")
    assert np.array_equal(open_dataset(tmp_path / "set").impedance, data.impedance)


def test_openeit_lines_among_others(tmp_path):
    text = "hello\n\nmagnitudes : 1.5 , 2.5 , 3.5 , \nphases : 1, 2\nmagnitudes : 4, 5, 6\n"
    data = read_recording(write(tmp_path, "run.txt", text), protocol=Protocol.pairwise(3))
    assert np.array_equal(data.impedance, [[1.5, 2.5, 3.5], [4, 5, 6]])
    assert data.frame(0).impedance[2] == 3.5


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "v0,v1\n", r"header.*row"),
        ("a.csv", "v0,v1\n1\n", r"row 2.*2 cells.*1"),
        ("a.csv", "v0,v1\n1,x\n", r"row 2, column v1: .*'x'"),
        ("a.csv", "v0,v1\n1,nan\n", r"impedance.*finite.*frame 0"),
        ("a.csv", "v0,state\n1,sleep\n", r"'state'.*got 'sleep'$"),
        ("a.csv", f"v0,state\n1,{'z' * 9000}\n", r"'state'.{,120}z{90,} \.\.\.$"),
        ("a.csv", "v0,force\n1,much\n", "'force'"),
        ("a.csv", "v0,x\n1,0.1\n", r"touch_x.*touch_y"),
        ("a.csv", "v0,v1,x,y\n1,2,15,30\n1,2,135,\n", r"metres.*10 m.*15 to 135"),
        ("a.txt", "nothing\n", "header and at least one row"),
        ("a.txt", "magnitudes : 1, 2\nmagnitudes : 1\n", "row 2: expected 2 cells, got 1"),
        ("a.txt", "magnitudes : 1, oops\n", "row 1, column magnitudes1: .*'oops'"),
        ("a.mat", "MATLAB? no\n", "not a MATLAB file"),
        ("a.npz", "numpy? no\n", r"\.npz"),
    ],
)
def test_broken_files_are_refused(tmp_path, name, text, message):
    with pytest.raises(DataError, match=message):
        read_recording(write(tmp_path, name, text))


BOTH = {"down": PRESSED, "up": UNTOUCHED}
OBJECTS = np.array([{"a": 1}], dtype=object)  # pickled, so never loaded


@pytest.mark.parametrize(
    ("tables", "names", "error", "message"),
    [
        ({"v": OBJECTS}, ("v",), DataError, "plain arrays"),
        (BOTH, None, ConfigurationError, "holds down, up"),
        (BOTH, ("dwon",), ConfigurationError, "holds down, up"),
        (BOTH, ("down", "up", "places"), ConfigurationError, "positions"),
        ({"v": PRESSED, "r": UNTOUCHED[:2]}, ("v", "r"), DataError, "shape"),
        ({"v": PRESSED, "t": np.arange(2)}, ("v",), DataError, r"'t'.*3 frames"),
        ({"v": PRESSED, "p": PLACES[:2]}, ("v", None, "p"), DataError, r"'p'.*3 frames"),
        ({"v": PRESSED, "p": 1e3 * PLACES}, ("v", None, "p"), DataError, r"positions.*metres"),
    ],
)
def test_tables_that_do_not_fit_are_refused(tmp_path, tables, names, error, message):
    np.savez(tmp_path / "a.npz", **tables)
    with pytest.raises(error, match=message):
        read_recording(tmp_path / "a.npz", names and RecordingNames(*names))


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match=r"\.csv.*\.mat, \.npz.*\.txt"):
        read_recording(tmp_path / "a.xls")
    for ending in (".csv", ".mat", ".npz", ".txt"):
        with pytest.raises(DataError, match="no file"):
            read_recording(tmp_path / f"a{ending}")


def test_protocol_of_another_size_is_refused(tmp_path):
    path = write(tmp_path, "a.csv", "v0,v1\n1,2\n")
    with pytest.raises(DataError, match=r"28.*2 channels"):
        read_recording(path, protocol=Protocol.pairwise(8))


# Real recordings


def test_real_presses_on_a_hydrogel_skin():
    data = read_recording(
        real("ohmc8.mat"), RecordingNames("responsedowns", "responseups", "positions")
    )
    assert data.impedance.shape == (500, 32)
    assert (data.state == State.TOUCH).all()
    assert np.hypot(data.touch_x[:, 0], data.touch_y[:, 0]).max() < 0.08
    # The untouched sensor repeats itself from press to press, the pressed one does not.
    pressed, untouched = (
        np.median(np.abs(np.diff(values.real, axis=0)) / np.abs(values.real[1:]))
        for values in (data.impedance, data.touch_reference)
    )
    assert untouched < 0.005
    assert pressed > 5 * untouched


def test_real_openeit_frame():
    data = read_recording(real("openeit_background_8.txt"), protocol=Protocol.pairwise(8))
    assert data.impedance.shape == (1, 28)
    assert data.frame(0).impedance[0] == 27159.125
    assert data.frame(0).impedance[27] == 22775.6875


def documented(command):
    """Run a command of the guide in the folder of its designs, with the real recording."""
    words = shlex.split(command.replace("\\\n", " "))[1:]
    words[1] = str(real(words[1]))
    words[words.index("--out") + 1] = "set"
    ran = CliRunner().invoke(app, words, catch_exceptions=False)
    assert ran.exit_code == 0
    return open_dataset("set")


GUIDES = Path(__file__).parents[2] / "docs" / "guides"
COMMANDS = re.findall(
    r"^    (eitskin import [ok].*\n(?: {8}.*\n)*)",
    (GUIDES / "own-recordings.md").read_text().split("## Three public recordings")[1],
    re.MULTILINE,
)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.split()[2])
def test_documented_commands_import_the_real_recordings(command, tmp_path, monkeypatch):
    shutil.copytree(GUIDES / "recordings", tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    data = documented(command)
    found = (data.impedance.shape, data.protocol.n_electrodes, data.quantity)
    assert found in (
        ((500, 32), 8, "magnitude"),
        ((1, 2356), 32, "impedance"),
        ((1, 28), 8, "magnitude"),
    )
    if len(data) == 500:
        assert (
            np.unique(data.touch_depth[:, 0]).tolist() == np.float32([10e-3, 15e-3, 20e-3]).tolist()
        )
        assert np.abs(data.touch_x[:, 0] - 0.09).max() < 0.08


def test_the_round_skin_drives_facing_electrodes_in_both_directions():
    n, table = 8, []
    for k in range(n):
        drive = (k, (k + 4) % n)
        table += [(*drive, (j + 1) % n, j) for j in range(n) if not {*drive} & {j, (j + 1) % n}]
    folder = GUIDES / "recordings"
    assert Protocol.named(str(folder / "round-skin.csv"), n) == Protocol.from_rows(table, n)
    for k, electrode in enumerate(SensorDesign.from_toml(folder / "round-skin.toml").electrodes):
        turn = 2 * np.pi * k / n
        place = 0.090 + 0.085 * np.array([np.sin(turn), -np.cos(turn)])
        assert np.allclose((electrode.x, electrode.y), place, atol=1e-6)
    assert len(SensorDesign.from_toml(folder / "water-tank.toml").electrodes) == 32
