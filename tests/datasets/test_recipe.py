"""Recipes: what is refused, what is drawn, and that a frame depends on its number alone."""

import dataclasses
import tomllib

import numpy as np
import pytest

from eitskin.config import parse_toml
from eitskin.datasets import Recipe
from eitskin.datasets.generation.preparation import missing_press_tables
from eitskin.datasets.recipe import shipped_names
from eitskin.datasets.recipe.episode import EpisodeTouch, Keyframe, RandomEpisodes, ScriptedEpisode
from eitskin.datasets.recipe.frame_sampling import sample, specimen
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Mounts, Specimens
from eitskin.errors import ConfigurationError
from eitskin.geometry import (
    Electrode,
    Free,
    FreeArc,
    Hinge,
    Plates,
    SensorDesign,
    Surface,
)
from eitskin.simulator import FourTerminalMeter, Instrument, Mechanics, Protocol
from eitskin.simulator.mechanics.materials import Ogden
from eitskin.simulator.scene.indenters import Cylinder, Sphere

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


EPISODES = dataclasses.replace(
    MIXED,
    episodes=(
        ScriptedEpisode(
            (Keyframe(0.0), Keyframe(3.0, 20.0, (EpisodeTouch(0.05, 0.03),)), Keyframe(5.0))
        ),
        RandomEpisodes(2, 9, angle_deg=(0.0, 30.0), relaxation=False),
    ),
    mechanics=Mechanics(gel=Ogden(15e3, 2.0), margin=0.004),
    instrument=Instrument.ad5940(),
)
AWKWARD = dataclasses.replace(
    MIXED,
    description='quotes " and \\ and\nlines and ü and \x7f',
    specimens=Specimens(3, conductivity=0.05),
    fixture=Hinge(span=0.05, offset=0.007),
    instrument=Instrument(60.0),
)


@pytest.mark.parametrize(
    "recipe",
    [*map(Recipe.from_shipped, shipped_names()), EPISODES, AWKWARD],
    ids=lambda each: each.name,
)
def test_recipes_are_the_same_after_writing_and_reading(recipe, tmp_path):
    assert Recipe.from_toml(write(tmp_path, recipe.to_toml())) == recipe


def test_paper_recipes_hold_the_numbers_of_the_paper():
    assert all(Recipe.from_shipped(name).name == name for name in shipped_names())
    idle, bent, pressed = Recipe.from_shipped("paper_states").scenes
    assert [idle.frames, bent.frames, pressed.frames] == [360] * 3
    assert (bent.angle_deg, pressed.touches) == ((-20.0, 50.0), (1, 4))
    bending = Recipe.from_shipped("paper_bending")
    assert (bending.snapshots, bending.episodes[0].angles_deg) == (360, (-20.0, 50.0))
    (indentation,) = Recipe.from_shipped("paper_indentation").scenes
    grid = np.array([(x, y) for x in np.arange(15, 136, 15) for y in (15, 30, 45)]) / 1e3
    assert np.allclose(sorted(indentation.positions), grid)
    assert (indentation.repeats, indentation.force) == (8, (10.0, 10.0))
    assert [(g.touches, g.angle_deg) for g in Recipe.from_shipped("paper_touch").scenes] == [
        ((1, 1), (-10.0, 50.0)),
        *(((n, n), (0.0, 30.0)) for n in (2, 3, 4)),
    ]
    (demo,) = Recipe.from_shipped("paper_demo").episodes
    presses = [(k.angle_deg, len(k.touches)) for k in demo.keyframes if k.touches]
    assert presses == [(-10.0, 2), (20.0, 3), (40.0, 4), (0.0, 4)]
    assert demo.period == 0.303


def test_shipped_recipes_have_episodes_or_terms_of_a_board_for_those_who_ask():
    for name in ("quick", "quick_test", "paper_states", "paper_indentation"):
        recipe = Recipe.from_shipped(name)
        assert (recipe.episodes, recipe.specimens.count) == ((), 1)
        assert recipe.instrument == Instrument(75.0)
    training = Recipe.from_shipped("training")
    assert training.specimens.count >= 50
    assert training.instrument.measurement_time > 0.0
    assert any(group.per_bend > 1 for group in training.scenes)


