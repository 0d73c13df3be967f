"""`eitskin bench transfer`: worlds apart from training, scores by hand, and the command."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import printed_json

from eitskin.benchmarks.results import read_results
from eitskin.benchmarks.transfer import worlds
from eitskin.benchmarks.transfer.scores import Judged
from eitskin.datasets.recipe.frame_sampling import sample, specimen
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.datasets.store.state import State
from eitskin.training.method.predictions import FoundTouches


@pytest.mark.parametrize("world", worlds.WORLDS)
def test_the_known_angles_are_of_the_sensors_that_are_judged(world):
    frames, known = worlds.recipes(world, 0, quick=True)
    assert frames.seed == known.seed
    assert frames.specimens == known.specimens
    assert [specimen(frames, n) for n in range(2)] == [specimen(known, n) for n in range(2)]
    told = [(each.specimen, each.scene.bend.angle_deg) for each in map_samples(known)]
    assert sorted(set(told)) == sorted(told)
    assert {angle for _, angle in told} == {0.0, *worlds.KNOWN_DEG}


def map_samples(recipe):
    return [sample(recipe, index) for index in range(recipe.frames)]


def test_worlds_differ_from_training_and_from_each_other():
    made = [specimen(worlds.recipes(world, 0, quick=True)[0], 0) for world in worlds.WORLDS]
    spans = {each.fixture.span for each in made}
    stiffness = {each.mechanics.encapsulation.shear_modulus for each in made}
    assert len(spans) > 2
    assert len(stiffness) > 2


def test_predictions_are_judged_by_hand():
    nan = math.nan
    data = SimpleNamespace(
        state=np.array([State.IDLE, State.BEND, State.TOUCH]),
        bend_angle_deg=np.array([0.0, 10.0, 0.0]),
        touch_x=np.array([[nan, nan], [nan, nan], [0.02, 0.09]]),
        touch_y=np.array([[nan, nan], [nan, nan], [0.03, 0.03]]),
        touch_count=np.array([0, 0, 2]),
    )
    none, wrong = FoundTouches.of([], []), FoundTouches.of([[0.05, 0.03]], [1.0])
    near = FoundTouches.of([[0.02, 0.034]], [1.0], deviation=[0.002])
    said = SimpleNamespace(
        state=np.array([State.IDLE, State.TOUCH, State.TOUCH]),
        bend_angle_deg=np.array([1.0, 7.0, 0.0]),
        bend_deviation_deg=np.array([0.5, 3.0, 1.0]),
        touches=(none, wrong, near),
    )
    judged = Judged.of(data, said)
    assert judged.right.tolist() == [True, False]
    assert judged.angle.tolist() == [1.0, -3.0]
    assert judged.angle_ratio.tolist() == [2.0, -1.0]
    assert (judged.false, judged.touches) == (1, 2)
    assert judged.place.tolist() == pytest.approx([0.004])
    assert judged.place_ratio.tolist() == pytest.approx([2.0])


@pytest.mark.slow
def test_the_command_measures_the_shipped_pipeline(tmp_path, monkeypatch):
    nominal = {"nominal": lambda recipe: replace(recipe, specimens=Specimens(2, conductivity=0.1))}
    monkeypatch.setattr(worlds, "WORLDS", nominal)
    monkeypatch.setattr(worlds, "SENSOR_FRAMES", worlds.SENSOR_FRAMES[::2])
    found = printed_json("bench", "transfer", "--quick", "--workers", 1, "--out", tmp_path)[
        "figures"
    ]
    assert read_results(tmp_path / "transfer" / "results.json").figures == pytest.approx(found)
    free = "reference / nominal, 0 angles / angle, rms [deg]"
    assert found["reference / nominal, 5 angles / angle, rms [deg]"] < found[free] < 10.0
    assert found["reference / nominal, 0 angles / untouched states right"] > 0.9
