"""Recipes: what is refused, what is drawn, and that a frame depends on its number alone."""

import dataclasses

import numpy as np
import pytest

from eitskin.datasets import Recipe, State
from eitskin.datasets.places import draw_places
from eitskin.datasets.recipe import shipped_names, with_seed
from eitskin.datasets.sampling import Stream, generator, sample, specimen
from eitskin.datasets.scene_group import SceneGroup
from eitskin.datasets.specimen import Specimens
from eitskin.geometry import (
    Bend,
    ConfigurationError,
    Disc,
    Electrode,
    Hinge,
    Layer,
    Rectangle,
    SensorDesign,
    Surface,
)
from eitskin.geometry.layouts import uniform
from eitskin.simulator import Instrument

IDLE = SceneGroup("idle", count=30)
BENT = SceneGroup("bend", count=60, angle_deg=(-20.0, 50.0))
TOUCHED = SceneGroup(
    "touch", count=90, angle_deg=(0.0, 30.0), touches=(1, 4), force=(8.0, 12.0), margin=0.012
)
MIXED = Recipe("mixed", scenes=(IDLE, BENT, TOUCHED), seed=5)


def write(tmp_path, text):
    path = tmp_path / "recipe.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", shipped_names())
def test_shipped_recipes_are_the_same_after_writing_and_reading(name, tmp_path):
    recipe = Recipe.shipped(name)
    assert recipe.name == name
    assert Recipe.from_toml(write(tmp_path, recipe.to_toml())) == recipe


def test_paper_recipes_hold_the_numbers_of_the_paper():
    states = Recipe.shipped("paper_states")
    assert [(g.state, g.frames) for g in states.scenes] == [
        ("idle", 360),
        ("bend", 360),
        ("touch", 360),
    ]
    assert states.scenes[1].angle_deg == (-20.0, 50.0)
    assert states.scenes[2].touches == (1, 4)
    assert Recipe.shipped("paper_bending").frames == 360
    (indentation,) = Recipe.shipped("paper_indentation").scenes
    xs, ys = ({place[axis] for place in indentation.positions} for axis in (0, 1))
    assert len(indentation.positions) == 27
    assert np.allclose(sorted(xs), np.arange(15, 136, 15) / 1e3)
    assert np.allclose(sorted(ys), [0.015, 0.030, 0.045])
    assert (indentation.repeats, indentation.force) == (8, (10.0, 10.0))


def test_unknown_shipped_name_lists_those_that_exist():
    with pytest.raises(ConfigurationError, match=r"'quik'.*paper_states, paper_touch, quick"):
        Recipe.shipped("quik")


def test_recipe_with_awkward_text_and_specimens_survives_writing(tmp_path):
    recipe = dataclasses.replace(
        MIXED,
        description='quotes " and \\ and\nlines and ü and \x7f',
        specimens=Specimens(3, conductivity=0.05),
        hinge=Hinge(span=0.05, offset=0.007),
        instrument=Instrument(60.0),
    )
    assert Recipe.from_toml(write(tmp_path, recipe.to_toml())) == recipe


def test_sensor_may_be_a_file_beside_the_recipe(tmp_path):
    design = dataclasses.replace(SensorDesign.reference(), conductivity=0.5)
    (tmp_path / "sensor.toml").write_text(design.to_toml(), encoding="utf-8")
    text = 'name = "a"\nsensor = "sensor.toml"\n[[scenes]]\nstate = "idle"\ncount = 1\n'
    assert Recipe.from_toml(write(tmp_path, text)).sensor == design


