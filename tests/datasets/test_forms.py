"""Forms in which people keep recordings, each imported by the command line: one truth in all."""

import json
import shlex
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import command_line
import h5py
import numpy as np
import pandas
import pytest
from scipy.io import savemat
from scipy.sparse import csc_matrix

from eitskin.datasets import State, open_dataset, read_recording
from eitskin.datasets.recordings.protocols import in_order
from eitskin.errors import DataError
from eitskin.simulator import Protocol

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("reads_here")]
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
        {
            "stimulation": "Amp",
            "stim_pattern": csc_matrix(d[:, None]),
            "meas_pattern": csc_matrix(s),
        }
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


def pattern_tables(path):
    """Currents of 2.5 mA, weights of voltages, and frames of all pairs of both as columns."""
    drive, sense = (
        DRIVEN.patterns()[k][:, rows] for k, rows in enumerate((slice(0, 64, 8), range(8)))
    )
    savemat(path, {"Mpat": sense, "Inj": 2.5e-3 * drive, "U": 2.5e-3 * DRIVEN.measure(Z).T})


def eidors_hdf5(path):
    """The same as MATLAB 7.3 stores it: structures as groups, sparse matrices by columns."""
    with h5py.File(path, "w", userblock_size=512) as file:
        drives, senses = [], []
        for number, (drive, sense) in enumerate(patterns()):
            for matrix, found in ((drive[:, None], drives), (sense, senses)):
                sparse, group = (
                    csc_matrix(matrix),
                    file.create_group(f"#refs#/{number}{len(found)}{len(matrix)}"),
                )
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
        doubles[2:210] = values / 0.00098242 + 0.00019607
        doubles[324:532] = 0.00098242
        frames[number, :4800] = doubles.view(np.uint8)
    path.write_bytes(head + frames.tobytes())


def gimli(path):
    lines = [
        f"{N}# Number of electrodes",
        "# x z",
        *(f"{k}\t0" for k in range(N)),
        str(len(ADJACENT)),
    ]
    lines.append("# a b m n err k rhoa")
    for row, value in zip(ADJACENT.table, FRAMES[0], strict=True):
        lines.append("\t".join(map(str, (*(e + 1 for e in row), 0.03, 2.0, 2.0 * value))))
    path.write_text("\n".join([*lines, "0"]) + "\n")


def text(lines):
    return lambda path: path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def rows(frames=FRAMES, separator=",", form="{:.9g}"):
    return [separator.join(form.format(v) for v in frame) for frame in frames]


def names(prefix, count, first=0, separator=","):
    return separator.join(f"{prefix}{k + first}" for k in range(count))


def arrays(path):
    """HDF5 with things that are no readings beside them: a link elsewhere, and references."""
    with h5py.File(path, "w") as file:
        file["v"], file["who"] = FRAMES, ["gel A", "gel A", "gel B"]
        file["elsewhere"] = h5py.ExternalLink("secrets.h5", "/")
        file["things"] = np.array([file["v"].ref], dtype=h5py.ref_dtype)


def parquet(path):
    pytest.importorskip("pyarrow")
    pandas.DataFrame({"v": FRAMES.tolist(), "who": ["gel A", "gel A", "gel B"]}).to_parquet(path)


def numbered(frames=FRAMES, prefix="v", separator=",", form="{:.9g}", extra=("", ())):
    """Lines of a table of numbered columns, with the name and cells of one before them."""
    before, cells = extra
    lines = [names(prefix, frames.shape[1], separator=separator), *rows(frames, separator, form)]
    if not before:
        return lines
    return [f"{a}{separator}{b}" for a, b in zip((before, *cells), lines, strict=True)]


def excel(path, *pages):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.remove(book.active)
    for number, lines in enumerate(pages):
        page = book.create_sheet(f"page{number}")
        for line in lines:
            cells = line.split(",")
            page.append([float(c) if c[:1] in "-0123456789" else c for c in cells])
    book.save(path)


def long_rows(frames):
    """A line for each reading, with the frame's number."""
    lines = (f"{k},{value:.9g}" for k, frame in enumerate(frames) for value in frame)
    return ["frame,value", *lines]


