"""Refusals of datasets: what was asked, the error, and the words that name the key or remedy."""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest

from eitskin.datasets import RecordingNames, read_recording, touch_maps
from eitskin.datasets.recordings.labels import Place
from eitskin.datasets.store.schema import MAX_MAGNITUDES
from eitskin.errors import ConfigurationError, DataError
from eitskin.simulator import Protocol

from small_dataset import make

PRESSED = np.arange(12.0).reshape(3, 4) + 100.0
BOTH = {"down": PRESSED, "up": PRESSED + 1.0}
OBJECTS = np.array([{"a": 1}], dtype=object)  # pickled, so never loaded
PLACES = {"values": "v", "positions": "p"}
COMPLEX = {"u": np.ones((2, 3)), "phi": np.ones((2, 3)), "w": np.ones((2, 3))}
NAMED = "v0,v1,v2,v3\n"
FILES = {
    DataError: [
        ("a.csv", "v0,v1\n", {}, r"header.*row"),
        ("a.csv", "v0,v1\n1\n", {}, r"row 2.*2 cells.*1"),
        ("a.csv", "v0,v1\n1,x\n", {}, r"row 2, column v1: .*'x'"),
        ("a.csv", "v0,state\n1,sleep\n", {}, r"'state'.*got 'sleep'$"),
        ("a.csv", f"v0,state\n1,{'z' * 9000}\n", {}, r"'state'.{,120}z{90,} \.\.\.$"),
        ("a.csv", "v0,force\n1,much\n", {}, "'force'"),
        ("a.csv", "v0,x\n1,0.1\n", {}, r"touch_x.*touch_y"),
        ("a.txt", "nothing\n", {}, "header and at least one row"),
        ("a.txt", "magnitudes : 1, 2\nmagnitudes : 1\n", {}, "row 2: expected 2 cells, got 1"),
        ("a.mat", "MATLAB? no\n", {}, "not a MATLAB file"),
        ("a.npz", "numpy? no\n", {}, r"\.npz"),
        ("a.npz", None, {}, "no file"),
        ("a.npz", {"v": OBJECTS}, {"values": "v"}, "plain arrays"),
        (
            "a.npz",
            {"v": PRESSED, "r": PRESSED[:2]},
            {"values": "v", "touch_reference": "r"},
            "shape",
        ),
        ("a.npz", {"v": PRESSED, "t": np.arange(2)}, {"values": "v"}, r"'t'.*3 frames"),
        ("a.npz", {"v": PRESSED, "p": PRESSED[:2, :2]}, PLACES, r"'p'.*3 frames"),
        ("a.npz", {"v": PRESSED, "p": PRESSED[:, :2]}, PLACES, r"positions.*metres"),
        ("a.npz", COMPLEX, {"values": "u,phi"}, "--phase-unit"),
        ("a.csv", '""\n', {}, "got no row"),
        ("a.csv", NAMED + "1,2,3,4\n", {"header_row": 7}, "--header-row"),
        ("a.csv", NAMED + "1,2,3\n", {}, "'1,2,3'"),
        ("a.csv", "v0,v1,v3\n1,2,3", {}, "after v1 comes v3"),
        ("a.csv", "v0,v1\n0x1F,2", {}, "v0: .* hexadecimal"),
        ("a.csv", "0x1F,0x2A\n0x1F,0x2B", {}, "hexadecimal"),
        ("a.csv", "90,91,92,93\n1,-2,1,-1\n-1,2,2,1", {}, "with --differences"),
        ("a.csv", "0,1,2,4\n1,0,4,5\n2,4,0,6\n4,5,6,0", {}, "--protocol pairwise:4"),
        ("a.csv", "v0,v0\n3,4", {}, "'v0' more than once"),
        ("a.csv", "v0,F\n3,4", {"columns": {"force": "F:2"}}, "1 columns"),
        ("a.csv", "v0,F\n3,4000", {"columns": {"force": "F"}}, "grams"),
        ("a.csv", "v0,t\n3,", {}, "'t' must be finite"),
        ("a.csv", "v0,specimen\n3,a\n4,", {}, "empty cell"),
        ("a.csv", "v0,x,y,r\n3,.1,.1,20", {"columns": {"radius": "r"}}, "--length-unit"),
    ],
    ConfigurationError: [
        ("a.xls", None, {}, r"\.csv.*\.mat, \.npz.*\.txt"),
        ("a.npz", BOTH, {}, "holds down, up"),
        ("a.npz", BOTH, {"values": "dwon"}, "holds down, up"),
        ("a.npz", BOTH, {"values": "down", "positions": "places"}, "positions"),
        ("a.npz", COMPLEX, {"values": "u,w"}, r"magnitude,phase or real,imag"),
        ("a.csv", "ch0,ch1\n1,2\n", {}, "--values ch"),
        ("a.csv", "1,2\n3,4", {"values": "v"}, "holds c .*no header"),
        ("a.csv", "Volt0,Volt1\n3,4", {"values": "volt"}, "did you mean 'Volt'"),
        ("a.csv", "v0,F\n3,4", {"columns": {"forse": "F"}}, "mean 'force'"),
        ("a.csv", "v0,F\n3,4", {"columns": {"force": "G"}}, "holds v, F"),
    ],
}


