"""Observations that methods learn from."""

import copy
import dataclasses
from functools import partial

import numpy as np
import pytest
from touched_dataset import touched_dataset

from eitskin.datasets import UNKNOWN_STATE, Dataset, State
from eitskin.errors import FrameError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol
from eitskin.training import FoundTouches, InputSpec, Observations, Targets, TrainingSettings
from eitskin.training.method.observations import channel_noise, frame_noise
from eitskin.training.method.settings import hold_out
from eitskin.training.method.targets import with_implied_labels

TRUE = np.geomspace(1e-3, 1e-1, 8)


def idle(frames, noise):
    """Dataset of idle frames whose channels have the noise given (8,)."""
    rng = np.random.default_rng(0)
    values = 500.0 * (1.0 + noise * rng.normal(size=(frames, 8)))
    return Dataset.from_arrays(values, np.full(8, 500.0), state=np.zeros(frames))


def found(data):
    return channel_noise(data, Observations.from_dataset(data))


def test_noise_of_each_channel():
    """Few frames lean on the median channel; a channel that never differs has a floor."""
    assert found(idle(4000, TRUE)) == pytest.approx(TRUE, rel=0.1)
    data = idle(1, np.full(8, 1e-2))
    drawn = np.abs(Observations.from_dataset(data).dynamic[0])
    assert np.ptp(np.log(found(data))) < 0.5 * np.ptp(np.log(drawn))
    data = idle(200, np.where(np.arange(8) < 6, 0.0, 1e-2))
    noise, overall = found(data), frame_noise(data, Observations.from_dataset(data))
    assert (noise[:6] > 0).all()
    assert (noise[:6] < 1e-3 * (noise[6:].min() + overall)).all()


@pytest.mark.parametrize("averaged", [1, 16])
def test_noise_is_that_of_two_frames_however_many_a_reference_averages(averaged):
    rng, still = np.random.default_rng(1), np.full(8, 500.0)
    means = still * (1.0 + TRUE * rng.normal(size=(4000, averaged, 8)).mean(axis=1))
    recipe = f"reference_frames = {averaged}"
    data = dataclasses.replace(idle(4000, TRUE), touch_reference=means, recipe=recipe)
    overall = frame_noise(data, Observations.from_dataset(data))
    assert found(data) == pytest.approx(np.sqrt(2.0) * TRUE, rel=0.1)
    assert overall == pytest.approx(np.sqrt(2.0 * np.mean(TRUE**2)), rel=0.05)


UNKNOWN = UNKNOWN_STATE


def frames(states, angles=None, touched=(), force=np.nan, **known):
    """Frames of these states and angles [deg]; those of `touched` have a position."""
    n = len(states)
    places = [[(0.05, 0.02)] * (row in touched) for row in range(n)]
    newtons = np.where(np.isin(np.arange(n), touched)[:, None] & (np.arange(4) == 0), force, np.nan)
    known |= {"state": states, "touch_force": newtons}
    known |= {} if angles is None else {"bend_angle_deg": angles}
    return touched_dataset(np.ones((n, 6)), np.ones(6), places, **known)


@pytest.mark.parametrize(
    ("data", "targets", "missing"),
    [
        (frames([0, 1, 2], [0, 0, 9], [1], force=8.0), Targets(), ()),
        (
            frames([0, 1, 0, 1], touched=[1]),
            Targets(("idle", "touch"), angle=False, force=False),
            ("the state bend", "the bend angle", "forces"),
        ),
        (
            frames([2, 2, 2], [5, 20, 30]),
            Targets((), touches=False, force=False),
            ("the state", "positions of touches"),
        ),
        (
            frames([0, 2, 2], [np.nan, 20, 30]),
            Targets(("idle", "bend"), touches=False, force=False),
            ("the state touch", "positions of touches"),
        ),
        (
            frames([1, 1], touched=[0, 1]),
            Targets((), angle=False, force=False),
            ("the state", "the bend angle", "forces"),
        ),
    ],
)
def test_targets_are_what_frames_have_labels_for(data, targets, missing):
    assert Targets.from_dataset(data) == targets
    assert targets.missing == missing
    assert targets.positions_only == (data.touch_count > 0).all()


