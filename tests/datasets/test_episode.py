"""Episodes: bends that move, presses that come, creep and linger, frames that take their time."""

import dataclasses

import numpy as np
import pytest

from eitskin.datasets import Recipe, State
from eitskin.datasets.generation import shard_simulation
from eitskin.datasets.generation.shard_simulation import simulate_shard
from eitskin.datasets.recipe.episode import (
    EpisodeTouch,
    Keyframe,
    RandomEpisodes,
    ScriptedEpisode,
    Timeline,
)
from eitskin.datasets.recipe.frame_sampling import sample
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.geometry import Bend, Electrode, Hinge, Rectangle, SensorDesign
from eitskin.simulator import Instrument, Scene, Simulator, Touch, simulator
from eitskin.simulator.mechanics.touch_history import HeldTouch
from eitskin.simulator.mechanics.viscoelasticity import REFERENCE, elastic_force

OUTLINE = Rectangle(0.150, 0.060)
HERE, THERE = EpisodeTouch(0.05, 0.02), EpisodeTouch(0.1, 0.04, 8.0)


def plain(touch):
    return Touch(touch.x, touch.y, touch.force)


SCANNED = Instrument(snr_db=0.0, measurement_time=0.0106)
RNG = np.random.default_rng(0)
# Six channels, for scenes that are solved by the dozen.
SMALL = SensorDesign(
    OUTLINE, 0.005, tuple(Electrode(x, y) for x in (0.0225, 0.1275) for y in (0.0, 0.06))
)
SWEEP = (Keyframe(0.0, -20.0), Keyframe(3.5, 50.0))


def script(*keyframes, **changes) -> ScriptedEpisode:
    return ScriptedEpisode(tuple(keyframes), **changes)


def recipe(*episodes, **changes) -> Recipe:
    return Recipe("episodes", episodes=episodes, seed=3, **changes)


def linear_in_the_angle(asked, *_tolerance):
    """Impedances as a made-up sensor would have them, 1 ohm per degree and newton."""
    return [
        np.outer(
            [100.0 + each.bend.angle_deg + sum(t.force for t in each.touches) for each in scenes],
            np.arange(1, len(own.protocol) + 1),
        ).astype(complex)
        for own, scenes, _ in asked
    ]


# What is told


def test_scripts_move_straight_between_keyframes_hold_presses_and_repeat():
    told = script(
        Keyframe(0.0),
        Keyframe(2.0, 10.0, (HERE,)),
        Keyframe(4.0, 10.0, (HERE, THERE)),
        Keyframe(5.0, -20.0),
        Keyframe(6.0, -20.0),
    ).draw(OUTLINE, RNG)
    assert [told.scene(t).bend.angle_deg for t in (0.0, 1.0, 3.0, 4.5, 5.5)] == [0, 5, 10, -5, -20]
    assert set(told.touches) == {
        HeldTouch(plain(HERE), 2.0, 5.0),
        HeldTouch(plain(THERE), 4.0, 5.0),
    }
    told = script(Keyframe(0.0), Keyframe(1.0, 30.0, (HERE,)), Keyframe(2.0), repeats=3, period=0.5)
    assert told.frames == 12
    line = told.draw(OUTLINE, RNG)
    assert [line.scene(t).bend.angle_deg for t in (0.5, 1.0, 2.0, 3.0, 5.0, 5.5)] == [
        *(15.0, 30.0, 0.0, 30.0, 30.0, 15.0)
    ]
    assert [(each.start, each.end) for each in line.touches] == [(1.0, 2.0), (3.0, 4.0), (5.0, 6.0)]


def test_presses_creep_while_held_linger_afterwards_and_are_forgotten():
    line = Timeline((0.0,), (0.0,), (HeldTouch(plain(HERE), 1.0, 3.0),))
    assert line.scene(0.9, REFERENCE) == Scene()
    (touch,) = line.scene(1.0, REFERENCE).touches
    assert (touch.x, touch.y, touch.force, touch.held, touch.released) == (
        0.05,
        0.02,
        10.0,
        0.0,
        0.0,
    )
    assert line.scene(2.5, REFERENCE).touches[0].held == 1.5
    (left,) = line.scene(3.0, REFERENCE).touches
    assert (left.held, left.released > 0.0) == (2.0, True)
    forgotten = next(t for t in np.arange(3.0, 400.0) if not line.scene(t, REFERENCE).touches)
    assert elastic_force(REFERENCE, 1.0, 2.0, forgotten - 3.0) <= 1e-3
    assert elastic_force(REFERENCE, 1.0, 2.0, forgotten - 4.0) > 1e-3


