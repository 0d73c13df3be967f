"""Reports of evaluations, and the scores in them."""

import dataclasses
import json
import sys
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import linear_sum_assignment
from touched_dataset import touched_dataset

from eitskin.datasets import State, touch_maps
from eitskin.errors import ConfigurationError, DataError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol
from eitskin.training import (
    FoundTouches,
    InputSpec,
    Method,
    Observations,
    Pipeline,
    Predictions,
    Targets,
    TrainingSettings,
)
from eitskin.training.evaluation import report as report_folder
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.report import (
    PICTURES,
    require_report_folder,
    write_report,
)
from eitskin.training.evaluation.scores import (
    GATE,
    consistency,
    determination,
    match_distances,
    ospa,
    similarity,
)

FLAT = np.linspace(400.0, 820.0, 28)
NAN = float("nan")


@dataclasses.dataclass
class Told(Method):
    """A method that says what it was told to, whatever it is shown."""

    targets: ClassVar[Targets] = Targets()
    fit = from_arrays = arrays = None
    says: Predictions

    def predict(self, observations):
        if len(observations) == len(self.says.touches):
            return self.says
        return chosen(self.says, range(len(observations)))


def chosen(said, order):
    """Predictions of some frames, in an order."""
    taken = {}
    for each in dataclasses.fields(said):
        values = getattr(said, each.name)
        plain = isinstance(values, tuple)
        taken[each.name] = tuple(values[i] for i in order) if plain else values[list(order)]
    return Predictions(**taken)


# State, angle and places [mm]; what is said: angle, its deviation, places, forces, deviations.
FRAMES = [
    (State.IDLE, 0.0, [], 0.5, 1.0, [], [], []),
    (State.IDLE, 0.0, [], 0.0, 1.0, [(20, 20)], [3.0], [1.0]),
    (State.BEND, 10.0, [], 12.0, 1.0, [], [], []),
    (State.BEND, -10.0, [], -11.0, 1.0, [], [], []),
    (State.TOUCH, 0.0, [(30, 30)], 1.0, 2.0, [(33, 34)], [9.0], [4.0]),
    (State.TOUCH, 20.0, [(30, 30), (90, 30)], 23.0, NAN, [(30, 31), (60, 30)], [12, 1], [2, 1]),
    (State.TOUCH, -20.0, [(75, 30)], -20.0, NAN, [], [], []),
]
SAID = [State.IDLE, State.TOUCH, State.BEND, State.BEND, State.TOUCH, State.TOUCH, State.BEND]


def discs(places):
    """A touch map that is exactly the truth."""
    xy = np.array(places, float).reshape(-1, 2).T[:, None] * 1e-3
    return touch_maps(xy[0], xy[1], np.full(xy[0].shape, 0.0075))[0]


def structural_similarity(a, b):
    """SSIM of pictures (rows, columns) from 0 to 1, written out (Wang et al. 2004)."""
    a, b = (sliding_window_view(each, (7, 7)).reshape(-1, 49) for each in (a, b))
    ma, mb = a.mean(axis=1), b.mean(axis=1)
    covariance = ((a - ma[:, None]) * (b - mb[:, None])).sum(axis=1) / 48
    variances = a.var(axis=1, ddof=1) + b.var(axis=1, ddof=1)
    alike = (2 * ma * mb + 1e-4) * (2 * covariance + 9e-4)
    return (alike / ((ma**2 + mb**2 + 1e-4) * (variances + 9e-4))).mean()


def perceived():
    return Predictions(
        np.eye(3)[SAID],
        np.array([frame[3] for frame in FRAMES]),
        np.array([frame[4] for frame in FRAMES]),
        np.array([discs(frame[2]) for frame in FRAMES]),
        tuple(
            FoundTouches.from_arrays(
                1e-3 * np.array(places, float).reshape(-1, 2),
                np.linspace(0.9, 0.8, len(places)),
                forces,
                1e-3 * np.array(deviations),
            )
            if places
            else FoundTouches.from_arrays((), ())
            for *_, places, forces, deviations in FRAMES
        ),
        ((),) * len(FRAMES),
    )


