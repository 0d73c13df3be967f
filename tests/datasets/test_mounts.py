"""Mounts: clamps that fill their ranges evenly, shared by specimens, and never impossible."""

import dataclasses

import numpy as np

from eitskin.datasets import Recipe
from eitskin.datasets.generation.preparation import deciding_specimens, missing_bend_tables
from eitskin.datasets.generation.shard_simulation import simulate_frames
from eitskin.datasets.recipe.frame_sampling import specimen
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Mounts, Specimens
from eitskin.geometry import Clamp, Hinge, Plates
from eitskin.simulator import Mechanics

MOUNTS = Mounts(12, (0.025, 0.060), (0.004, 0.014), (0.5, 2.0), ("both", "bottom"))


def recipe(mounts=MOUNTS, specimens=60, **changes) -> Recipe:
    scenes = (SceneGroup("bend", count=specimens, angle_deg=(-20.0, 50.0)),)
    made = Specimens(specimens, conductivity=0.1)
    return Recipe("mounts", scenes=scenes, specimens=made, mounts=mounts, **changes)


def test_the_mounts_fill_their_ranges_evenly():
    many = dataclasses.replace(MOUNTS, count=64)
    clamps = [many.clamp(number) for number in range(64)]
    ratios = [
        many.mechanics(number, Mechanics()).encapsulation.shear_modulus for number in range(64)
    ]
    for values, (low, high) in (
        ([clamp.span for clamp in clamps], many.span),
        ([clamp.offset for clamp in clamps], many.offset),
        (np.log2(ratios), tuple(np.log2(28e3 * np.array(many.stiffness)))),
    ):
        counts, _ = np.histogram(values, 8, (low, high))
        assert counts.sum() == 64
        assert counts.min() >= 5
    places = np.array([[clamp.span, clamp.offset] for clamp in clamps])
    assert abs(np.corrcoef(places.T)[0, 1]) < 0.1
    assert {clamp.faces for clamp in clamps} == {"both", "bottom"}


def test_specimens_have_the_mounts_in_turn_and_deviate_from_them():
    asked = recipe()
    made = [specimen(asked, number) for number in range(24)]
    assert [each.fixture for each in made[:12]] == [each.fixture for each in made[12:]]
    assert len({each.fixture for each in made}) == 12
    assert len({each.design.conductivity for each in made}) == 24
    # What a specimen is besides does not depend on the mounts.
    without = recipe(Mounts())
    assert [specimen(without, number).design for number in range(24)] == [x.design for x in made]
    assert specimen(without, 3).fixture == Clamp()


def test_each_mount_is_solved_once():
    assert set(range(12)) <= set(deciding_specimens(recipe()))
    assert len(missing_bend_tables(recipe())) == 12
    assert len(missing_bend_tables(recipe(specimens=5))) == 5


def test_frames_say_the_clamp_of_their_specimen():
    flat = (SceneGroup("idle", count=12),)
    asked = dataclasses.replace(recipe(specimens=12), scenes=flat, resolution="fast")
    data = simulate_frames(asked, range(12))
    made = [specimen(asked, number) for number in data.specimen_number[data.specimen].tolist()]
    ratios = [
        each.mechanics.encapsulation.shear_modulus / each.mechanics.gel.shear_modulus
        for each in made
    ]
    assert np.array_equal(data.clamp_span, np.float32([each.fixture.span for each in made]))
    assert np.array_equal(data.clamp_offset, np.float32([each.fixture.offset for each in made]))
    held = [1 if each.fixture.faces == "bottom" else 2 for each in made]
    assert np.array_equal(data.clamp_faces, held)
    assert set(held) == {1, 2}
    assert np.array_equal(data.clamp_stiffness, np.float32(ratios))


def test_plates_under_a_clamped_sensor_hold_its_lower_face():
    group = SceneGroup("idle", count=1, support=Plates())
    data = simulate_frames(Recipe("plates", scenes=(group,), resolution="fast"), range(1))
    assert data.clamp_faces == 1


def test_hinges_are_no_clamps():
    flat = (SceneGroup("idle", count=1),)
    data = simulate_frames(Recipe("h", scenes=flat, fixture=Hinge(), resolution="fast"), range(1))
    assert np.isnan([data.clamp_span, data.clamp_offset, data.clamp_faces]).all()
    assert np.isnan(data.clamp_stiffness).all()