def test_episodes_are_not_cut():
    recipe = Recipe(
        "uncut",
        scenes=(IDLE,),
        episodes=(RandomEpisodes(count=5, frames=10), RandomEpisodes(count=2, frames=40)),
        frames_per_shard=25,
    )
    assert (recipe.snapshots, recipe.frames) == (30, 160)
    lengths = [len(recipe.shard_range(shard)) for shard in range(recipe.shards)]
    assert lengths == [25, 5, 20, 20, 10, 40, 40]
    joined = [index for shard in range(recipe.shards) for index in recipe.shard_range(shard)]
    assert joined == list(range(160))


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
                SceneGroup("touch", count=1, per_bend=0),
            ),
            episodes=(
                ScriptedEpisode((Keyframe(1.0), Keyframe(2.0))),
                ScriptedEpisode(
                    (Keyframe(0.0, touches=(EpisodeTouch(0.2, 0.0, -1.0),)), Keyframe(2.0))
                ),
                ScriptedEpisode((Keyframe(0.0), Keyframe(1.0, 400.0)), count=0, period=-1.0),
                RandomEpisodes(1, 0, angle_deg=(9.0, 3.0), hold_s=(0.0, 1.0), touches=(5, 5)),
                RandomEpisodes(1, 1, angle_deg=(0.0, 300.0), period=0.2),
            ),
            instrument=Instrument.ad5940(),
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
        "scenes[2] (touch): force must be a rising range [lowest, highest], above 0",
        "scenes[2] (touch): touches must be from 1 to 4",
        "scenes[3] (touch): 4 touches 0.1 m apart",
        "scenes[4] (touch): count follows from positions",
        "scenes[4] (touch): repeats must be at least 1",
        "scenes[4] (touch): position (15, 0.1) m is off",
        "scenes[5] (bend): a bend of -400 deg is beyond the clamp",
        "scenes[6] (touch): per_bend must be at least 1",
        "episodes[0]: keyframes must be at least two, rising in time from 0 s, got",
        "episodes[1]: position (0.2, 0) m is off",
        "episodes[1]: keyframes[0] has a force that is not above 0 N",
        "episodes[2]: count must be at least 1",
        "episodes[2]: period must be a time above 0 s",
        "episodes[3]: frames must be from 1",
        "episodes[3]: angle_deg must be a rising range [lowest, highest]",
        "episodes[3]: hold_s must be a rising range [lowest, highest], above 0",
        "episodes[3]: touches must be from 1 to 4",
        "episodes[4]: a bend of 300 deg is beyond the clamp",
        "episodes[4]: period must be at least the 0.2862 s",
    ):
        assert expected in message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name = "a"\n[[scenes]]\nstate = "idle"\ncuont = 1\n', r"'cuont';.*'count'"),
        ("name = ", "recipe"),
    ],
)
def test_misspelt_keys_and_broken_and_missing_files_are_refused(tmp_path, text, message):
    with pytest.raises(ConfigurationError, match="recipe"):
        Recipe.from_toml(tmp_path / "recipe.toml")
    with pytest.raises(ConfigurationError, match=message):
        Recipe.from_toml(write(tmp_path, text))


ADJACENT = 'name = "a"\nprotocol = "{}"\n[[scenes]]\nstate = "idle"\ncount = 1\n'


@pytest.mark.parametrize("name", ["adjacent", "adjacent:8", "pairs.csv"])
def test_a_recipe_names_its_protocol_and_is_written_with_it(tmp_path, name):
    Protocol.adjacent(8).to_file(tmp_path / "pairs.csv")
    recipe = Recipe.from_toml(write(tmp_path, ADJACENT.format(name)))
    assert recipe.measured_protocol == Protocol.adjacent(8)
    assert 'protocol = "adjacent:8"' in recipe.to_toml()
    assert parse_toml(Recipe, recipe.to_toml()) == recipe


def test_a_recipe_with_a_table_of_its_own_needs_no_other_file(tmp_path):
    table = Protocol(Protocol.adjacent(8).table[::-1], 8)
    table.to_file(tmp_path / "pairs.csv")
    recipe = Recipe.from_toml(write(tmp_path, ADJACENT.format("pairs.csv")))
    assert recipe.protocol == parse_toml(Recipe, recipe.to_toml()).protocol == table


