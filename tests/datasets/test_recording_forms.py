"""Recordings as people have them: kinds of files, arrangements of rows, units, labels, refusals."""

import numpy as np
import pytest
from scipy.io import savemat

from eitskin.datasets import Recording, RecordingForm, RecordingNames, State, read_recording
from eitskin.datasets.recordings import recorded_file
from eitskin.datasets.recordings.protocols import in_order
from eitskin.datasets.recordings.source import open_reader
from eitskin.errors import DataError
from eitskin.geometry import SensorDesign
from eitskin.simulator import ForwardModel, Protocol, Status

pytestmark = pytest.mark.usefixtures("reads_here")
PRESSED = np.arange(12.0).reshape(4, 3) + 100.0
UNTOUCHED = PRESSED - 1.0
X, Y = np.array([0.02, 0.05, 0.08, 0.11]), np.array([0.01, 0.02, 0.03, 0.04])


def csv_file(path, header, rows):
    path.write_text("\n".join(",".join(map(str, line)) for line in (header, *rows)) + "\n")


@pytest.mark.slow
@pytest.mark.parametrize(("package", "ending"), [("openpyxl", "xlsx"), ("pyarrow", "parquet")])
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, package, ending):
    monkeypatch.setitem(__import__("sys").modules, package, None)
    monkeypatch.setitem(__import__("sys").modules, f"{package}.parquet", None)
    with pytest.raises(ImportError, match=rf"{package}.*eitskin\[recordings\]"):
        open_reader(tmp_path / f"a.{ending}")


# Rows before and during a press


@pytest.mark.parametrize("order", ["before-during", "during-before"])
def test_rows_before_and_during_a_press_alternate(tmp_path, order):
    pairs = (UNTOUCHED, PRESSED) if order == "before-during" else (PRESSED, UNTOUCHED)
    rows = np.stack(pairs, axis=1).reshape(8, 3)
    np.savez(tmp_path / "a.npz", v=rows, p=np.stack([X, Y], axis=1))
    names = RecordingNames("v", positions="p")
    data = read_recording(tmp_path / "a.npz", names, form=RecordingForm(order))
    assert np.array_equal(data.impedance, PRESSED)
    assert np.array_equal(data.touch_reference, UNTOUCHED)
    assert np.allclose(data.reference, UNTOUCHED.mean(axis=0))
    assert np.array_equal(data.touch_x[:, 0], np.float32(X))


def test_readings_before_a_press_are_kept_as_idle_frames(tmp_path, monkeypatch):
    monkeypatch.setattr(recorded_file, "BLOCK_ROWS", 2)
    np.savez(tmp_path / "a.npz", v=PRESSED, r=UNTOUCHED, x=X, y=Y, session=[1, 1, 1, 2])
    form = RecordingForm(keep_before=True)
    data = read_recording(tmp_path / "a.npz", RecordingNames("v", "r"), form=form)
    assert data.state.tolist() == [State.IDLE, State.TOUCH] * 4
    assert np.array_equal(data.impedance[::2], UNTOUCHED)
    assert np.array_equal(data.touch_reference[1::2], UNTOUCHED)
    assert np.array_equal(data.touch_reference[2:6:2], UNTOUCHED[:2])
    assert np.isnan(data.touch_reference[[0, 6]]).all()  # nothing was read before
    assert np.isnan(data.touch_x[::2]).all()
    assert data.episode.tolist() == [1] * 6 + [2] * 2
    assert data.number.tolist() == list(range(8))


# Labels and units


def test_labels_have_places_units_several_touches_and_origins(tmp_path):
    np.savez(
        tmp_path / "a.npz",
        v=PRESSED,
        x=[[20, 50], [30, np.nan]] * 2,
        y=[[10, 40], [30, np.nan]] * 2,
        robot=np.tile([0.0, 12.0, 3.0], (4, 1)),
        grams=[100.0] * 4,
        board=[7, 7, 9, 9],
    )
    names = RecordingNames(
        "v",
        columns={"depth": "robot:2", "force": "grams*0.00981", "sensor": "board", "radius": "4e-3"},
    )
    data = read_recording(tmp_path / "a.npz", names, form=RecordingForm(length_unit="mm"))
    assert data.touch_count.tolist() == [2, 1, 2, 1]
    assert np.allclose(data.touch_x[0, :2], [0.02, 0.05])
    assert np.allclose(data.touch_depth[:, 0], 0.003)
    assert np.allclose(data.touch_force[:, 0], 0.981)
    assert np.isfinite(data.touch_radius).sum() == 6
    assert data.specimen_number.tolist() == [7, 9]
    form = RecordingForm(origin="centre")
    data = on_the_reference(tmp_path, [-0.07, 0.07], [-0.02, 0.02], form)
    assert np.allclose(data.touch_x[:, 0], [0.005, 0.145])
    assert np.allclose(data.touch_y[:, 0], [0.010, 0.050])
    for shape, hint in (
        ((2, 40), "40 channels.*such as adjacent:8"),
        ((8, 8), "0 on the diagonal"),
    ):
        np.savez(tmp_path / "a.npz", v=np.ones(shape))
        with pytest.raises(DataError, match=f"28 measurements.*{hint}"):
            read_recording(tmp_path / "a.npz", RecordingNames("v"), Protocol.pairwise(8))


