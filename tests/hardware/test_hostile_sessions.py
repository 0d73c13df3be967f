"""Hostile sessions: whatever a board sends after a good beginning, live goes on with readings."""

import dataclasses
import math

import numpy as np
import pytest

from eitskin.frame import Frame
from eitskin.hardware import run_live
from eitskin.hardware.streams import reading_record
from eitskin.training import Pipeline

from live_fakes import FakeBoard

SESSIONS, FRAMES = 20, 10
ODD_NUMBERS = (0, 5_000_000, 2**31, 2**32 - 1)
ODD_TIMES = (math.nan, math.inf, -math.inf, -1e308, 1e308, 4294.967295, 0.0)
ODD_VALUES = (math.nan, math.inf, -math.inf, 0.0, 1e-300, 1e300, -1.0, 500.0)


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.load("reference.eitmodel")


def damaged(good, rng):
    """Frame with one fault, or several."""
    values, count = good.impedance.copy(), len(good.impedance)
    chosen = rng.random(count) < rng.choice([0.04, 0.5, 1.0])
    faults = {
        "sign": lambda: np.where(chosen, -values, values),
        "values": lambda: np.where(chosen, rng.choice(ODD_VALUES), values),
        "factor": lambda: np.where(chosen, values * 10 ** rng.uniform(-12, 12), values),
        "phase": lambda: values * np.exp(2j * np.pi * rng.random()),
        "order": lambda: rng.permutation(values),
        "touch": lambda: values * (1 + 0.2 * rng.standard_normal(count)),
    }
    made = faults[rng.choice(list(faults))]()
    changes = {"impedance": made}
    if rng.random() < 0.3:
        changes["time"] = float(rng.choice(ODD_TIMES))
    if rng.random() < 0.3:
        changes["number"] = int(rng.choice(ODD_NUMBERS))
    if rng.random() < 0.1:
        changes["session"] = int(rng.integers(0, 2**16))
    if rng.random() < 0.2:
        changes["status"] = rng.integers(0, 256, count).astype(np.uint8) * chosen
    return dataclasses.replace(good, **changes)


def hostile_frames(pipeline, seed):
    """Frames of a session, most of them damaged after the first."""
    rng, layout = np.random.default_rng(seed), pipeline.layout
    for number in range(FRAMES):
        impedance = layout.reference * (1 + 2e-4 * rng.standard_normal(len(layout.reference)))
        good = Frame(impedance, layout.protocol, 0.3 * number, number, frequency=layout.frequency)
        yield damaged(good, rng) if number and rng.random() < 0.7 else good


def survived(pipeline, seed):
    pipeline.reset()
    readings = list(run_live(FakeBoard(list(hostile_frames(pipeline, seed))), pipeline))
    assert len(readings) == FRAMES
    for reading in readings:
        assert (reading.estimate is None) == bool(reading.problem)
        assert reading_record(reading, FakeBoard.counts)["version"]
    return sum(reading.estimate is not None for reading in readings)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # overflow: values of 1e300 ohm
def test_hostile_sessions_end_in_nothing_but_readings(pipeline):
    assert sum(survived(pipeline, seed) for seed in range(SESSIONS)) > SESSIONS


def test_one_value_of_the_wrong_sign_is_left_out_and_told(pipeline):
    good = next(hostile_frames(pipeline, 0))
    values = good.impedance.copy()
    values[5] *= -1
    frames = [good, dataclasses.replace(good, impedance=values, number=1, time=0.3)]
    pipeline.reset()
    first, second = run_live(FakeBoard(frames), pipeline)
    assert not first.estimate.problems
    (told,) = second.estimate.problems
    assert pipeline.layout.protocol.labels[5] in told
    assert "sign changed" in told


@pytest.mark.slow
@pytest.mark.parametrize("unknown", [0, 13])
def test_values_of_the_wrong_sign_are_no_sensor_at_rest(pipeline, unknown):
    good = next(hostile_frames(pipeline, 0))
    reversed_ = np.where(np.arange(len(good.impedance)) < unknown, np.nan, -good.impedance)
    frames = [good, dataclasses.replace(good, impedance=reversed_, number=1, time=0.3)]
    pipeline.reset()
    first, second = run_live(FakeBoard(frames), pipeline)
    assert first.problem == ""
    assert second.estimate is None
    assert "changed their sign" in second.problem