def test_a_recipe_names_its_board(tmp_path):
    text = 'name = "a"\n[instrument]\nboard = "ad5940"\nsnr_db = 80\n[[scenes]]\nstate = "idle"\n'
    recipe = Recipe.from_toml(write(tmp_path, text + "count = 1\n"))
    assert recipe.instrument == dataclasses.replace(Instrument.ad5940(), snr_db=80.0)


def test_a_group_writes_what_it_wrote_before_it_could_do_more():
    """Sets that were begun then are resumed by their recipe's text."""
    (group,) = tomllib.loads(Recipe("one", scenes=(IDLE,)).to_toml())["scenes"]
    assert list(group) == [
        *("state", "count", "angle_deg", "touches", "force", "margin", "spacing", "positions"),
        *("repeats", "per_bend"),
    ]


ON_PLATES = SceneGroup("touch", positions=((0.02, 0.03), (0.13, 0.03)), support=Plates())


def test_a_group_of_scenes_may_have_a_support_of_its_own(tmp_path):
    recipe = dataclasses.replace(MIXED, scenes=(IDLE, ON_PLATES))
    assert Recipe.from_toml(write(tmp_path, recipe.to_toml())) == recipe
    found = [sample(recipe, index).scene.support for index in range(recipe.frames)]
    assert found.count(Plates()) == 2
    assert found.count(None) == IDLE.count


def test_plates_are_as_far_apart_as_each_specimen_s_hinge():
    recipe = dataclasses.replace(
        MIXED,
        sensor=dataclasses.replace(MIXED.sensor, support=Plates()),
        scenes=(dataclasses.replace(BENT, support=Plates()),),
        specimens=Specimens(5, hinge_span=1e-3),
    )
    drawn = [sample(recipe, index) for index in range(recipe.frames)]
    spans = {each.scene.support.span for each in drawn}
    assert len(spans) == 5
    for each in drawn:
        made = specimen(recipe, each.specimen)
        assert each.scene.support.span == pytest.approx(made.fixture.span, abs=1e-12)
        assert made.design.support.span == pytest.approx(made.fixture.span, abs=1e-12)


ROLLED = SceneGroup(
    "touch", 12, (0.0, 30.0), per_bend=4, roll_deg=(20.0, 60.0), indenter=Sphere(8e-3)
)
ON_AN_ARC = dataclasses.replace(MIXED, scenes=(ROLLED,), fixture=FreeArc(0.1))


def test_a_group_may_be_rolled_and_pressed_by_another_indenter(tmp_path):
    assert Recipe.from_toml(write(tmp_path, ON_AN_ARC.to_toml())) == ON_AN_ARC
    drawn = [sample(ON_AN_ARC, index).scene for index in range(12)]
    rolls = [scene.roll.angle_deg for scene in drawn]
    assert all(20.0 <= roll <= 60.0 for roll in rolls)
    assert [len(set(rolls[k : k + 4])) for k in (0, 4, 8)] == [1, 1, 1], "one in a block"
    assert len(set(rolls)) == 3
    assert {touch.indenter for scene in drawn for touch in scene.touches} == {Sphere(8e-3)}
    plain = dataclasses.replace(ROLLED, roll_deg=(0.0, 0.0), indenter=Cylinder())
    for index, scene in enumerate(drawn):  # all else is drawn as it is without them
        other = sample(dataclasses.replace(ON_AN_ARC, scenes=(plain,)), index).scene
        assert (scene.bend, scene.touches[0].force) == (other.bend, other.touches[0].force)


def test_tables_of_every_indenter_are_solved_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    balls = dataclasses.replace(ON_AN_ARC, scenes=(TOUCHED, ROLLED))
    smaller = dataclasses.replace(ROLLED, indenter=Sphere(5e-3))
    more = dataclasses.replace(balls, scenes=(TOUCHED, ROLLED, smaller))
    needed, also = missing_press_tables(balls), missing_press_tables(more)
    assert needed  # those of the cylinder come with eitskin
    assert needed < also


def scenes(group, **changes):
    return {"scenes": (dataclasses.replace(group, **changes),)}


def unending(**changes):
    return {"episodes": (ScriptedEpisode((Keyframe(0.0), Keyframe(1e300)), **changes),)}


