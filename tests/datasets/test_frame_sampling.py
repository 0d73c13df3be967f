"""Sampling: what is drawn, and that a frame depends on its number alone."""

import dataclasses

import numpy as np
import pytest

from eitskin.datasets import Recipe, State
from eitskin.datasets.recipe.episode import RandomEpisodes
from eitskin.datasets.recipe.frame_sampling import Stream, generator, sample, specimen_numbers
from eitskin.datasets.recipe.recipe import with_seed
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.geometry import Bend

IDLE = SceneGroup("idle", count=30)
BENT = SceneGroup("bend", count=60, angle_deg=(-20.0, 50.0))
TOUCHED = SceneGroup(
    "touch", count=90, angle_deg=(0.0, 30.0), touches=(1, 4), force=(8.0, 12.0), margin=0.012
)
MIXED = Recipe("mixed", scenes=(IDLE, BENT, TOUCHED), seed=5)
GROUPED = Recipe(
    "grouped",
    seed=6,
    frames_per_shard=25,
    specimens=Specimens(3, conductivity=0.01),
    scenes=(IDLE, dataclasses.replace(TOUCHED, per_bend=8)),
)


def all_samples(recipe):
    return [sample(recipe, index) for index in range(recipe.frames)]


def test_frames_hold_what_their_group_says():
    outline = MIXED.sensor.outline
    for drawn in (sample(MIXED, index) for index in range(MIXED.frames)):
        touches = drawn.scene.touches
        if drawn.state == State.IDLE:
            assert drawn.scene.bend == Bend(0.0)
        if drawn.state != State.TOUCH:
            assert touches == ()
            continue
        assert 1 <= len(touches) <= 4
        assert 0.0 <= drawn.scene.bend.angle_deg <= 30.0
        places = np.array([(touch.x, touch.y) for touch in touches])
        assert (places >= 0.012).all()
        assert (places <= np.array([outline.length, outline.width]) - 0.012).all()
        assert all(8.0 <= touch.force <= 12.0 for touch in touches)
        gaps = np.linalg.norm(places[:, None] - places, axis=-1)
        assert (gaps[np.triu_indices(len(places), 1)] >= 0.030).all()
    counts = {len(sample(MIXED, i).scene.touches) for i in range(MIXED.frames)}
    angles = [sample(MIXED, i).scene.bend.angle_deg for i in range(MIXED.frames)]
    assert counts == {0, 1, 2, 3, 4}
    assert min(angles) < -10.0
    assert max(angles) > 40.0


def test_a_frame_depends_on_seed_and_number_alone():
    backwards = [sample(MIXED, index) for index in reversed(range(20))][::-1]
    assert backwards == [sample(MIXED, index) for index in range(20)]
    assert [s.scene for s in backwards] != [sample(with_seed(MIXED, 6), i).scene for i in range(20)]
    draws = {
        float(generator(MIXED, stream, index).uniform()) for stream in Stream for index in range(9)
    }
    assert len(draws) == len(Stream) * 9


@pytest.mark.parametrize("per_bend", [1, 5])
def test_listed_positions_are_pressed_repeats_times_each(per_bend):
    places = ((0.02, 0.02), (0.05, 0.03), (0.1, 0.04))
    recipe = Recipe(
        "listed", scenes=(SceneGroup("touch", positions=places, repeats=4, per_bend=per_bend),)
    )
    pressed = [sample(recipe, index).scene.touches for index in range(recipe.frames)]
    assert recipe.frames == 12
    assert all(len(touches) == 1 for touches in pressed)
    assert sorted((t.x, t.y) for (t,) in pressed) == sorted(places * 4)


# Grouping


def test_frames_of_a_block_share_specimen_and_bend_and_nothing_else():
    touched = [each for each in all_samples(GROUPED) if each.state == State.TOUCH]
    assert len(touched) == 90
    blocks = {}
    for each in touched:
        blocks.setdefault(each.scene.bend, []).append(each)
    assert sorted(len(block) for block in blocks.values()) == [2] + [8] * 11
    for block in blocks.values():
        assert len({each.specimen for each in block}) == 1
        assert len({each.scene.touches for each in block}) == len(block)
        indices = [each.index for each in block]
        assert indices == list(range(indices[0], indices[0] + len(block)))


@pytest.mark.parametrize(("count", "episodes"), [(3, 0), (7, 9), (50, 4), (500, 0)])
def test_specimens_of_a_shard_are_those_of_its_frames(count, episodes):
    kinds = (RandomEpisodes(count=episodes, frames=5, period=0.5),) * bool(episodes)
    recipe = dataclasses.replace(
        GROUPED,
        specimens=Specimens(count, conductivity=0.01),
        frames_per_shard=11,
        episodes=kinds,
    )
    for frames in (*map(recipe.shard_range, range(recipe.shards)), range(recipe.frames)):
        drawn = {sample(recipe, index).specimen for index in frames}
        assert specimen_numbers(recipe, frames) == sorted(drawn)


@pytest.mark.slow
def test_angles_forces_and_numbers_of_touches_are_spread_evenly():
    per_bend, bends = 3, 600
    group = dataclasses.replace(TOUCHED, count=bends * per_bend, per_bend=per_bend)
    scenes = [each.scene for each in all_samples(Recipe("even", scenes=(group,), seed=9))]
    angles = np.array([scene.bend.angle_deg for scene in scenes])[::per_bend]
    forces = np.array([touch.force for scene in scenes for touch in scene.touches])
    assert len(np.unique(angles)) == bends
    for values, (low, high) in ((angles, group.angle_deg), (forces, group.force)):
        deviation = (high - low) / np.sqrt(12)
        assert values.mean() == pytest.approx(
            (low + high) / 2, abs=4 * deviation / np.sqrt(len(values))
        )
        assert values.std() == pytest.approx(deviation, rel=4 / np.sqrt(2 * len(values)))
        assert low <= values.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < values.max() <= high
    counts = np.bincount([len(scene.touches) for scene in scenes], minlength=5)
    shares = [0.0, 0.25, 0.25, 0.25, 0.25]
    assert counts / len(scenes) == pytest.approx(shares, abs=4 * np.sqrt(0.25 * 0.75 / bends))
    assert counts[0] == 0
