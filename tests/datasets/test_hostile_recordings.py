"""Recordings that were damaged, or made to do harm: each is one error."""

import io
import os
import zipfile

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from eitskin.datasets import RecordingNames, read_recording
from eitskin.errors import DataError

GOOD = np.arange(12.0).reshape(4, 3) + 1
HEADER = b"\x93NUMPY\x01\x00\x76\x00"


def npy(shape):
    """Header of a .npy file that claims a shape, and no values."""
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}}}".ljust(117) + "\n"
    return HEADER + text.encode()


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
    "deep.npz": lambda path: archive(path, HEADER + b"(" * 117 + b"\n"),
    "cell.csv": lambda path: path.write_text(f"v0,v1\n1,{'2' * 131_073}\n"),
    "line.csv": lambda path: path.write_text("v0\n" + "a" * 10_000_000),
    "nul.csv": lambda path: path.write_bytes(b"v0,v1\n1,\0\n"),
    "latin.csv": lambda path: path.write_bytes(b"v0,v1\n\xff,1\n"),
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