@pytest.mark.slow
def test_patterns_of_a_file_make_the_protocol_and_divide_by_the_current(tmp_path):
    protocol = Protocol.from_rows([(0, 1, 1, 2), (0, 1, 2, 3), (2, 1, 1, 2), (2, 1, 2, 3)], 4)
    drive = np.array([[2.0, 0], [-2, -4], [0, 4], [0, 0]])
    sense = np.array([[0.0, 0], [1, 0], [-1, 1], [0, -1]])
    savemat(tmp_path / "a.mat", {"U": np.full((4, 1), 8.0), "I": drive, "M": sense, "s": {"a": 1}})
    names = RecordingNames("U", patterns=("I", "M"))
    data = read_recording(tmp_path / "a.mat", names, form=RecordingForm(transpose=True, scale=10))
    assert data.protocol == protocol
    assert np.array_equal(data.impedance, [[40, 40, 20, 20]])
    with pytest.raises(DataError, match="'s' is a MATLAB struct"):
        read_recording(tmp_path / "a.mat", RecordingNames("s"))
    np.savez(tmp_path / "a.npz", U=np.ones((1, 4)), I=np.ones((4, 2)), M=sense)
    with pytest.raises(DataError, match="drive patterns of one positive"):
        read_recording(tmp_path / "a.npz", names)


def on_the_reference(tmp_path, x, y, form=None):
    np.savez(tmp_path / "a.npz", v=np.ones((len(x), 28)), x=x, y=y)
    names, design = RecordingNames("v"), SensorDesign.reference()
    return read_recording(tmp_path / "a.npz", names, Protocol.pairwise(8), 40e3, design, form)


@pytest.mark.parametrize(
    ("x", "y", "form", "message"),
    [
        ([20, 130], [10, 50], RecordingForm(), r"on a sensor of 0.15 m.*10 to 130.*--length-unit"),
        ([-0.07, 0.07], [-0.02, 0.02], RecordingForm(), "--origin centre"),
        ([0.07, 0.2], [0.02, 0.02], RecordingForm(), r"1 of 2.*\(0.2, 0.02\) m$"),
        (np.linspace(0.02, 0.12, 12), [0.03] * 12, RecordingForm(length_unit="mm"), "lie within"),
    ],
)
def test_positions_of_other_units_and_beside_the_sensor_are_refused(tmp_path, x, y, form, message):
    with pytest.raises(DataError, match=message):
        on_the_reference(tmp_path, x, y, form)


@pytest.mark.slow
def test_several_files_are_sessions_of_one_recording(tmp_path):
    for day in (1, 2):
        csv_file(tmp_path / f"day{day}.csv", ["v0", "v1", "state"], [[day, 3, "idle"]] * 2)
    recording = Recording([tmp_path / "day1.csv", tmp_path / "day2.csv"])
    (first, second) = recording.parts()
    assert (first.episode.tolist(), second.episode.tolist()) == ([0, 0], [1, 1])
    assert second.number.tolist() == [2, 3]
    assert np.array_equal(second.reference, [[1.5, 3]])  # of the one sensor, on both days
    assert [name[-8:] for name in recording.sessions] == ["day1.csv", "day2.csv"]
    csv_file(tmp_path / "day3.csv", ["v0"], [[1]])
    with pytest.raises(DataError, match=r"day3.csv: expected 2 channels.*got 1"):
        Recording([tmp_path / "day1.csv", tmp_path / "day3.csv"])


# Refusals


@pytest.mark.slow
def test_lost_values_are_refused_marked_or_dropped(tmp_path):
    csv_file(tmp_path / "a.csv", ["v0", "v1"], [[1, 2], [3, ""], ["inf", 6], [7, 8]])
    with pytest.raises(DataError, match=r"channel 1 of frame 1.* 1 more frame;.*--bad-values mark"):
        read_recording(tmp_path / "a.csv")
    csv_file(tmp_path / "one.csv", ["v0", "v1"], [[1, 2], [3, ""]])
    with pytest.raises(DataError, match=r"channel 1 of frame 1 is empty or not finite; import"):
        read_recording(tmp_path / "one.csv")
    dropped = read_recording(tmp_path / "a.csv", form=RecordingForm(bad_values="drop"))
    assert dropped.impedance.tolist() == [[1, 2], [7, 8]]
    marked = read_recording(tmp_path / "a.csv", form=RecordingForm(bad_values="mark"))
    assert marked.impedance.tolist() == [[1, 2], [3, 0], [0, 6], [7, 8]]
    assert np.argwhere(marked.status == Status.NOT_FINITE).tolist() == [[1, 1], [2, 0]]


