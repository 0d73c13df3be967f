"""Forms in which people keep recordings, each imported by the command line: one truth in all.

`python tests/datasets/test_forms.py` prints the table of sources, commands and results.
"""

import json
import struct
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import csc_matrix

from eitskin.datasets import open_dataset
from eitskin.datasets.recordings.orders import in_order
from eitskin.protocol import Protocol

sys.path.append(str(Path(__file__).parent.parent / "support"))
import command_line

N = 8
RNG = np.random.default_rng(5)
ROOTS = RNG.normal(size=(3, N, N))
Z = ROOTS @ ROOTS.swapaxes(1, 2) * 10  # impedance matrices of three frames
ADJACENT, DRIVEN = Protocol.adjacent(N), Protocol.adjacent(N, shared=True)
FRAMES = ADJACENT.measure(Z)  # (3, 40)
SIXTEEN = RNG.normal(size=(2, 16, 16))
SIXTEEN = SIXTEEN @ SIXTEEN.swapaxes(1, 2)


class Form(NamedTuple):
    """Way to keep a recording.

    Attributes:
        source: in words.
        file: name of the file.
        write: of the path.
        options: of `eitskin import`.
        frames: that are expected.
        protocol: that is expected.
    """

    source: str
    file: str
    write: Callable[[Path], object]
    options: str = ""
    frames: np.ndarray = FRAMES
    protocol: Protocol | None = ADJACENT


def eidors(path):
    """Structures of EIDORS: a model with its stimulations, and readings with frames as columns."""
    stimulation = [
        {"stimulation": "Amp", "stim_pattern": csc_matrix(d[:, None]), "meas_pattern": csc_matrix(s)}
        for d, s in patterns()
    ]
    model = {"name": "tank", "type": "fwd_model", "stimulation": stimulation}
    data = {"type": "data", "meas": FRAMES.T * 0.01, "name": "simulated"}
    savemat(path, {"fmdl": model, "vi": data, "vh": {"meas": FRAMES[0] * 0.01}})


def patterns():
    """Currents of 10 mA into the electrodes, and weights of their voltages, for each drive pair."""
    for start in range(0, len(ADJACENT), N - 3):
        drive, sense = (p[:, start : start + N - 3] for p in ADJACENT.patterns())
        yield 0.01 * drive[:, 0], sense.T


def eidors_hdf5(path):
    """The same as MATLAB 7.3 stores it: structures as groups, sparse matrices by columns."""
    with h5py.File(path, "w", userblock_size=512) as file:
        drives, senses = [], []
        for number, (drive, sense) in enumerate(patterns()):
            for matrix, found in ((drive[:, None], drives), (sense, senses)):
                sparse, group = csc_matrix(matrix), file.create_group(f"#refs#/{number}{len(found)}{len(matrix)}")
                group.attrs["MATLAB_sparse"] = len(matrix)
                group["data"], group["ir"], group["jc"] = sparse.data, sparse.indices, sparse.indptr
                found.append(group.ref)
        for name, references in (("stim_pattern", drives), ("meas_pattern", senses)):
            file["fmdl/stimulation/" + name] = np.array(references, dtype=h5py.ref_dtype)[:, None]
        file["vi/meas"] = FRAMES * 0.01  # axes in reverse order
        file["vi/meas"].attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512))


def sciospec(folder):
    """A folder of frames of two frequencies, 18 lines of header, voltages against ground."""
    folder.mkdir()
    for number, matrix in enumerate(Z):
        lines = ["18", "2", "setup", "2023.01.05. 14:36:10.123", "1000", "50000", "0", "2", "0.001"]
        lines += ["10", "0", "1", "1", "1", "0", "1"]
        lines += ["MeasurementChannels: 1,2,3,4,5,6,7,8"]
        lines += ["MeasurementChannelsIndependentFromInjectionPattern: 1,2,3,4,5,6,7,8"]
        for k in range(N):
            volts = 0.001 * (matrix[:, k] - matrix[:, (k + 1) % N]) + 0.2
            lines.append(f"{k + 1} {(k + 1) % N + 1}")
            for factor in (1.0, 0.5):
                lines.append("\t".join(f"{factor * v:.9E}\t{0.0:.3E}" for v in volts))
        (folder / f"setup_{number:05}.eit").write_text("\n".join(lines) + "\n")