def frames(**changes):
    values = np.tile(FLAT, (len(FRAMES), 1))
    there = np.array([np.arange(4) < len(frame[2]) for frame in FRAMES])
    known = {
        "touch_reference": values,
        "state": [frame[0] for frame in FRAMES],
        "bend_angle_deg": [frame[1] for frame in FRAMES],
        "touch_radius": np.where(there, 0.0075, np.nan),
        "touch_force": np.where(there, 10.0, np.nan),
        "protocol": Protocol.pairwise(8),
        "design": SensorDesign.reference(),
        "recipe": 'name = "by hand"\n',
        "source": "simulated",
    }
    places = [1e-3 * np.array(frame[2], float) for frame in FRAMES]
    return touched_dataset(values, FLAT, places, **known | changes)


def pipeline(says):
    data = frames()
    return Pipeline(
        InputSpec(data.design, data.protocol, data.frequency, FLAT),
        Told(says),
        1e-4,
        TrainingSettings(seed=5),
        {"sha256": "0" * 64, "frames": 3, "source": "simulated"},
        Observations.from_dataset(data.select([0])),
    )


@pytest.fixture(scope="module")
def evaluation():
    return Evaluation.from_dataset(pipeline(perceived()), frames())


def test_scores(evaluation):
    """Bends: errors 2, -1; touched 1, 3, 0; with a deviation 0.5/1, 0/1, 2/1, -1/1, 1/2.

    Matched: 5 mm off with deviation 4, 1 mm off with deviation 2; two missed, one false.
    """
    states, bend = evaluation.report.states, evaluation.report.bend
    assert states.accuracy == {"idle": 0.5, "touch": pytest.approx(2 / 3), "bend": 1.0}
    assert states.bent_touch_accuracy == states.idle_as_touch == 0.5
    assert states.confusion == [[1, 1, 0], [0, 2, 1], [0, 0, 2]]
    assert bend.rmse_deg == pytest.approx(np.sqrt(5 / 2))
    assert bend.bias_deg == pytest.approx(0.5)
    assert bend.r2 == pytest.approx(1 - 5 / 200)
    assert bend.touched_rmse_deg == pytest.approx(np.sqrt(10 / 3))
    assert bend.touched_bias_deg == pytest.approx(4 / 3)
    assert bend.calibration.count == 5
    assert bend.calibration.rms_ratio == pytest.approx(np.sqrt((0.25 + 0 + 4 + 1 + 0.25) / 5))
    assert bend.calibration.within_one == pytest.approx(4 / 5)
    touches = evaluation.report.touches
    assert set(touches) == {"1", "2", "several", "bent"}
    one, two, bent = touches["1"], touches["2"], touches["bent"]
    assert (one.frames, one.found, one.false_per_touch) == (2, 0.5, 0.0)
    assert (one.mean_error_mm, one.deviation_mm) == (pytest.approx(5.0), pytest.approx(0.0))
    assert (two.frames, two.found, two.false_per_touch) == (1, 0.5, 0.5)
    assert two.mean_error_mm == pytest.approx(1.0)
    first, second = (np.array(places) for _, _, places, *_ in FRAMES if len(places) == 1)
    assert one.guess_error_mm == pytest.approx(np.linalg.norm(first - second) / 2, rel=1e-5)
    assert two == touches["several"]
    assert (bent.frames, bent.found) == (2, pytest.approx(1 / 3))
    assert one.ssim["touch_map"] == pytest.approx(1.0)
    truth = [discs(frame[2]) for frame in FRAMES if len(frame[2]) == 1]
    empty = np.mean([structural_similarity(np.zeros_like(t), t) for t in truth])
    assert one.ssim["empty"] == pytest.approx(empty)
    place = evaluation.report.place_calibration
    assert (place.count, place.within_one) == (2, 0.5)
    assert place.rms_ratio == pytest.approx(np.sqrt((1.25**2 + 0.25) / 2), rel=1e-5)
    untouched, force = evaluation.report.untouched, evaluation.report.force
    assert (untouched.frames, untouched.touched, untouched.touches) == (4, 0.25, 1)
    assert dataclasses.astuple(force) == pytest.approx((2, 1.5, 0.5))


@pytest.mark.slow
def test_folder_holds_what_there_is_to_show_and_says_what_not(evaluation, tmp_path):
    folder = write_report(evaluation, tmp_path / "a" / "report", {"machine": "an abacus"})
    document = json.loads((folder / "report.json").read_text())
    shown, left_out = set(document["pictures"]), set(document["left_out"])
    assert shown | left_out == set(PICTURES)
    assert left_out == {"training_curves.png", "bend_sequence.png", "touch_maps_counts.png"}
    assert {path.name for path in folder.iterdir()} == {*shown, "report.json", "report.md"}
    assert all((folder / name).stat().st_size > 10_000 for name in shown)
    assert document["report"] == evaluation.report.as_dict()
    assert document["provenance"]["machine"] == "an abacus"
    assert document["provenance"]["training seed"] == "5"
    text = (folder / "report.md").read_text()
    assert all(f"]({name})" in text for name in shown)
    assert all(f"- {name}: {document['left_out'][name]}" in text for name in left_out)
    assert "| force of a touch: error | - | 1.50 N (bias +0.50) |" in text
    assert "structural_similarity" in text
    assert 'name = "by hand"' in text