@pytest.mark.parametrize(
    ("error", "name", "content", "names", "says"),
    [(error, *row) for error, rows in FILES.items() for row in rows],
)
@pytest.mark.usefixtures("reads_here")
def test_recordings_that_cannot_be_read_are_refused(tmp_path, error, name, content, names, says):
    path = tmp_path / name
    if isinstance(content, dict):
        np.savez(path, **content)
    elif content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(error, match=says):
        read_recording(path, RecordingNames(**names) if names else None)


def changed(**columns):
    return partial(dataclasses.replace, make(), **columns)


def twice(name):
    """A value beyond what can be in the last place of a column."""
    values = np.array(make().columns[name])
    values.flat[-1] = -1.1 * MAX_MAGNITUDES[name]
    return changed(**{name: values})


FACTORS = ("0", "-0.0", "1e-400", "1e400")
FREQUENCIES = (0.0, -1.0, math.nan, math.inf, 1e300)
CALLS = {
    DataError: [
        (changed(time=np.zeros(3)), r"time.*\(40,\)"),
        (changed(protocol=Protocol.pairwise(4)), "6 measurements, .* 28 channels"),
        (changed(source="guessed"), "source must be"),
        (changed(clamp_span=np.zeros(40)), "clamp_span must be .* got 0"),
        (changed(clamp_span=np.full(40, np.inf)), "clamp_span must be .* got inf"),
        (changed(clamp_offset=np.full(40, -np.inf)), "clamp_offset must be .* got -inf"),
        (changed(clamp_faces=np.full(40, 3.0)), "clamp_faces must be .* got 3"),
        (changed(clamp_stiffness=np.full(40, -1.4)), "clamp_stiffness must be .* got -1.4"),
        (changed(support_gap=np.full(40, -0.04)), "support_gap must be .* got -0.04"),
        *((twice(name), f"{name} must be at most .* in another unit") for name in MAX_MAGNITUDES),
        (lambda: touch_maps([[0.05]], [[0.02]], [[math.nan]]), "radius"),
    ],
    ConfigurationError: [
        (lambda: make().split((0.5, 0.2)), "sum to one"),
        *((partial(Place.from_text, f"x*{factor}"), "place of a label") for factor in FACTORS),
    ],
}


@pytest.mark.parametrize(
    ("error", "ask", "says"), [(error, *row) for error, rows in CALLS.items() for row in rows]
)
def test_what_cannot_be_is_refused_with_what_to_do(error, ask, says):
    with pytest.raises(error, match=says):
        ask()


@pytest.mark.parametrize("frequency", FREQUENCIES)
@pytest.mark.usefixtures("reads_here")
def test_frequencies_that_cannot_be_are_refused(tmp_path, frequency):
    (tmp_path / "a.csv").write_text("v0,v1,x\n1,2,3\n")
    with pytest.raises(ConfigurationError, match="frequency must be"):
        read_recording(tmp_path / "a.csv", RecordingNames("v"), frequency=frequency)
