"""Benchmarks of estimates: transfer to other sensors, and streams of life."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import printed_json
from touched_dataset import touched_dataset

from eitskin.benchmarks import life_world, transfer
from eitskin.benchmarks.life import Judgements
from eitskin.benchmarks.life_world import EVENTS, OPENING, Event
from eitskin.benchmarks.results import read_results
from eitskin.benchmarks.transfer import LabelledCounts, judge
from eitskin.datasets import State
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.errors import DataError
from eitskin.training import FoundTouches, Predictions
from eitskin.training.method.predictions import Estimate, TouchEstimate


def numbered(numbers, specimens, states):
    arrays = SimpleNamespace(
        number=np.array(numbers), specimen=np.array(specimens), state=np.array(states)
    )
    arrays.select = lambda rows: arrays.number[rows].tolist()
    return arrays


def test_frames_drawn_as_judged_are_left_out_and_fixed_angles_come_first():
    judged = numbered([0, 1, 2, 3], [0, 0, 1, 1], [State.TOUCH] * 4)
    states = [State.BEND, State.TOUCH, State.TOUCH, State.TOUCH, State.TOUCH]
    known = numbered([0, 1, 2, 3, 4], [0, 0, 0, 1, 1], states)
    assert transfer._exclude_same_draws(judged, known) == [0, 2, 4]
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
            "states right": 2.0 / 3.0,
            "angle, rms [deg]": 5.0**0.5,
            "angle, error over standard error": 2.5**0.5,
            "numbers of touches right": 1.0 / 3.0,
            "touches found": 0.5,
            "place, mean [mm]": 4.0,
            "place, error over standard error": 2.0,
        }
    )


@pytest.mark.slow
def test_the_command_measures_the_shipped_pipeline(tmp_path, monkeypatch):
    nominal = {"nominal": ({}, {"specimens": Specimens(2, conductivity=0.1)})}
    monkeypatch.setattr(transfer, "ALL_WORLDS", nominal)
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
    assert found[f"{free} / states right"] > 0.9


# Life


TRAINED, UNKNOWN = EVENTS["touch, held and released"], EVENTS["palm of 40 mm"]
AT, PAIR = (0.050, 0.030), ((0.040, 0.030), (0.060, 0.030))


def said(state, touches=(), angle=0.0, problems=()):
    found = tuple(TouchEstimate(x, y, 8.0, deviation) for x, y, deviation in touches)
    chances = np.eye(3)[int(state)]
    return Estimate(state, chances, angle, 0.5, None, found, tuple(problems), 0, 0.0)


def judged(estimate, touches=(), angle=0.0, event: Event = TRAINED):
    found = Judgements()
    rows = np.array([(*place, 8.0) for place in touches] or [[np.nan] * 3])
    right = found.add(estimate, rows, angle, event)
    return right, found.wrong[0], found.flagged[0]


TOUCHED = State.TOUCH
# Estimate, true touches, angle, event; whether right, confidently wrong, flagged though right.
CASES = [
    (said(State.IDLE), (), 0.0, TRAINED, (True, False, False)),
    (said(State.IDLE, problems=["x"]), (), 0.0, TRAINED, (True, False, True)),
    (said(State.IDLE, problems=["x"]), (), 0.0, UNKNOWN, (False, False, False)),
    (said(State.IDLE), (AT,), 0.0, TRAINED, (False, True, False)),
    (said(TOUCHED, [(*AT, 0.001)]), (), 0.0, TRAINED, (False, True, False)),
    (said(TOUCHED, [(0.0545, 0.030, 0.001)]), (AT,), 0.0, TRAINED, (True, False, False)),
    (said(TOUCHED, [(0.056, 0.030, 0.001)]), (AT,), 0.0, TRAINED, (False, True, False)),
    (said(TOUCHED, [(0.056, 0.030, 0.003)]), (AT,), 0.0, TRAINED, (True, False, False)),
    (said(TOUCHED, [(*AT, 0.001)]), (AT, (0.08, 0.03)), 0.0, TRAINED, (False, True, False)),
    (said(TOUCHED, [(*AT, 0.010)]), (AT, (0.06, 0.03)), 0.0, TRAINED, (True, False, False)),
    (said(State.BEND, angle=20.0), (), 23.0, TRAINED, (False, True, False)),
    (said(State.BEND, angle=20.0), (), 21.9, TRAINED, (True, False, False)),
    (said(TOUCHED, [(*AT, 0.001)]), PAIR, 0.0, UNKNOWN, (True, False, False)),
]


@pytest.mark.parametrize(("estimate", "touches", "angle", "event", "expected"), CASES)
def test_frames_are_judged_by_hand(estimate, touches, angle, event, expected):
    assert judged(estimate, touches, angle, event) == expected


def test_wrong_frames_below_the_noise_count_apart():
    found = Judgements()
    for signal in (2.9, 3.1):
        found.add(said(State.IDLE), np.array([[*AT, 8.0]]), 0.0, TRAINED, signal)
    assert found.wrong == [True, True]
    assert found.below == [True, False]


@pytest.mark.slow
def test_streams_show_what_they_say(tmp_path, monkeypatch):
    """One sensor: frames as many as truths, an opening that is flat, and solved changes."""
    names = ("touch, held and released", "one contact", "step of the gain", "leak of 100 kohm")
    monkeypatch.setattr(life_world, "EVENTS", {name: EVENTS[name] for name in names})
    monkeypatch.setattr(life_world, "PAIRS", ())
    (life,) = life_world.lives(tmp_path, 0, 1, lambda *_: None)
    (again,) = life_world.lives(tmp_path, 0, 1, lambda *_: None)
    for name, stream in life.streams.items():
        assert len(stream.impedance) == len(stream.touches) == len(stream.angle_deg)
        assert np.ptp(stream.impedance[:OPENING], axis=0).max() == 0.0
        np.testing.assert_array_equal(stream.impedance, again.streams[name].impedance)
    touched, contact, gain, leak = (life.streams[name] for name in names)
    assert np.isfinite(touched.touches[OPENING, 0]).all()
    assert np.isnan(touched.touches[-1]).all()
    np.testing.assert_array_equal(touched.impedance[-1], touched.impedance[0])
    added = contact.impedance[-1] - contact.impedance[0]
    assert np.count_nonzero(added) == 1
    assert 2.0 <= added.real.max() <= 8.0
    assert abs(abs(gain.factor[-1]) - 1.0) >= 0.001
    before, after = (life.protocol.measure(leak.impedance[n]).real for n in (0, -1))
    changed = int(np.abs(after / before - 1.0).argmax())
    assert 1.0 / after[changed] - 1.0 / before[changed] == pytest.approx(1e-5, rel=1e-6)
    signal, louder = (touched.signal(life.board, life.protocol, noise) for noise in (1.0, 2.0))
    pressed = np.isfinite(touched.touches[:, 0, 0])
    np.testing.assert_allclose(signal[pressed], 2.0 * louder[pressed])
    assert (~np.isfinite(signal) == ~pressed).all()
    frames = life.streams[names[0]].frames(life.board, life.protocol, 40e3, 1.0, 3)
    assert len(frames) == len(touched.impedance)
    assert np.ptp([frame.time for frame in frames]) > 0.0
