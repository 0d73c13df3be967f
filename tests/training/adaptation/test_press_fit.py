"""Places learned from few presses, on a toy skin and on a measured one."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from toy_skin import toy_presses

from eitskin.datasets import RecordingNames, read_recording
from eitskin.errors import DataError
from eitskin.training import Pipeline, PositionScore, TrainingSettings
from eitskin.training.adaptation.locator import (
    MapGrid,
    PressLocator,
)
from eitskin.training.adaptation.press_fit import LabelledPresses, learn_places

DATA = Path(os.environ.get("EITSKIN_DATA", Path(__file__).parents[4] / "shared" / "data"))

POSITIONS = TrainingSettings("touch position")


@pytest.fixture(scope="module")
def learned():
    ratio, places, depth = toy_presses()
    return learn_places(LabelledPresses(ratio, places, depth))


@pytest.mark.slow
def test_places_strength_and_standard_errors(learned):
    ratio, places, depth = toy_presses(30, seed=1)
    found, left_out = learned.locator.locate(ratio)
    error = np.linalg.norm(found.place - places, axis=1)
    assert np.median(error) < 1e-3
    assert 0.35 < np.sqrt(np.mean((error / found.deviation) ** 2)) < 1.5
    assert not left_out.any()
    assert abs(learned.law.exponent - 1.5) < 0.1
    inner = np.abs(places).max(axis=1) < 0.04
    np.testing.assert_allclose(found.strength[inner], learned.law.strength(depth[inner]), rtol=0.1)


@pytest.mark.slow
def test_strength_is_learned_where_no_depth_is_known():
    ratio, places, _ = toy_presses()
    other, where, _ = toy_presses(60, seed=1)
    blind = learn_places(LabelledPresses(ratio, places))
    assert blind.law is None
    error = np.linalg.norm(blind.locator.apply(other) - where, axis=1)
    assert np.median(error) < 1.5e-3


@pytest.mark.slow
def test_a_channel_that_is_lost_in_half_of_the_presses_costs_no_press():
    ratio, places, depth = toy_presses()
    ratio[len(ratio) // 2 :, 0] = np.nan
    validated = learn_places(LabelledPresses(ratio, places, depth)).validated
    assert validated["presses"] == len(places)
    assert validated["mean_error_mm"] < 3


@pytest.mark.slow
def test_few_presses_are_explained_in_several_ways():
    """Places are means over them, in whatever units each has its channels, and saved with them."""
    ratio, places, depth = toy_presses(6)
    few = learn_places(LabelledPresses(ratio, places, depth)).locator
    assert len(few.others) == 3  # lengths and noises, without a design
    other = toy_presses(20, seed=5)[0]
    answers = np.log(other) / few.gain
    alone = [grid.locate(answers).place for grid in (few.grid, *few.others)]
    drawn = few.grid.middle + few.trust * (np.mean(alone, axis=0) - few.grid.middle)
    np.testing.assert_allclose(few.apply(other), drawn, atol=1e-12)
    units = np.linspace(0.5, 2.0, 8)
    scaled = dataclasses.replace(few.grid, whitening=units[:, None] * few.grid.whitening)
    same = scaled.locate(answers / units)
    np.testing.assert_allclose(same.place, alone[0], atol=1e-9)
    restored = PressLocator.from_arrays(few.arrays())
    np.testing.assert_array_equal(restored.apply(other), few.apply(other))
    assert learn_places(LabelledPresses(*toy_presses(9))).locator.others == ()


@pytest.mark.slow
def test_what_cannot_be_learned_is_refused(learned):
    ratio, places, _ = toy_presses()
    with pytest.raises(DataError, match="at least 5"):
        learn_places(LabelledPresses(ratio[:4], places[:4]))
    with pytest.raises(DataError, match="different positions"):
        learn_places(LabelledPresses(ratio, np.zeros_like(places)))
    with pytest.raises(DataError, match="8 channels, got 7"):
        learned.locator.apply(ratio[:, :7])


@pytest.mark.slow
def test_measured_hydrogel_skin():
    """500 presses of a real skin: places of the last 100 from the first 400, without a design."""
    if not (DATA / "ohmc8.mat").is_file():
        pytest.skip(f"no ohmc8.mat in {DATA}; set EITSKIN_DATA to the folder that holds it")
    names = RecordingNames("responsedowns", "responseups", "positions")
    recording = read_recording(DATA / "ohmc8.mat", names)
    score = PositionScore.from_dataset(Pipeline.fit(recording, POSITIONS), recording)
    assert score.frames == 100
    assert score.mean_error_mm < 2.5
    assert score.guess_error_mm > 40.0


# ---- locator ----


def test_a_grid_without_channels_is_that_of_maps_that_never_had_them():
    rng = np.random.default_rng(0)
    maps = rng.standard_normal((12, 10, 6))
    whitening = np.diag(rng.uniform(0.5, 2.0, 6))  # independent noise
    spread, prior = 0.01 * np.ones_like(maps), np.zeros(maps.shape[:2])
    keep = np.array([True, False, True, True, False, True])
    grid = MapGrid(np.zeros(2), 1e-3, maps, spread, prior, whitening, np.array([1.0, 0.2]))
    alone = dataclasses.replace(
        grid,
        mean=maps[..., keep],
        variance=spread[..., keep],
        whitening=whitening[np.ix_(keep, keep)],
    )
    answers = rng.standard_normal((4, 6))
    found = grid.locate(answers, np.tile(~keep, (4, 1)))
    wanted = alone.locate(answers[:, keep])
    np.testing.assert_allclose(found.place, wanted.place, atol=1e-7)
    np.testing.assert_allclose(found.deviation, wanted.deviation, rtol=1e-4)
    np.testing.assert_allclose(found.misfit[:, keep], wanted.misfit, atol=1e-3)