def test_all_contradictions_are_listed_at_once():
    with pytest.raises(ConfigurationError) as caught:
        Recipe(
            "bad",
            seed=-1,
            frames_per_shard=0,
            specimens=Specimens(count=0, conductivity=2.0),
            scenes=(
                SceneGroup("idle", count=1, touches=(2, 3), angle_deg=(0.0, 10.0)),
                SceneGroup("bend", count=0),
                SceneGroup("touch", count=1, force=(-5.0, 50.0), touches=(0, 9)),
                SceneGroup("touch", count=1, touches=(4, 4), spacing=0.1),
                SceneGroup("touch", count=2, positions=((15.0, 0.1),), repeats=0),
                SceneGroup("bend", count=1, angle_deg=(-400.0, 0.0)),
            ),
        )
    message = str(caught.value)
    for expected in (
        "seed must be",
        "frames_per_shard must be",
        "specimens: count",
        "specimens: conductivity",
        "scenes[0] (idle): state 'idle' has no touches, so leave out touches",
        "scenes[0] (idle): an idle sensor is flat",
        "scenes[1] (bend): count must be at least 1",
        "scenes[1] (bend): state 'bend' needs a range",
        "scenes[2] (touch): force must be a rising range above 0 N",
        "scenes[2] (touch): touches must be from 1 to 4",
        "scenes[3] (touch): 4 touches 0.1 m apart",
        "scenes[4] (touch): count follows from positions",
        "scenes[4] (touch): repeats must be at least 1",
        "scenes[4] (touch): position (15, 0.1) m is off",
        "scenes[5] (bend): a bend of -400 deg is not possible",
    ):
        assert expected in message


def test_misspelt_key_is_refused_with_the_nearest(tmp_path):
    text = 'name = "a"\n[[scenes]]\nstate = "idle"\ncuont = 1\n'
    with pytest.raises(ConfigurationError, match=r"'cuont'; did you mean 'count'"):
        Recipe.from_toml(write(tmp_path, text))


def test_missing_and_broken_files_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="cannot read the recipe"):
        Recipe.from_toml(tmp_path / "none.toml")
    with pytest.raises(ConfigurationError, match="cannot read the recipe"):
        Recipe.from_toml(write(tmp_path, "name = "))


def test_any_first_part_is_a_balanced_mix():
    states = np.array([sample(MIXED, index).state for index in range(MIXED.frames)])
    shares = {State.IDLE: 30 / 180, State.BEND: 60 / 180, State.TOUCH: 90 / 180}
    assert {state: int((states == state).sum()) for state in State} == {
        State.IDLE: 30,
        State.BEND: 60,
        State.TOUCH: 90,
    }
    for length in range(1, len(states) + 1):
        for state, share in shares.items():
            assert abs((states[:length] == state).sum() - share * length) <= 2.0


def test_groups_are_not_tied_to_specimens():
    recipe = dataclasses.replace(
        MIXED,
        scenes=(SceneGroup("idle", count=100), SceneGroup("bend", count=100, angle_deg=(1.0, 2.0))),
        specimens=Specimens(count=2),
    )
    drawn = [sample(recipe, index) for index in range(recipe.frames)]
    idle_of_first = sum(s.state == State.IDLE and s.specimen == 0 for s in drawn)
    assert 25 < idle_of_first < 75


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
    assert min(angles) < -15.0
    assert max(angles) > 45.0


def test_a_frame_depends_on_seed_and_number_alone():
    backwards = [sample(MIXED, index) for index in reversed(range(20))][::-1]
    assert backwards == [sample(MIXED, index) for index in range(20)]
    assert [s.scene for s in backwards] != [sample(with_seed(MIXED, 6), i).scene for i in range(20)]
    draws = {
        float(generator(MIXED, stream, index).uniform()) for stream in Stream for index in range(9)
    }
    assert len(draws) == len(Stream) * 9


def test_listed_positions_are_pressed_repeats_times_each():
    places = ((0.02, 0.02), (0.05, 0.03), (0.1, 0.04))
    recipe = Recipe("listed", scenes=(SceneGroup("touch", positions=places, repeats=4),))
    pressed = [sample(recipe, index).scene.touches for index in range(recipe.frames)]
    assert recipe.frames == 12
    assert all(len(touches) == 1 for touches in pressed)
    assert sorted((t.x, t.y) for (t,) in pressed) == sorted(places * 4)