def test_a_column_may_be_called_a_number_of_5000_digits(tmp_path):
    (tmp_path / "a.csv").write_text(f"v{'9' * 5000},w\n1,2\n")
    assert read_recording(tmp_path / "a.csv", RecordingNames("w")).impedance.shape == (1, 1)


# Tables in the forms that loggers and boards write them


CELLS = [[-1.5, 2.25, 3, 4], [5, 6.5, 7, 8]]
LINES = "-1.5,2.25,3,4\n5,6.5,7,8\n"
NAMED = "v0,v1,v2,v3\n"


def test_rows_of_names_are_given_and_driven_readings_are_no_labels(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("w0,w1,w2,w3\nof,two,volt,meters\n" + NAMED + LINES)
    assert np.array_equal(read_recording(path, RecordingNames(header_row=3)).impedance, CELLS)
    (tmp_path / "a.csv").write_text((",".join(["1.5"] * 256) + "\n") * 2)
    with pytest.raises(DataError, match=r"adjacent:16\+driven"):
        read_recording(tmp_path / "a.csv", protocol=Protocol.adjacent(16))


# Complex values in columns of two parts


COMPLEX = np.array([[1 + 2j, -3 + 0.5j, -2j], [2 - 1j, 4, -1 + 1j]])


def written(path, first, second, values=COMPLEX, degrees=None, apart=False):
    """File with two columns for each value, beside each other or the second ones behind all."""
    parts = np.stack([values.real, values.imag], axis=-1)
    if degrees is not None:
        angle = np.angle(values, deg=degrees)
        parts = np.stack([np.abs(values), angle], axis=-1)
    names = [(first.format(k), second.format(k)) for k in range(values.shape[1])]
    columns = np.array([*zip(*names, strict=True)] if apart else [n for p in names for n in p])
    cells = parts.transpose(0, 2, 1) if apart else parts
    lines = [columns.ravel(), *cells.reshape(len(values), -1).astype(str)]
    path.write_text("\n".join(",".join(line) for line in lines))
    return path


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize(
    ("first", "second", "degrees"),
    [
        ("ch{}_Magnitude", "ch{}_Phase", True),
        ("RzMag{} [Ohm]", "RzPhase{} [deg]", True),
        ("abs({})", "arg({}) [rad]", False),
        ("amp{}", "phase{}_rad", False),
        ("v{}.re", "v{}.im", None),
        ("Real {}", "Imag {}", None),
        ("ch{} I [V]", "ch{} Q [V]", None),
        ("R{}", "X{}", None),
        ("mag_{}", "phase_{}", True),
        ("re{}", "im{}", None),
        ("Z{} (ohm)", "phi{} (deg)", True),
        ("|Z{}|", "arg(Z{}) [rad]", False),
    ],
)
def test_two_parts_are_joined_by_their_names(tmp_path, first, second, degrees, apart):
    path = written(tmp_path / "a.csv", first, second, degrees=degrees, apart=apart)
    assert np.allclose(read_recording(path).impedance, COMPLEX)


def test_parts_of_other_names_are_given(tmp_path):
    np.savez(
        tmp_path / "a.npz", u=COMPLEX.real, phi=COMPLEX.imag, w_im=COMPLEX.imag, w=COMPLEX.real
    )
    read = read_recording(tmp_path / "a.npz", RecordingNames("u,w_im"))
    assert np.allclose(read.impedance, COMPLEX)
    form = RecordingForm(phase_unit="rad")
    polar = read_recording(tmp_path / "a.npz", RecordingNames("u,phi"), form=form)
    assert np.allclose(polar.impedance, COMPLEX.real * np.exp(1j * COMPLEX.imag))


# Orders of the readings of a frame, by reciprocity and sums around loops


ADJACENT = Protocol.adjacent(8)


# Magnitudes have reciprocity alone; opposite drives have no reciprocal ones, but sums around loops.
@pytest.mark.parametrize(
    ("order", "protocol", "size"),
    [
        ("rotated", ADJACENT, np.abs),
        ("reversed", ADJACENT, np.abs),
        ("rotated", ADJACENT, np.asarray),
        ("sense-first", Protocol.opposite(8, shared=True), np.asarray),
    ],
)
def test_the_order_that_fits_the_laws_is_named(tmp_path, order, protocol, size):
    """A dead channel in the frame changes nothing."""
    root = np.random.default_rng(0).normal(size=(8, 8))
    other = in_order(protocol, order)
    frame = size(other.measure(root @ root.T))
    frame[5] = 0.0
    np.savez(tmp_path / "a.npz", v=frame[None])
    names, path = RecordingNames("v"), tmp_path / "a.npz"
    with pytest.raises(DataError, match=rf"0.00% in the order '{order}': .*--order {order}"):
        read_recording(path, names, protocol)
    assert read_recording(path, names, other).protocol == other
    for chosen, expected in (("given", protocol), (order, other)):
        form = RecordingForm(order=chosen)
        assert read_recording(path, names, protocol, form=form).protocol == expected


@pytest.mark.slow
def test_a_design_says_the_order_of_magnitudes_that_no_law_relates(tmp_path):
    text = "thickness = 0.005\noutline = { radius = 0.05 }\n[electrodes]\ncount = 16\n"
    (tmp_path / "round.toml").write_text(text)
    design, protocol = SensorDesign.from_toml(tmp_path / "round.toml"), Protocol.opposite(16)
    matrix = ForwardModel(design, "coarse").impedance()
    np.savez(tmp_path / "a.npz", v=np.abs(in_order(protocol, "rotated").measure(matrix))[None])
    names = RecordingNames("v")
    with pytest.raises(DataError, match="order 'rotated'"):
        read_recording(tmp_path / "a.npz", names, protocol, design=design)
    assert read_recording(tmp_path / "a.npz", names, protocol).protocol == protocol


# Times on the clocks that loggers have


def times_of(tmp_path, times, unit="", session=None, **names):
    rows = [f"1,2,{t},{session[i] if session else 0}" for i, t in enumerate(times)]
    (tmp_path / "a.csv").write_text("\n".join(["v0,v1,t,session", *rows]))
    form = RecordingForm(time_unit=unit)
    return read_recording(tmp_path / "a.csv", RecordingNames(**names), form=form).time


@pytest.mark.parametrize(
    ("times", "unit", "steps"),
    [
        ([1763906400000, 1763906400300, 1763906400600], "ms", [0.3, 0.3]),
        ([0, 60, 120], "s", [60, 60]),
        ([100, 400, 700], "us", [3e-4, 3e-4]),
        ([4294966.995, 4294967.295, 0.299, 0.599], "", [0.3] * 3),  # s of a wrapping millis()
        ([2**32 - 301, 2**32 - 1, 299, 599], "ms", [0.3] * 3),
        ([2**32 - 400001, 2**32 - 200001, 2**32 - 1, 199999], "us", [0.2] * 3),
        ([f"2026-11-23T14:0{minute}:00Z" for minute in range(3)], "", [60, 60]),
        ([f"23.11.2026 14:0{minute}:00" for minute in range(3)], "", [60, 60]),
        ([f"14:0{minute}:00:500" for minute in range(3)], "", [60, 60]),
        ([f'"2026-11-23 14:0{minute}:00,5"' for minute in range(3)], "", [60, 60]),
    ],
)
def test_clocks_go_on_in_seconds(tmp_path, monkeypatch, times, unit, steps):
    monkeypatch.setattr(recorded_file, "BLOCK_ROWS", 3 if len(times) > 3 else 2)
    assert np.allclose(np.diff(times_of(tmp_path, times, unit)), steps, atol=1e-6)


@pytest.mark.parametrize(
    ("times", "unit", "message"),
    [
        ([1763906400000, 1763906400300], "", "--time-unit ms"),
        ([1234, 1534, 1834], "", "--time-unit ms"),
        ([1000, 1020, 1040], "", "--time-unit ms"),
        (["11/23/2026 14:05:00"], "", "dates such as 2026-11-23T"),
        ([45983.5, 45983.500003], "", r"t=NAME\*86400"),
        ([0, 1, 2, 1], "", "backwards, from 2 to 1 s; .*--column session"),
        ([0, 1, 2, 1], "ms", "backwards"),
    ],
)
def test_times_that_cannot_be_seconds_are_refused(tmp_path, times, unit, message):
    with pytest.raises(DataError, match=message):
        times_of(tmp_path, times, unit)


def test_each_session_has_its_own_clock_and_a_factor_is_a_unit(tmp_path):
    assert times_of(tmp_path, [5, 6, 0, 1], session=[0, 0, 1, 1]).tolist() == [5, 6, 0, 1]
    assert np.allclose(times_of(tmp_path, [0, 40000], columns={"t": "t*0.001"}), [0, 40])
