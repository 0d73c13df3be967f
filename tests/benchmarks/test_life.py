"""`eitskin bench life`: judgements by hand, streams with what they say, and the command."""

import numpy as np
import pytest

from eitskin.benchmarks import life_world
from eitskin.benchmarks.life import Judgements
from eitskin.benchmarks.life_world import EVENTS, OPENING, Event
from eitskin.datasets.store.schema import State
from eitskin.training.method.predictions import Estimate, TouchEstimate

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
    frames = life.streams[names[0]].frames(life.board, life.protocol, 40e3, 1.0, 3)
    assert len(frames) == len(touched.impedance)
    assert np.ptp([frame.time for frame in frames]) > 0.0
