"""Importing measured recordings: synthetic ones in every format, and real ones where present."""

import io
import os
import re
import shlex
import shutil
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import run
from scipy.io import savemat

from eitskin.datasets import (
    UNKNOWN_STATE,
    RecordingNames,
    State,
    open_dataset,
    read_recording,
)
from eitskin.errors import DataError
from eitskin.simulator import Protocol

DATA = Path(os.environ.get("EITSKIN_DATA", Path(__file__).parents[3] / "shared" / "data"))


def real(name):
    path = DATA / name
    if not path.is_file():
        pytest.skip(f"{path} is not there; set EITSKIN_DATA to the folder of real recordings")
    return path


PRESSED = np.arange(12.0).reshape(3, 4) + 100.0
CSV = """state, angle_deg, x, y, force, t, v0, v1, v2, r0, r1, r2
idle, 0, , , , 0.0, 1, 2+1j, 3, 10, 20, 30
touch, , 0.05, 0.02, 9, 0.5, 4, 5, 6, 11, 21, 31
, -5, , , , 1.0, 7, 8, 9, 12, 22, 32
"""


@pytest.mark.slow
def test_csv_with_everything(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(CSV, encoding="utf-8")
    data = read_recording(
        path,
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


# Real recordings


def documented(command):
    """Run a command of the guide in the folder of its designs, with the real recording."""
    words = shlex.split(command)[1:]
    words[1] = str(real(words[1]))
    words[words.index("--out") + 1] = "set"
    run(*words, code=0)
    return open_dataset("set")


GUIDES = Path(__file__).parents[2] / "docs" / "how-to"
COMMANDS = re.findall(
    r"^eitskin import [ok].*\n",
    (GUIDES / "import-recordings.md").read_text().split("## Three public recordings")[1],
    re.MULTILINE,
)


@pytest.mark.slow
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


# Recordings that were damaged, or made to do harm: each is one error


GOOD = np.arange(12.0).reshape(4, 3) + 1
NPY_HEADER = b"\x93NUMPY\x01\x00\x76\x00"


def npy(shape):
    """Header of a .npy file that claims a shape, and no values."""
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}}}".ljust(117) + "\n"
    return NPY_HEADER + text.encode()


def archive(path, content, flags=0):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("v.npy", content)
    if flags:
        raw = bytearray(path.read_bytes())
        for mark, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
            raw[raw.index(mark) + place] |= flags
        path.write_bytes(raw)


def saved(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def broken_mat(path):
    """MATLAB file whose table of bytes has a type that is none."""
    savemat(path, {"v": GOOD})
    raw = bytearray(path.read_bytes())
    raw[128:136] = b"\x0e\x00\x00\x00\xff\xff\xff\x7f"
    raw[144:152] = b"\xff" * 8
    path.write_bytes(raw)


def huge_hdf5(path):
    with h5py.File(path, "w") as file:
        file.create_dataset("v", (1 << 40, 8), "f8", chunks=(1 << 20, 8))


def looping_hdf5(path):
    with h5py.File(path, "w") as file:
        file["v"] = GOOD
        file["a"] = file["/"]


HOSTILE = {
    "encrypted.npz": lambda path: archive(path, saved(GOOD), flags=1),
    "claims.npz": lambda path: archive(path, npy((1 << 43, 1))),
    "negative.npz": lambda path: archive(path, npy((-1, 3))),
    "deep.npz": lambda path: archive(path, NPY_HEADER + b"(" * 117 + b"\n"),
    "line.csv": lambda path: path.write_text("v0\n" + "a" * 10_000_000),
    "bytes.mat": broken_mat,
    "nothing.mat": lambda path: path.write_bytes(b""),
    "huge.h5": huge_hdf5,
    "loop.h5": looping_hdf5,
    "zip.xlsx": lambda path: archive(path, b"x"),
    "rubbish.parquet": lambda path: path.write_bytes(b"PAR1" + b"\xff" * 100 + b"PAR1"),
    "pipe.csv": os.mkfifo,
    "folder.npz": os.mkdir,
}


@pytest.mark.slow
def test_each_is_one_short_error(tmp_path):
    for name, make in HOSTILE.items():
        path = tmp_path / name
        make(path)
        with pytest.raises(DataError) as refused:
            read_recording(path, RecordingNames("v"))
        said = str(refused.value)
        assert name in said
        assert len(said) < 500, name