def spread(**changes):
    bent = SceneGroup("bend", count=1, angle_deg=(-60.0, 0.0))
    return {"scenes": (bent,), "specimens": Specimens(**changes)}


def mounts(**changes):
    usual = {"span": (0.025, 0.060), "offset": (0.004, 0.014), "stiffness": (0.5, 2.0)}
    return {"mounts": Mounts(**({"count": 12} | usual | changes))}


def loads(size, meter):
    return {"specimens": Specimens(board_loads=size), "instrument": Instrument(meter=meter)}


ARC = {"fixture": FreeArc(0.1)}
SHORTER = {"fixture": Hinge(), "specimens": Specimens(hinge_span=0.003)}  # for some specimens
FREE = dataclasses.replace(SensorDesign.reference(), support=Free())
LEAKS = Instrument(meter=FourTerminalMeter(leaks=(1e-6, 1e-6)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (unending(period=1e-308), "frames"),
        (unending(period=0.0), "frames"),
        (unending(repeats=2**62), "frames"),
        ({"protocol": Protocol.adjacent(16)}, "for 16 electrodes, the sensor has 8"),
        ({"protocol": Protocol.adjacent(8), "instrument": LEAKS}, "instrument: leaks"),
        (scenes(TOUCHED, support=Free()), r"scenes\[0\] \(touch\): a free membrane"),
        (scenes(BENT, support=Plates(0.03)), "0.03 m apart"),
        (scenes(IDLE, support=Plates(0.2)), "length of 0.15 m"),
        ({"sensor": FREE, "scenes": (), "episodes": EPISODES.episodes}, r"episodes\[0\]: a free"),
        (scenes(ROLLED), "kinematic fixture"),
        (scenes(IDLE, roll_deg=(0.0, 5.0)) | ARC, "an idle sensor is flat"),
        (scenes(ROLLED, roll_deg=(5.0, 0.0)) | ARC, "roll_deg must be"),
        (scenes(BENT, indenter=Sphere(8e-3)) | ARC, "leave out indenter"),
        (scenes(TOUCHED, indenter=Sphere(0.02)) | ARC, "indenter's 0.04 m"),
        (spread(count=0), r"count.*from 1"),
        (spread(conductivity=1.1), r"conductivity.*0 to 1, got 1.1"),
        (spread(thickness=0.06), r"thickness.*0 to 0.05, got 0.06"),
        (spread(gel_modulus=float("nan")), "gel_modulus"),
        (spread(electrode_place=0.007), r"electrode_place.*0.00667"),
        (spread(hinge_offset=0.02), r"hinge_offset.*0 to 0.01 m"),
        (spread(hinge_span=0.009), "bend of -60 deg"),
        (spread(hinge_span=0.005) | {"fixture": Hinge(span=0.015)}, "hinge_span"),
        (scenes(BENT, angle_deg=(-65.0, 0.0)) | SHORTER, "bend of -65 deg"),
        (spread(board_loads=11.0), "board_loads must be from 0 to 10"),
        (loads(1.0, None), "board_loads is the spread"),
        (loads(1.0, FourTerminalMeter(scale=2.0)), "board_loads is the spread"),
        (mounts(count=-1), "mounts"),
        (mounts(span=(0.06, 0.03)), "mounts"),
        (mounts(span=(0.03, 0.2)), "mounts"),
        (mounts(offset=(0.0, float("nan"))), "mounts"),
        (mounts(stiffness=(0.0, 1.0)), "mounts"),
        (mounts(faces=()), "mounts"),
        (mounts() | {"fixture": Hinge()}, "mounts take the place"),
    ],
)
def test_recipes_that_cannot_be_made_are_refused(changes, message):
    with pytest.raises(ConfigurationError, match=message):
        dataclasses.replace(MIXED, **changes)


def test_a_surface_can_be_no_sensor_of_a_recipe(tmp_path):
    import trimesh

    trimesh.creation.box(bounds=[[0, 0, 0], [0.15, 0.06, 0.005]]).export(tmp_path / "box.stl")
    pads = tuple(Electrode(x, 0.03, z=0.005, on="surface") for x in (0.02, 0.12))
    design = SensorDesign(Surface(tmp_path / "box.stl"), 0.005, pads)
    with pytest.raises(ConfigurationError, match="rectangle, disc or polygon"):
        dataclasses.replace(MIXED, sensor=design)