def test_places_are_spread_evenly():
    rng = np.random.default_rng(0)
    outline = Rectangle(0.150, 0.060)
    places = np.array([draw_places(1, outline, 0.010, 0.030, rng)[0] for _ in range(2000)])
    # Uniform over 130 x 40 mm: means in the middle, standard deviations length / sqrt(12).
    assert np.allclose(places.mean(axis=0), [0.075, 0.030], atol=3 * 0.0375 / np.sqrt(2000))
    assert np.allclose(places.std(axis=0), np.array([0.130, 0.040]) / np.sqrt(12), rtol=0.05)


def test_without_spread_every_specimen_is_nominal():
    recipe = dataclasses.replace(MIXED, specimens=Specimens(count=4))
    for number in range(4):
        assert specimen(recipe, number).design == recipe.sensor
        assert specimen(recipe, number).hinge == recipe.hinge


def test_specimens_differ_by_the_spread_that_was_asked_for():
    spread = Specimens(400, conductivity=0.1, contact_impedance=0.3, hinge_offset=0.0005)
    recipe = dataclasses.replace(MIXED, specimens=spread)
    made = [specimen(recipe, number) for number in range(400)]
    conductivity = np.array([m.design.conductivity for m in made])
    contact = np.array([[e.contact_impedance for e in m.design.electrodes] for m in made])
    offset = np.array([m.hinge.offset for m in made])
    # Four standard errors of a standard deviation from n samples: 4 / sqrt(2 n).
    assert conductivity.std() / conductivity.mean() == pytest.approx(0.1, rel=0.14)
    assert contact.std() / contact.mean() == pytest.approx(0.3, rel=0.1)
    assert offset.std() == pytest.approx(0.0005, rel=0.14)
    assert abs(np.corrcoef(contact[:, 0], contact[:, 1])[0, 1]) < 0.2


def test_touches_lie_on_the_sensor_whatever_its_outline():
    disc = Disc(0.04)
    design = SensorDesign(disc, 0.005, uniform(disc, 8))
    group = SceneGroup("touch", count=50, touches=(1, 2), margin=0.010, spacing=0.02)
    recipe = Recipe("round", scenes=(group,), sensor=design)
    drawn = [sample(recipe, index).scene.touches for index in range(recipe.frames)]
    places = np.array([(touch.x, touch.y) for touches in drawn for touch in touches])
    assert np.hypot(*(places - 0.04).T).max() <= 0.030
    with pytest.raises(ConfigurationError, match=r"\(0.005, 0.005\) m is off the"):
        Recipe("off", scenes=(SceneGroup("touch", positions=((0.005, 0.005),)),), sensor=design)


def test_a_surface_can_be_no_sensor_of_a_recipe(tmp_path):
    import trimesh

    trimesh.creation.box(bounds=[[0, 0, 0], [0.15, 0.06, 0.005]]).export(tmp_path / "box.stl")
    pads = tuple(Electrode(x, 0.03, z=0.005, on="surface") for x in (0.02, 0.12))
    design = SensorDesign(Surface(tmp_path / "box.stl"), 0.005, pads)
    with pytest.raises(ConfigurationError, match="need a rectangle, disc or polygon"):
        Recipe("solid", scenes=(IDLE,), sensor=design)


def test_conductivities_of_layers_scatter_together():
    layers = (Layer(0.002, 0.5), Layer(0.003, 2.0))
    design = dataclasses.replace(SensorDesign.reference(), layers=layers)
    spread = Specimens(50, conductivity=0.1)
    recipe = dataclasses.replace(MIXED, specimens=spread, sensor=design)
    made = [specimen(recipe, number).design.layers for number in range(50)]
    conductivity = np.array([[layer.conductivity for layer in layers] for layers in made])
    assert conductivity[:, 1] / conductivity[:, 0] == pytest.approx(np.full(50, 4.0))
    assert 0.05 < np.log(conductivity[:, 0] / 0.5).std() < 0.15