def test_states_and_angles_follow_from_labels():
    data = with_implied_labels(frames([UNKNOWN] * 3, [0.0, 20.0, np.nan]))
    assert data.state.tolist() == [State.IDLE, State.BEND, UNKNOWN]
    data = with_implied_labels(frames([UNKNOWN, 0, UNKNOWN], touched=[0]))
    assert data.state.tolist() == [State.TOUCH, State.IDLE, UNKNOWN]
    assert data.bend_angle_deg.tolist() == [0.0] * 3  # of a sensor that is never bent
    bent = frames([0, 2], [np.nan, np.nan])
    assert np.isnan(with_implied_labels(bent).bend_angle_deg).all()
    both = FoundTouches.from_arrays([[0.1, 0.2], [0.3, 0.4]], [0.5, 0.9], [7.0, 8.0], [1e-3, 2e-3])
    first, second = both
    assert tuple(first) == (first.x, first.y, first.strength) == (0.3, 0.4, 0.9)
    assert (first.force, first.deviation, len(first)) == (8.0, 2e-3, 3)
    assert copy.copy(second).force == 7.0


def test_specimens_or_the_end_of_a_single_one_are_held_out():
    data = dataclasses.replace(
        frames([0, 1] * 20),
        reference=np.ones((4, 6)),
        specimen=np.arange(40) // 10,
        specimen_number=np.arange(4),
    )
    kept, held_out = hold_out(data, seed=3)
    assert len(held_out) == 10
    assert len(np.unique(data.specimen[held_out])) == 1
    assert sorted([*kept, *held_out]) == list(range(40))
    settings = TrainingSettings(seed=3, whole_specimens=True)
    assert [len(part) for part in settings.split(data)] == [30, 10, 10]
    assert [len(part) for part in TrainingSettings().split(data)] == [20, 10, 10]
    states = np.array([0] * 10 + [1] * 20)
    data = frames(states, time=np.arange(30.0)[::-1])
    kept, held_out = hold_out(data)
    assert held_out.tolist() == [0, 1, 10, 11, 12, 13]
    assert len(kept) == 24


# Sensors that a pipeline takes for its own, by how its training specimens scatter

PROTOCOL = Protocol.pairwise(8)
FLAT = np.linspace(400.0, 800.0, 28)


def test_sensors_that_scatter_are_taken_once_known_and_electrode_orders_are_named():
    flat = 500.0 * np.exp(0.3 * np.random.default_rng(4).normal(size=28))
    rows = {frozenset(row[:2]): number for number, row in enumerate(PROTOCOL.table)}

    def plugged(partner):
        return flat[[rows[frozenset(partner[e] for e in row[:2])] for row in PROTOCOL.table]]

    spec = InputSpec(SensorDesign.reference(), PROTOCOL, 40e3, flat, spread=0.5)
    exchanged = [0, 6, 2, 3, 4, 5, 1, 7]
    backwards = [(3 - e) % 8 for e in range(8)]
    for refuse in (spec.require_same_sensor, partial(spec.require_same_sensor, adapting=True)):
        with pytest.raises(FrameError, match=r"electrodes 1 and 6 exchanged: .* another order"):
            refuse(plugged(exchanged).astype(complex))
        with pytest.raises(FrameError, match="counted backwards from 3 on"):
            refuse(plugged(backwards).astype(complex))
    rng = np.random.default_rng(0)
    eight = FLAT * np.exp(0.01 * rng.normal(size=(8, 28)))
    data = Dataset.from_arrays(eight, eight, specimen=np.arange(8), state=np.zeros(8))
    spec = InputSpec.from_dataset(data, SensorDesign.reference(), PROTOCOL)
    strange = 1.5 * FLAT * np.exp(0.2 * rng.normal(size=28))
    with pytest.raises(FrameError, match=r"expected up to 10\.0%"):
        spec.require_same_sensor(strange.astype(complex))
    spec.require_same_sensor(strange.astype(complex), adapting=True)
    partly = np.where(np.arange(28) == 5, np.nan, strange)
    for own in (spec.for_sensor(strange), spec.for_sensor(partly)):
        own.require_same_sensor((0.8 * strange).astype(complex))
        with pytest.raises(FrameError, match="scatter by"):
            own.require_same_sensor(FLAT.astype(complex))
    with pytest.raises(FrameError, match="scatter by"):
        spec.require_same_sensor(
            (FLAT * np.exp(0.8 * rng.normal(size=28))).astype(complex), adapting=True
        )