COMPLEX = FRAMES * np.exp(0.3j)
NAMED = [f"E{a + 1}_E{b + 1}_E{c + 1}_E{d + 1}" for a, b, c, d in ADJACENT.table]
GERMAN = [line.replace(".", ",") for line in numbered(separator=";")]
PAIRS = Protocol.pairwise(N)
PAIRED = PAIRS.measure(Z)
OWN = np.diagonal(Z, axis1=1, axis2=2)
BETWEEN_ALL = OWN[:, None] + OWN[:, :, None] - 2 * Z  # resistances (3, N, N) between electrodes
BASELINES = np.stack([FRAMES[0], FRAMES[0], 1.01 * FRAMES[0], 1.01 * FRAMES[0]])
CHANGES = np.array([0, 1, 0, -2])[:, None] * 0.02 * FRAMES[1]
BETWEEN = ";".join(["Zeit [s]", *(f"Z{a + 1}-{b + 1}" for a, b, *_ in PAIRS.table)])
KOHM = ",".join(f"R_{a}_{b}_kohm" for a, b, *_ in PAIRS.table)
LATIN = [BETWEEN, *(f"0,{k};{r}".replace(".", ",") for k, r in enumerate(rows(PAIRED, ";")))]
S16 = Protocol.adjacent(16)
RAW16 = Protocol.adjacent(16, shared=True).measure(SIXTEEN)
P8 = "--protocol adjacent:8"
PLAIN = numbered()
UNITS = ",".join(f"v{k} [ohm]" for k in range(40))
PLACES = ["x,y", *["0.1,0.2"] * 3]
FORMS = [
    Form("EIDORS, MATLAB 5", "a.mat", eidors),
    Form("EIDORS, one reading named", "a.mat", eidors, "--values vh.meas", FRAMES[:1]),
    Form("EIDORS, MATLAB 7.3", "a.mat", eidors_hdf5),
    Form("patterns and voltages, MATLAB", "a.mat", pattern_tables, "", DRIVEN.measure(Z), DRIVEN),
    Form("Sciospec, a folder of frames", "frames", sciospec),
    Form("Sciospec, the second frequency", "frames", sciospec, "--values f1", FRAMES / 2),
    Form("Draeger PulmoVista", "a.eit", draeger, "", S16.measure(SIXTEEN), S16),
    Form("Goe", "a.get", lambda p: RAW16.astype("<f4").tofile(p), "", S16.measure(SIXTEEN), S16),
    Form("pyGIMLi", "a.dat", gimli, "", FRAMES[:1]),
    Form("OpenEIT", "a.txt", text([f"magnitudes :   {r} ," for r in rows()]), P8),
    Form("8 x 8, driven pairs, too", "a.csv", text(numbered(DRIVEN.measure(Z))), P8 + "+driven"),
    Form("the same, rotated", "a.csv", text(numbered(in_order(DRIVEN, "rotated").measure(Z))),
         P8 + "+driven --order rotated"),
    Form("table, v0 ...", "a.csv", text(PLAIN), P8),
    Form("table, v1 ...", "a.tsv", text([names("v", 40, 1, "\t"), *rows(separator="\t")]), P8),
    Form("other names", "a.csv", text(numbered(prefix="ch")), P8),
    Form("decimal commas, semicolons", "a.csv", text(GERMAN), P8),
    Form("decimal commas, tabs", "a.txt", text([g.replace(";", "\t") for g in GERMAN]), P8),
    Form("decimal commas, blanks", "a.txt", text([g.replace(";", "  ") for g in GERMAN]), P8),
    Form("preamble", "a.csv", text(["UTC:,2026-03-01", "gain,4", "", *PLAIN]), P8),
    Form("separators behind rows", "a.csv", text([f"{line}, " for line in PLAIN]), P8),
    Form("brackets, no names", "a.txt", text([f"[{r}]," for r in rows()]), P8),
    Form("no names", "a.csv", text(rows()), P8),
    Form("no names, times first", "a.csv", text([f"{k}.5,{r}" for k, r in enumerate(rows())]), P8),
    Form("byte order mark", "a.csv", text(["\ufeff" + PLAIN[0], *rows()]), P8),
    Form("units in the names", "a.csv", text([UNITS, *rows()]), P8),
    Form("units below the names", "a.csv", text([PLAIN[0], ",".join(["ohm"] * 40), *rows()]), P8),
    Form("first to last column", "a.csv", text([",".join(map("n{}x".format, range(40))), *rows()]),
         P8 + " --values n0x..n39x"),
    Form("names of electrodes from 1", "a.csv", text([",".join(NAMED), *rows()])),
    Form("Latin-1, names of pairs from 1", "a.csv",
         lambda p: p.write_text("\n".join(["Gerät 3", *LATIN]), "latin-1"), "", PAIRED, PAIRS),
    Form("UTF-16, names of pairs from 0, kohm", "a.csv",
         lambda p: p.write_text("\n".join([KOHM, *rows(PAIRED / 1e3)]), "utf-16"), "",
         PAIRED, PAIRS),
    Form("pandas, columns and rows named by numbers", "a.csv",
         text(["," + names("", 40), *(f"{k},{r}" for k, r in enumerate(rows()))]), P8),
    Form("no names, words first", "a.csv", text([f"idle,{r}" for r in rows()]), P8),
    Form("complex as MATLAB prints it", "a.csv", text([PLAIN[0],
         *(",".join(f"{z.real:.9g}{z.imag:+.9g}i" for z in f) for f in COMPLEX)]), P8, COMPLEX),
    Form("a drive pair's readings a row", "a.csv", text([names("v", N - 3),
         *rows(FRAMES.reshape(-1, N - 3))]), P8),
    Form("a reading a row", "a.csv", text(long_rows(FRAMES)), P8 + " --values value"),
    Form("JSON, an object a line", "a.jsonl", text([json.dumps({"t": k, "v": f.tolist()})
         for k, f in enumerate(FRAMES)]), P8),
    Form("JSON, an array of objects", "a.json", lambda p: p.write_text(json.dumps(
         [{"v": f.tolist()} for f in FRAMES])), P8),
    Form("NumPy, one array", "a.npy", lambda p: np.save(p, FRAMES), P8),
    Form("differences and baselines", "a.npz", lambda p: np.savez(p, d=FRAMES - FRAMES[0],
         b=np.tile(FRAMES[0], (3, 1))), P8 + " --values d --touch-reference b --differences"),
    Form("baselines among differences", "a.csv",
         text(rows(np.where(CHANGES.any(axis=1, keepdims=True), CHANGES, BASELINES))),
         P8 + " --differences", BASELINES + CHANGES),
    Form("rows of matrices between electrodes", "a.csv", text(rows(BETWEEN_ALL.reshape(-1, N))),
         "--protocol pairwise:8", PAIRED, PAIRS),
    Form("upper halves of such matrices", "a.npy", lambda p: np.save(p, np.triu(BETWEEN_ALL)),
         "--protocol pairwise:8", PAIRED, PAIRS),
    Form("names below units", "a.csv", text([",".join(["ohm"] * 40), *PLAIN]), P8),
    Form("bars, below 30 lines", "a.csv",
         text([*["a logger"] * 30, *(line.replace(",", "|") for line in PLAIN)]), P8),
    Form("lines of a terminal", "a.txt", text([f"14:05:00.12 -> ({r})," for r in rows()]), P8),
    Form("remarks behind rows", "a.csv", text([PLAIN[0], *(f"{r} # dry" for r in rows())]), P8),
    Form("UTF-16 without a mark", "a.csv",
         lambda p: p.write_text("\n".join(PLAIN), "utf-16-le"), P8),
    Form("lines of a logger", "a.log",
         text([f"2026-11-23 14:00:00,1 INFO values: {r}" for r in rows()]), P8),
    Form("lines and cells that are lost", "a.log",
         text(["PuTTY", rows()[0][30:], *rows(), "OL," + rows()[0].partition(",")[2], "1,2"]),
         P8 + " --bad-values drop"),
    Form("Fortran's exponents", "a.csv",
         text([PLAIN[0], *(r.replace("e", "D") for r in rows(form="{:.9e}"))]), P8),
    Form("frames as columns of a table", "a.csv", text(rows(FRAMES.T)), P8 + " --transpose"),
    Form("electrodes in each row", "a.csv", text(["A,B,M,N,R", *(
         ",".join(map(str, (*(e + 1 for e in row), value)))
         for f in FRAMES for row, value in zip(ADJACENT.table, f, strict=True))])),
    Form("kohm behind a slash", "a.csv",
         text([",".join(f"Z[{k}] / kOhm" for k in range(40)), *rows(FRAMES / 1e3)]), P8),
    Form("Z' and -Z''", "a.csv", text([",".join(f"Z'{k},-Z''{k}" for k in range(40)),
         *(",".join(f"{z.real:.9g},{-z.imag:.9g}" for z in f) for f in COMPLEX)]), P8, COMPLEX),
    Form("JSON in columns", "a.json",
         lambda p: p.write_text(json.dumps({"t": [0, 1, 2], "v": FRAMES.tolist()})), P8),
    Form("JSON, frames in an object", "a.json", lambda p: p.write_text(json.dumps({"frames": [
         {"mag": abs(f).tolist(), "phase": np.degrees(np.angle(f)).tolist()} for f in COMPLEX]})),
         P8, COMPLEX),
    Form("NumPy, drives by senses", "a.npy", lambda p: np.save(p, FRAMES.reshape(3, 8, 5)), P8),
    Form("MATLAB, a structure a frame", "a.mat",
         lambda p: savemat(p, {"r": np.array([(f,) for f in FRAMES], [("v", "O")])}),
         P8 + " --values r.v"),
    Form("MATLAB, a cell a frame", "a.mat",
         lambda p: savemat(p, {"c": np.array([*FRAMES, None], object)[:3]}), P8 + " --values c"),
    Form("HDF5", "a.h5", arrays, P8 + " --values v --column specimen=who"),
    Form("Parquet, a list a frame", "a.parquet", parquet,
         P8 + " --values v --column specimen=who"),
    Form("Excel, positions on page 2", "a.xlsx", lambda p: excel(p, PLAIN, PLACES),
         P8 + " --sheet page0,page1"),
]  # fmt: skip


