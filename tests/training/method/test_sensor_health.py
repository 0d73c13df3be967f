"""Electrodes that fail in a recording or a session: named with their time, and left out."""

import numpy as np
import pytest
from touched_dataset import touched_dataset

from eitskin.datasets import State
from eitskin.simulator import Frame, Protocol
from eitskin.training import Pipeline, PositionScore, TrainingSettings
from eitskin.training.method.sensor_health import ReadingRange, SensorHealth, follow_recording

PROTOCOL = Protocol.adjacent(8)
MEMBERS = np.array([[e in row for row in PROTOCOL.table] for e in range(8)])
COUNT, TRAINED = 300, 240  # presses, and those of them that are learned from


def recording(electrode=None, at=260, kind="jump", seed=0, creep=0.02):
    """Presses on a toy skin with drift, on which an electrode may fail in one of three ways."""
    rng = np.random.default_rng(seed)
    channels = len(PROTOCOL)
    own, places = (rng.uniform(-0.05, 0.05, (n, 2)) for n in (channels, COUNT))
    distance = np.linalg.norm(places[:, None] - own, axis=2)
    change = 0.05 * np.exp(-((distance / 0.04) ** 2))
    drift = creep * np.cumsum(rng.standard_normal((COUNT, channels)), axis=0) / np.sqrt(COUNT)
    base = rng.uniform(2.0, 4.0, channels) + drift + creep * np.linspace(0.0, 15.0, COUNT)[:, None]
    noise = 3e-4 * rng.standard_normal((2, COUNT, channels))
    if electrode is not None:
        mine = np.flatnonzero(MEMBERS[electrode])
        if kind == "jump":  # of three quarters of its channels
            mine = rng.permutation(mine)[: 3 * len(mine) // 4]
        late = np.ix_(np.arange(at, COUNT), mine)
        step = rng.choice([-1.0, 1.0], len(mine)) * rng.uniform(0.3, 2.3, len(mine))
        if kind == "drift":
            step = np.linspace(0.0, 0.5, COUNT - at)[:, None] * np.sign(step)
        base[late] += step
        change[late] *= 1.0 if kind == "drift" else 0.3
        for each in noise:
            each[late] *= {"open": 300.0, "jump": 30.0, "drift": 1.0}[kind]
    before = np.exp(base + noise[0])
    return touched_dataset(
        np.exp(base + change + noise[1]),
        before[0],
        places,
        touch_reference=before,
        protocol=PROTOCOL,
        state=np.full(COUNT, State.TOUCH),
        time=2.0 * np.arange(COUNT),
    )


@pytest.fixture(scope="module")
def learned():
    return Pipeline.fit(recording(), TrainingSettings("touch position"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("electrode", "at", "kind", "delay"),
    [(5, 260, "jump", 1), (0, 250, "open", 1), (2, 245, "drift", 30)],
)
def test_a_failed_electrode_is_named_and_left_out(learned, electrode, at, kind, delay):
    broken = recording(electrode, at, kind)
    marked, (fault,) = follow_recording(broken, learned.usual)
    assert fault.electrode == electrode
    assert at <= fault.number <= at + delay
    assert not marked.status[:at].any()
    assert (marked.status[at + delay + 15 :, MEMBERS[electrode]] != 0).all()
    score = PositionScore.from_dataset(learned, broken.select(np.arange(at, COUNT)))
    healthy = PositionScore.from_dataset(learned, recording().select(np.arange(at, COUNT)))
    assert score.mean_error_mm < 1.5 * healthy.mean_error_mm + 0.3
    assert score.error_ratio < 1.4


@pytest.mark.slow
def test_a_session_names_the_electrode_and_goes_on(learned, tmp_path):
    pipeline = Pipeline.load(learned.save(tmp_path / "a.eitmodel"))
    broken = recording(6, 260, creep=5e-4)
    for row in range(250, COUNT):
        before, during = broken.touch_reference[row], broken.impedance[row]
        pipeline.process(Frame(before, PROTOCOL, 4.0 * row, 2 * row))
        estimate = pipeline.process(Frame(during, PROTOCOL, 4.0 * row + 2.0, 2 * row + 1))
    assert any("electrode 6 has failed" in text for text in estimate.problems)
    place = np.array(estimate.touches[0][:2])
    true = np.array([broken.touch_x[-1, 0], broken.touch_y[-1, 0]])
    assert np.linalg.norm(place - true) < 0.01


def test_an_electrode_that_recovers_is_taken_back_and_changes_of_all_are_no_fault():
    usual = ReadingRange.fit(np.exp(0.01 * np.random.default_rng(0).standard_normal((50, 40))))
    health = SensorHealth(usual, PROTOCOL)
    wrong, ones = np.where(MEMBERS[1], np.linspace(1.5, 3.0, 40), 1.0), np.ones(40)
    for number in range(60):
        values = wrong if 20 <= number < 40 else ones
        bad = health.follow(values, number, 0.1 * number)
        assert bad.any() == (27 <= number < 47)
        if number == 39:
            assert list(health.faults) == [1]
    assert not health.faults
    for number in range(60, 90):
        values = np.exp(np.linspace(-2.0, 2.0, 40))
        assert not health.follow(values, number, 6.0).all()
    assert "another" in health.problems(PROTOCOL.labels)[0]