def draeger(path):
    text = b"---Draeger EIT-Software V1.30---\r\nFramerate [Hz]: 20\r\nFormat: 51\r\n"
    head = struct.pack("<3i", 51, 12 + len(text), 0) + text + b"**\r\n\r\n\r\n"
    frames = np.zeros((2, 5495), dtype=np.uint8)
    for number, values in enumerate(in_order(Protocol.adjacent(16), "rotated").measure(SIXTEEN)):
        doubles = np.zeros(600)
        doubles[0], doubles[2:210] = (7 + 0.05 * number) / 86400, values / 0.00098242 + 0.00019607
        doubles[324:532] = 0.00098242
        frames[number, :4800] = doubles.view(np.uint8)
    path.write_bytes(head + frames.tobytes())


def gimli(path):
    lines = [f"{N}# Number of electrodes", "# x z", *(f"{k}\t0" for k in range(N)), str(len(ADJACENT))]
    lines.append("# a b m n err k rhoa")
    for row, value in zip(ADJACENT.table, FRAMES[0], strict=True):
        lines.append("\t".join(map(str, (*(e + 1 for e in row), 0.03, 2.0, 2.0 * value))))
    path.write_text("\n".join([*lines, "0"]) + "\n")


def text(lines):
    return lambda path: path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def rows(frames=FRAMES, separator=",", form="{:.9g}"):
    return [separator.join(form.format(v) for v in frame) for frame in frames]


def names(prefix, count=len(ADJACENT), first=0, separator=","):
    return separator.join(f"{prefix}{k + first}" for k in range(count))


FORMS = [
    Form("EIDORS, MATLAB 5", "a.mat", eidors),
    Form("EIDORS, one reading named", "a.mat", eidors, "--values vh.meas", FRAMES[:1]),
    Form("EIDORS, MATLAB 7.3", "a.mat", eidors_hdf5),
    Form("Sciospec, a folder", "frames", sciospec),
    Form("Sciospec, second frequency", "frames", sciospec, "--values f1", FRAMES / 2),
    Form("Draeger PulmoVista", "a.eit", draeger, "", Protocol.adjacent(16).measure(SIXTEEN), Protocol.adjacent(16)),
    Form("Goe .get", "a.get", lambda p: p.write_bytes(Protocol.adjacent(16, shared=True).measure(SIXTEEN).astype("<f4").tobytes()), "", Protocol.adjacent(16).measure(SIXTEEN), Protocol.adjacent(16)),
    Form("pyGIMLi .dat", "a.dat", gimli, "", FRAMES[:1]),
    Form("OpenEIT text", "a.txt", text([f"magnitudes :   {r} ," for r in rows(separator=" , ")]), "--protocol adjacent:8"),
    Form("all pairs with the driven ones", "a.csv", text([names("v", 64), *rows(DRIVEN.measure(Z))]), "--protocol adjacent:8+driven"),
    Form("those in rotated order", "a.csv", text([names("v", 64), *rows(in_order(DRIVEN, "rotated").measure(Z))]), "--protocol adjacent:8+driven --order rotated"),
]  # fmt: skip


def imported(form: Form, folder: Path) -> list[str]:
    """Words of the command that imports the form's file, once it is written."""
    path = folder / form.file
    form.write(path)
    return ["import", str(path), "--out", str(folder / "out"), *form.options.split()]


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.source)
def test_every_form_gives_the_same_frames(form, tmp_path):
    command_line.run(*imported(form, tmp_path))
    data = open_dataset(tmp_path / "out")
    back = dict(zip(data.protocol.table, range(len(data.protocol)), strict=True))
    order = [back[row] for row in form.protocol.table]
    assert data.impedance[:, order] == pytest.approx(form.frames, rel=1e-4, abs=1e-4)
