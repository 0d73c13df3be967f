"""`eitskin adapt`: pipelines of both kinds, errors by frames used, and what is refused."""

from types import SimpleNamespace

import numpy as np
import pytest
from command_line import printed_json, run
from touched_dataset import touched_dataset
from toy_skin import toy_presses

from eitskin.datasets import State, save_dataset
from eitskin.errors import ConfigurationError
from eitskin.training import Pipeline, open_pipeline
from eitskin.training.adaptation.press_fit import LabelledPresses
from eitskin.training.evaluation import adaptation_curve
from eitskin.training.evaluation.adaptation_curve import press_curve

pytestmark = pytest.mark.slow

GAIN = 1.1  # by which the sensor of the test answers bends more than the usual one


@pytest.fixture(scope="module")
def bends(pipeline):
    """Untouched frames of one sensor at known angles."""
    rng, known = np.random.default_rng(0), pipeline.flat_sensors
    angles = rng.permutation(np.linspace(-18.0, 48.0, 21))
    share = GAIN * angles[:, None] / 45.0
    flat = pipeline.layout.reference
    frames = flat * np.exp(share * known.bend[0] + share**2 * known.bend[1])
    return touched_dataset(
        frames * (1.0 + 2e-4 * rng.normal(size=frames.shape)),
        flat,
        state=np.full(len(angles), State.BEND),
        bend_angle_deg=angles,
        time=np.arange(len(angles)),
        protocol=pipeline.layout.protocol,
        frequency=pipeline.layout.frequency,
        design=pipeline.layout.design,
    )


def nearest(presses):
    """Places of the press that is most alike, in place of maps, which take seconds."""

    def apply(ratios):
        away = np.linalg.norm(np.log(ratios)[:, None] - np.log(presses.ratios), axis=2)
        return presses.places[away.argmin(axis=1)]

    return SimpleNamespace(locator=SimpleNamespace(apply=apply))


@pytest.fixture(autouse=True)
def few_trees(monkeypatch):
    monkeypatch.setattr(adaptation_curve, "TREES", 10)


def test_known_angles_of_a_recording_adapt_a_pipeline_and_errors_fall(bends, pipeline, tmp_path):
    save_dataset(bends, tmp_path / "bends")
    mine = tmp_path / "mine.eitmodel"
    said = printed_json("adapt", "reference.eitmodel", tmp_path / "bends", "--out", mine)
    assert said["adaptation"]["bends"] == len(bends)
    points = {(each["method"], each["frames"]): each for each in said["errors"]}
    before, after = points["as trained", 0]["angle_deg"], points["adapted", 14]["angle_deg"]
    assert after < 0.5 * before
    assert points["ExtraTrees", 14]["angle_deg"] < points["ExtraTrees", 5]["angle_deg"]
    adapted = Pipeline.load(mine)
    off = adapted.perceive(bends).bend_angle_deg - bends.bend_angle_deg
    assert np.sqrt(np.mean(off**2)) < 0.5 * before
    assert pipeline.adaptation == {}  # curve and command leave the pipeline itself alone


def test_blocks_of_time_are_tested_with_frames_of_the_others(monkeypatch):
    """Presses of each third of the time are alike; from the others none can be found."""
    places = np.repeat([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]], 5, axis=0)
    ratios = np.exp(places @ np.ones((2, 3)) + places @ np.array([[1.0, 2, 3], [3, 2, 1]]))
    monkeypatch.setattr(adaptation_curve, "learn_places", nearest)
    points = press_curve(LabelledPresses(ratios, places))
    assert {(each.method, each.frames) for each in points} == {
        (method, count) for method in ("adapted", "ExtraTrees") for count in (5, 10)
    }
    assert all(each.place_mm > 70.0 and each.found == 1.0 for each in points)


def test_touch_positions_are_learned_where_nothing_was_before(monkeypatch, tmp_path):
    """The pipeline that stands under a name is replaced only with --replace."""
    monkeypatch.setattr(adaptation_curve, "learn_places", nearest)
    ratio, places, depth = toy_presses(25)
    known = {"state": np.full(25, State.TOUCH), "time": np.arange(25)}
    known["touch_depth"] = np.where(np.arange(4) == 0, depth[:, None], np.nan)
    save_dataset(touched_dataset(ratio, np.ones(8), places, **known), tmp_path / "presses")
    first, second = tmp_path / "first.eitmodel", tmp_path / "second.eitmodel"
    said = printed_json("adapt", "none", tmp_path / "presses", "--out", first)
    assert said["adaptation"]["mean_error_mm"] < 3.0
    assert {each["method"] for each in said["errors"]} == {"adapted", "ExtraTrees"}
    assert open_pipeline(first).trained_on["frames"] == 25
    words = ("adapt", first, tmp_path / "presses", "--out", second, "--no-table")
    assert "touch positions from 25 frames" in run(*words).stdout
    with pytest.raises(ConfigurationError, match="--replace"):
        run(*words)
    assert "touch positions from 25 frames" in run(*words, "--replace").stdout