def imported(form: Form, folder: Path) -> list[str]:
    """Words of the command that imports the form's file, once it is written."""
    path = folder / form.file
    form.write(path)
    return ["import", str(path), "--out", str(folder / "out"), *form.options.split()]


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.source)
def test_every_form_gives_the_same_frames(form, tmp_path):
    words = imported(form, tmp_path)
    ran = command_line.run(*words)
    data = open_dataset(tmp_path / "out")
    assert len(data.protocol) == len(form.protocol)
    back = dict(zip(data.protocol.table, range(len(data.protocol)), strict=True))
    order = [back[row] for row in form.protocol.table]
    assert data.impedance[:, order] == pytest.approx(form.frames, rel=1e-4, abs=1e-4)
    # With -s, the rows of a table of all forms.
    command = shlex.join(["eitskin", *words]).replace(f"{tmp_path}/", "")
    print(f"| {form.source} | `{command}` | {ran.stdout.split(' (')[0]}, as written |")  # noqa: T201


def test_previews_print_the_command_that_reads_the_same_and_suggest_labels(tmp_path):
    """And writes nothing; without a protocol it names those that fit."""
    times = np.arange(3) * 0.1
    text(numbered(prefix="ch", extra=("time", times.tolist())))(tmp_path / "a.csv")
    words = ["import", str(tmp_path / "a.csv"), "--preview", "--column", "t=time"]
    said = command_line.printed_json(*words, "--protocol", "adjacent:8")
    assert "adjacent:8" in said["protocol"]
    assert "0.00%" in said["order"]
    assert said["labels"] == "t = time"
    again = shlex.split(said["command"])
    assert again[:1] == ["eitskin"]
    assert again[-1] == "FOLDER"
    command_line.run(*again[1:-1], str(tmp_path / "out"))
    data = open_dataset(tmp_path / "out")
    assert data.impedance == pytest.approx(FRAMES, rel=1e-4, abs=1e-4)
    assert data.time == pytest.approx(times)
    said = command_line.printed_json(*words, "--values", "ch")
    assert "adjacent:8" in said["protocol"]
    assert said["protocol"].startswith("unknown")
    # The command that it prints imports them; other words for the states are read, too.
    columns = ("Timestamp (ms)", [0, 100, 200]), ("Label", ["none", "pressed", "bent"])
    places = (("PosX [mm]", ["", 20, ""]), ("pos_y [mm]", ["", 30, ""]))
    rows = numbered(prefix="ch")
    for name, values in (*columns, *places):
        cells = [name, *map(str, values)]
        rows = [f"{cell},{row}" for cell, row in zip(cells, rows, strict=True)]
    text(rows)(tmp_path / "a.csv")
    said = command_line.printed_json("import", str(tmp_path / "a.csv"), "--preview")
    again = shlex.split(said["command"])
    command_line.run(*again[1:-1], str(tmp_path / "labelled"))
    data = open_dataset(tmp_path / "labelled")
    assert data.time == pytest.approx([0, 0.1, 0.2])
    assert data.state.tolist() == [State.IDLE, State.TOUCH, State.BEND]
    assert (data.touch_x[1, 0], data.touch_y[1, 0]) == pytest.approx((0.02, 0.03))


def test_a_protocol_that_is_not_that_of_the_names_is_refused(tmp_path):
    text([",".join(NAMED), *rows()])(tmp_path / "a.csv")
    other = Protocol.from_rows(ADJACENT.table[::-1], N)
    with pytest.raises(DataError, match=r"measurement 0 .* leave --protocol out"):
        read_recording(tmp_path / "a.csv", protocol=other)