@pytest.mark.slow
def test_an_earlier_report_is_replaced_whole(evaluation, tmp_path, monkeypatch):
    names = ("confusion.png", "bend_sequence.png")  # quick ones, of which there is one to draw
    monkeypatch.setattr(report_folder, "PICTURES", {name: PICTURES[name] for name in names})
    folder = write_report(evaluation, tmp_path, {})
    (folder / "bend_sequence.png").write_bytes(b"of an earlier report")
    (folder / "notes.txt").write_text("mine")
    write_report(evaluation, folder, {"date": "later"})
    names = {path.name for path in folder.iterdir()}
    assert names == {"confusion.png", "notes.txt", "report.json", "report.md"}
    assert "date: later" in (folder / "report.md").read_text()


def test_touches_beside_the_sheet_and_places_where_no_report_can_be_are_refused(
    evaluation, tmp_path, monkeypatch
):
    data = frames()
    in_cm = dataclasses.replace(data, touch_x=1e2 * data.touch_x)
    with pytest.raises(DataError, match=r"x = .*0.06 m"):
        Evaluation.from_dataset(pipeline(perceived()), in_cm)
    file = tmp_path / "file"
    file.write_text("mine")
    for place in (file, file / "below", tmp_path):
        with pytest.raises(ConfigurationError, match="no report"):
            write_report(evaluation, place, {})
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"eitskin\[view\]"):
        require_report_folder(tmp_path / "report")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert file.read_text() == "mine"


# Scores


@pytest.mark.parametrize(
    ("true", "found", "distances"),
    [
        # The nearest pair first would leave one 15 mm apart, beyond the gate.
        ([(0.010, 0.0), (0.020, 0.0)], [(0.0145, 0.0), (0.005, 0.0)], [0.005, 0.0055]),
        # The smallest total alone would be one pair of 0 mm.
        ([(0.0, 0.0), (0.014, 0.0)], [(0.014, 0.0), (0.014, 0.0145)], [0.014, 0.0145]),
        ([(0.03, 0.03), (0.10, 0.03)], [(0.031, 0.03)], [0.001]),
        ([(0.05, 0.03)], [(0.05, 0.03 + GATE * 1.01), (0.05, 0.03 - GATE * 0.99)], [GATE * 0.99]),
        ([(0.05, 0.03)], [(0.05 + 1.9 * GATE, 0.03)], []),
        (np.zeros((0, 2)), [(0.01, 0.01)], []),
        ([(0.02, 0.02)], [], []),
    ],
)
def test_pairs_are_as_many_as_can_be_and_then_the_nearest(true, found, distances):
    assert sorted(match_distances(true, found)) == pytest.approx(distances)


places = st.lists(st.tuples(*[st.floats(0, 0.1)] * 2), max_size=5)


@pytest.mark.slow
@given(true=places, found=places)
def test_ospa_distance_is_a_capped_assignment_with_misses_at_the_cutoff(true, found):
    a, b = (np.reshape(each, (-1, 2)) for each in (true, found))
    away = np.minimum(np.linalg.norm(a[:, None] - b[None], axis=2), 0.02)
    total = away[linear_sum_assignment(away)].sum() + 0.02 * abs(len(a) - len(b))
    assert ospa(true, found, 0.02) == pytest.approx(total / max(len(a), len(b), 1))
    assert ospa(found, true, 0.02) == pytest.approx(ospa(true, found, 0.02))


def test_similarity_is_blind_to_scale_and_what_no_frame_shows_has_no_score():
    truth = np.zeros((32, 80))
    truth[10:18, 30:38] = 1.0
    assert similarity(truth * 0.2, truth) == pytest.approx(1.0)
    assert similarity(truth - 5.0 * (truth == 0), truth) == pytest.approx(1.0)
    assert determination(np.ones(3), np.arange(3.0)) is None
    assert consistency([1.0], [NAN]) is consistency([], []) is None
    assert consistency([3.0, 5.0, NAN], [2.0, 0.0, 1.0]).count == 1
