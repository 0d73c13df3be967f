"""Recipes: what is refused, what is drawn, and that a frame depends on its number alone."""

import dataclasses

import numpy as np
import pytest

from eitskin.config import parse_toml
from eitskin.datasets import Recipe, State
from eitskin.datasets.generation.preparation import missing_tables
from eitskin.datasets.recipe import shipped_names
from eitskin.datasets.recipe.episode import EpisodeTouch, Keyframe, RandomEpisodes, ScriptedEpisode
from eitskin.datasets.recipe.frame_sampling import (
    Stream,
    generator,
    sample,
    specimen_numbers,
)
from eitskin.datasets.recipe.recipe import with_seed
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Mounts, Specimens
from eitskin.errors import ConfigurationError
from eitskin.geometry import (
    Bend,
    Free,
    FreeArc,
    Hinge,
    Plates,
    SensorDesign,
)
from eitskin.simulator import Cylinder, FourTerminalMeter, Instrument, Mechanics, Protocol, Sphere
from eitskin.simulator.mechanics.materials import Ogden

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


DESIGN = dataclasses.replace(SensorDesign.reference(), conductivity=0.5)
REVERSED = Protocol(Protocol.adjacent(8).table[::-1], 8)


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ('sensor = "sensor.toml"', "sensor", DESIGN),
        ('protocol = "adjacent"', "protocol", Protocol.adjacent(8)),
        ('protocol = "adjacent:8"', "protocol", Protocol.adjacent(8)),
        ('protocol = "pairs.csv"', "protocol", REVERSED),
        (
            '[instrument]\nboard = "ad5940"\nsnr_db = 80',
            "instrument",
            dataclasses.replace(Instrument.ad5940(), snr_db=80.0),
        ),
    ],
)
def test_a_recipe_may_name_what_lies_beside_it_and_is_written_whole(tmp_path, text, name, value):
    (tmp_path / "sensor.toml").write_text(DESIGN.to_toml(), encoding="utf-8")
    REVERSED.to_file(tmp_path / "pairs.csv")
    whole = f'name = "a"\n{text}\n[[scenes]]\nstate = "idle"\ncount = 1\n'
    recipe = Recipe.from_toml(write(tmp_path, whole))
    assert getattr(recipe, name) == value
    assert parse_toml(Recipe, recipe.to_toml()) == recipe


ROLLED = SceneGroup(
    "touch", 12, (0.0, 30.0), per_bend=4, roll_deg=(20.0, 60.0), indenter=Sphere(8e-3)
)
ON_AN_ARC = dataclasses.replace(MIXED, scenes=(ROLLED,), fixture=FreeArc(0.1))


def test_a_group_may_be_pressed_by_an_indenter_whose_tables_are_solved_before(
    tmp_path, monkeypatch
):
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
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    balls = dataclasses.replace(ON_AN_ARC, scenes=(TOUCHED, ROLLED))
    smaller = dataclasses.replace(ROLLED, indenter=Sphere(5e-3))
    more = dataclasses.replace(balls, scenes=(TOUCHED, ROLLED, smaller))
    needed, also = missing_tables(balls), missing_tables(more)
    assert needed  # those of the cylinder come with eitskin
    assert needed < also


def scenes(group, **changes):
    return {"scenes": (dataclasses.replace(group, **changes),)}


def scripted(*keyframes, **changes):
    return {"episodes": (ScriptedEpisode(keyframes, **changes),)}


def random(**changes):
    usual = {"count": 1, "frames": 1, "angle_deg": (0.0, 30.0)}
    return {"episodes": (RandomEpisodes(**(usual | changes)),)}