@pytest.mark.slow
def test_random_episodes_keep_their_ranges():
    kind = RandomEpisodes(
        1,
        400,
        angle_deg=(-20.0, 50.0),
        speed_deg_s=(5.0, 30.0),
        rest_s=(2.0, 6.0),
        pause_s=(1.0, 4.0),
        hold_s=(1.0, 3.0),
        touches=(1, 3),
        force=(4.0, 12.0),
    )
    lines = [kind.draw(OUTLINE, np.random.default_rng(seed)) for seed in range(20)]
    for line in lines:
        times, angles = np.array(line.times), np.array(line.angles_deg)
        lasts, turned = np.diff(times), np.abs(np.diff(angles))
        assert times[-1] >= 400 * kind.period
        assert ((lasts[::2] >= 2.0) & (lasts[::2] <= 6.0)).all()
        assert (turned[::2] == 0.0).all()
        assert (turned[1::2] / lasts[1::2] >= 5.0 - 1e-9).all()
        assert (turned[1::2] / lasts[1::2] <= 30.0 + 1e-9).all()
        starts = sorted({each.start for each in line.touches})
        ends = sorted({each.end for each in line.touches})
        assert all(1.0 <= b - a <= 4.0 for a, b in zip(ends[:-1], starts[1:], strict=True))
        assert all(1.0 <= b - a <= 3.0 for a, b in zip(starts, ends, strict=True))
    angles = np.array([angle for line in lines for angle in line.angles_deg[2::2]])
    forces = np.array([each.touch.force for line in lines for each in line.touches])
    for values, low, high in ((angles, -20.0, 50.0), (forces, 4.0, 12.0)):
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
        deviation = (high - low) / np.sqrt(12)
        assert values.std() == pytest.approx(deviation, rel=4 / np.sqrt(2 * len(values)))
    numbers = np.array(
        [
            sum(e.start == s for e in line.touches)
            for line in lines
            for s in {e.start for e in line.touches}
        ]
    )
    shares = np.bincount(numbers, minlength=4)[1:] / len(numbers)
    assert shares == pytest.approx(1 / 3, abs=4 * np.sqrt(2 / 9 / len(numbers)))


# What becomes of it in a dataset


def test_frames_of_an_episode_are_labelled_and_follow_each_other():
    told = script(
        Keyframe(0.0), Keyframe(2.0), Keyframe(3.0, 10.0), Keyframe(4.0, 10.0, (HERE, THERE)),
        Keyframe(6.0, 10.0), Keyframe(8.0), period=0.5, count=3,
    )  # fmt: skip
    asked = recipe(told, specimens=Specimens(2), frames_per_shard=16)
    drawn = [sample(asked, index) for index in range(asked.frames)]
    assert [each.time for each in drawn] == [0.5 * k for k in range(16)] * 3
    assert [each.episode for each in drawn] == [0] * 16 + [1] * 16 + [2] * 16
    assert [each.specimen for each in drawn] == [0] * 32 + [1] * 16
    states = [each.state for each in drawn[:16]]
    assert states == [State.IDLE] * 5 + [State.BEND] * 3 + [State.TOUCH] * 4 + [State.BEND] * 4
    # One session of a specimen: the second episode goes on where the first ended.
    assert [each.session_time for each in drawn[:32]] == [0.5 * k for k in range(32)]
    assert drawn[32].session_time == 0.0
    assert drawn[7].after == drawn[8].scene
    assert drawn[0].after is None
    assert sample(asked, 40) == drawn[40]


@pytest.mark.slow
def test_skew_and_drift_are_exact_where_signals_are_linear_in_time(monkeypatch):
    for module in (simulator, shard_simulation):
        monkeypatch.setattr(module, "measure_together", linear_in_the_angle)
    data = simulate_shard(recipe(script(*SWEEP, period=0.35), instrument=SCANNED), 0)
    assert len(data) == 10
    offsets = 0.0106 * np.arange(28)
    angles = -20.0 + 20.0 * (0.35 * np.arange(10)[:, None] + offsets)
    assert data.impedance.real == pytest.approx((100.0 + angles) * np.arange(1, 29), rel=1e-6)
    assert data.touch_reference == pytest.approx(data.impedance, rel=1e-6)
    assert data.bend_angle_deg == pytest.approx(-20.0 + 7.0 * np.arange(10))
    drifting = Instrument(snr_db=0.0, drift=0.1)
    still = script(Keyframe(0.0, 5.0), Keyframe(600.0, 5.0), period=10.0, count=3)
    asked = recipe(still, instrument=drifting, frames_per_shard=60, specimens=Specimens(1))
    parts = [simulate_shard(asked, shard) for shard in range(3)]
    drift = np.concatenate([part.impedance[:, 0].real for part in parts]) / 105.0
    steps = np.diff(np.log(drift))
    # A step of the walk in 10 s has the sd 0.1 sqrt(10 / 14400), over the shards' ends as within.
    size = 0.1 * np.sqrt(10.0 / 14400.0)
    assert steps.std() == pytest.approx(size, rel=4 / np.sqrt(2 * len(steps)))
    assert np.abs(steps[[59, 119]]).max() < 3.5 * size
    assert drift[0] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.slow
def test_skew_of_a_moving_bend_is_near_to_solving_every_moment():
    """At 30 deg/s, of what each measurement says where every moment is a scene of its own."""
    fast = script(Keyframe(0.0, -20.0), Keyframe(7 / 3, 50.0), period=0.297)
    slow_scan = dataclasses.replace(SCANNED, measurement_time=0.05)
    data = simulate_shard(recipe(fast, instrument=slow_scan, sensor=SMALL, fixture=Hinge()), 0)
    sim = Simulator(SMALL, "fast", Hinge())
    moments = data.time[:-1, None] + slow_scan.offsets(sim.protocol)  # the last one ends in a kink

    def solved(angle):
        return sim.measure(Scene(Bend(float(angle)))).impedance.real

    angles = -20.0 + 30.0 * moments
    truth = np.array([[solved(a)[k] for k, a in enumerate(row)] for row in angles])
    unmoved = np.array([solved(a) for a in data.bend_angle_deg[:-1]])
    error = np.abs(data.impedance.real[:-1] / truth - 1.0).max()
    assert error < 2e-4  # as much as the noise; without interpolation 0.85 %
    assert np.abs(unmoved / truth - 1.0).max() > 40 * error
