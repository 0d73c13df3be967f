"""`eitskin bench transfer`: worlds apart from training, scores by hand, and the command."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import printed_json
from touched_dataset import touched_dataset

from eitskin.benchmarks import transfer
from eitskin.benchmarks.results import read_results
from eitskin.benchmarks.transfer import LabelledCounts, judge
from eitskin.datasets import State
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.errors import DataError
from eitskin.training import FoundTouches, Predictions


def numbered(numbers, specimens, states):
    arrays = SimpleNamespace(
        number=np.array(numbers), specimen=np.array(specimens), state=np.array(states)
    )
    arrays.select = lambda rows: arrays.number[rows].tolist()
    return arrays


def test_presses_that_were_drawn_as_judged_frames_are_left_out():
    judged = numbered([0, 1, 2, 3], [0, 0, 1, 1], [State.TOUCH] * 4)
    states = [State.BEND, State.TOUCH, State.TOUCH, State.TOUCH, State.TOUCH]
    known = numbered([0, 1, 2, 3, 4], [0, 0, 0, 1, 1], states)
    assert transfer._exclude_same_draws(judged, known) == [0, 2, 4]


def test_fixed_angles_are_known_first_and_the_largest_of_them_before_the_others():
    mine = SimpleNamespace(
        state=np.array([State.TOUCH, State.BEND, State.IDLE, *[State.BEND] * 5, State.TOUCH]),
        bend_angle_deg=np.array([0.0, 49.0, 0.0, *transfer.KNOWN_DEG, 0.0], dtype=np.float32),
    )
    assert LabelledCounts(1, 0).rows(mine) == [2, 7]
    assert LabelledCounts(6, 1).rows(mine) == [2, 7, 6, 5, 3, 4, 1, 0]
    assert LabelledCounts(5, 9).rows(mine)[-2:] == [0, 8]
    with pytest.raises(DataError):
        LabelledCounts(7, 0).rows(mine)


def test_predictions_are_judged_by_hand():
    labels = {"state": [State.IDLE, State.BEND, State.TOUCH], "bend_angle_deg": [0.0, 10.0, 0.0]}
    places = [[], [], [(0.02, 0.03), (0.09, 0.03)]]
    data = touched_dataset(np.ones((3, 6)), np.ones(6), places, **labels)
    none, wrong = FoundTouches.from_arrays([], []), FoundTouches.from_arrays([[0.05, 0.03]], [1.0])
    near = FoundTouches.from_arrays([[0.02, 0.034]], [1.0], deviation=[0.002])
    predictions = Predictions(
        np.eye(3)[[State.IDLE, State.TOUCH, State.TOUCH]],
        np.array([1.0, 7.0, 0.0]),
        np.array([0.5, 3.0, 1.0]),
        np.zeros((3, 0, 0), np.float32),
        (none, wrong, near),
        ((),) * 3,
    )
    assert judge(data, predictions) == pytest.approx(
        {
            "untouched states right": 0.5,
            "angle, rms [deg]": 5.0**0.5,
            "angle, error over standard error": 2.5**0.5,
            "touches in untouched frames": 0.5,
            "touches found": 0.5,
            "place, mean [mm]": 4.0,
            "place, error over standard error": 2.0,
        }
    )


@pytest.mark.slow
def test_the_command_measures_the_shipped_pipeline(tmp_path, monkeypatch):
    nominal = {"nominal": ({}, {"specimens": Specimens(2, conductivity=0.1)})}
    monkeypatch.setattr(transfer, "WORLDS", nominal)
    monkeypatch.setattr(transfer, "SENSOR_FRAMES", transfer.SENSOR_FRAMES[::2])
    few = (*transfer.KNOWN_FRAMES[:6], replace(transfer.KNOWN_FRAMES[-1], count=6))
    monkeypatch.setattr(transfer, "KNOWN_FRAMES", few)
    monkeypatch.setattr(transfer, "LABELLED_COUNTS", (LabelledCounts(0, 0), LabelledCounts(5, 6)))
    found = printed_json(
        "bench", "transfer", "reference.eitmodel", "--quick", "--workers", 1, "--out", tmp_path
    )["figures"]
    assert read_results(tmp_path / "transfer" / "results.json").figures == pytest.approx(found)
    free, adapted = "reference / nominal, 0 angles", "reference / nominal, 5 angles, 6 presses"
    error = "angle, rms [deg]"
    assert found[f"{adapted} / {error}"] < found[f"{free} / {error}"] < 10.0
    # Known presses change the standard errors of places, not the places.
    ratio, place = "place, error over standard error", "place, mean [mm]"
    assert found[f"{adapted} / {ratio}"] != found[f"{free} / {ratio}"]
    assert found[f"{adapted} / {place}"] == pytest.approx(found[f"{free} / {place}"], rel=0.05)
    assert found[f"{free} / untouched states right"] > 0.9
    # Noise alone leaves less than any pipeline errs, and not much less.
    bound = found[f"Cramer-Rao bound / nominal / {place}"]
    assert 0.5 * found[f"{free} / {place}"] < bound < 1.2 * found[f"{free} / {place}"]
    bound = found[f"Cramer-Rao bound / nominal / {error}"]
    assert 0.05 < bound < found[f"{adapted} / {error}"]