UNENDING = Keyframe(0.0), Keyframe(1e300)
OFF = Keyframe(0.0, touches=(EpisodeTouch(0.2, 0.0),))
PULLED = Keyframe(0.0, touches=(EpisodeTouch(0.1, 0.03, -1.0),))


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
        ({"seed": -1}, "seed must be"),
        ({"frames_per_shard": 0}, "frames_per_shard must be"),
        (scenes(IDLE, touches=(2, 3)), "state 'idle' has no touches, so leave out touches"),
        (scenes(IDLE, angle_deg=(0.0, 10.0)), "an idle sensor is flat"),
        (scenes(BENT, count=0), "count must be at least 1"),
        (scenes(BENT, angle_deg=(0.0, 0.0)), "state 'bend' needs a range"),
        (scenes(BENT, angle_deg=(-400.0, 0.0)), "a bend of -400 deg is beyond the clamp"),
        (scenes(TOUCHED, force=(-5.0, 50.0)), "force must be a rising range.* above 0"),
        (scenes(TOUCHED, touches=(0, 9)), "touches must be from 1 to 4"),
        (scenes(TOUCHED, touches=(4, 4), spacing=0.1), "4 touches 0.1 m apart"),
        (scenes(TOUCHED, positions=((0.02, 0.02),)), "count follows from positions"),
        (scenes(TOUCHED, positions=((0.02, 0.02),), repeats=0), "repeats must be at least 1"),
        (scenes(TOUCHED, positions=((15.0, 0.1),)), r"position \(15, 0.1\) m is off"),
        (scenes(TOUCHED, per_bend=0), "per_bend must be at least 1"),
        (scripted(Keyframe(1.0), Keyframe(2.0)), "at least two, rising in time from 0 s"),
        (scripted(OFF, Keyframe(2.0)), r"position \(0.2, 0\) m is off"),
        (scripted(PULLED, Keyframe(2.0)), "a force that is not above 0 N"),
        (scripted(Keyframe(0.0), Keyframe(1.0), count=0), "count must be at least 1"),
        (scripted(Keyframe(0.0), Keyframe(1.0), period=-1.0), "period must be a time above 0 s"),
        (scripted(*UNENDING, period=1e-308), "frames"),
        (scripted(*UNENDING, period=0.0), "frames"),
        (scripted(*UNENDING, repeats=2**62), "frames"),
        (random(frames=0), "frames must be from 1"),
        (random(angle_deg=(9.0, 3.0)), "angle_deg must be a rising range"),
        (random(hold_s=(0.0, 1.0)), "hold_s must be a rising range.* above 0"),
        (random(touches=(5, 5)), "touches must be from 1 to 4"),
        (random(angle_deg=(0.0, 300.0)), "a bend of 300 deg is beyond the clamp"),
        (random(period=0.2) | {"instrument": Instrument.ad5940()}, "at least the 0.2862 s"),
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
def test_recipes_that_cannot_be_made_are_refused_with_all_reasons(changes, message):
    with pytest.raises(ConfigurationError, match=message) as caught:
        dataclasses.replace(MIXED, name="", **changes)
    assert "name must not be empty" in str(caught.value)


# Frames that are drawn

GROUPED = Recipe(
    "grouped",
    seed=6,
    frames_per_shard=25,
    specimens=Specimens(3, conductivity=0.01),
    scenes=(IDLE, dataclasses.replace(TOUCHED, per_bend=8)),
)


def all_samples(recipe):
    return [sample(recipe, index) for index in range(recipe.frames)]


@pytest.mark.slow
def test_frames_hold_what_their_group_says_by_seed_and_number_alone():
    outline = MIXED.sensor.outline
    for drawn in all_samples(MIXED):
        touches = drawn.scene.touches
        if drawn.state == State.IDLE:
            assert drawn.scene.bend == Bend(0.0)
        if drawn.state != State.TOUCH:
            assert touches == ()
            continue
        places = np.array([(touch.x, touch.y) for touch in touches])
        assert (places >= 0.012).all()
        assert (places <= np.array([outline.length, outline.width]) - 0.012).all()
        gaps = np.linalg.norm(places[:, None] - places, axis=-1)
        assert (gaps[np.triu_indices(len(places), 1)] >= 0.030).all()
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
