"""Places learned from few presses, on toy skins and on a measured one, and in a session."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from touched_dataset import touched_dataset
from toy_skin import toy_presses

from eitskin.cli.commands import train
from eitskin.datasets import RecordingNames, State, read_recording, save_dataset
from eitskin.errors import DataError, FrameError, UnusableFrameError
from eitskin.simulator import Frame, Protocol
from eitskin.training import Pipeline, PositionScore, TrainingSettings, open_pipeline
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


# Positions in a session: live, on a replay, saved and opened

PROTOCOL = Protocol.pairwise(6)
OWN = 0.05 * np.stack([np.cos(np.arange(15)), np.sin(np.arange(15))], axis=1)
FLAT = np.linspace(100.0, 300.0, 15)
PRESS = (0.021, -0.012)


def pressed(places, strength=1.0):
    """Values of a toy skin, each channel sensitive near its own position."""
    distance = np.linalg.norm(np.atleast_2d(places)[:, None] - OWN, axis=2)
    return FLAT * (1.0 + 0.05 * strength * np.exp(-((distance / 0.03) ** 2)))


def recording():
    """Presses alone: no untouched frame, no bend, no force."""
    places = np.random.default_rng(0).uniform(-0.04, 0.04, (60, 2))
    labels = {"state": np.full(60, State.TOUCH), "time": np.arange(60.0), "episode": np.zeros(60)}
    return touched_dataset(pressed(places), FLAT, places, protocol=PROTOCOL, **labels)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("presses")
    save_dataset(recording(), made / "data")
    train.command(made / "data", out=made / "skin.eitmodel", quiet=True)
    return made


@pytest.fixture
def opened(folder):
    return open_pipeline(folder / "skin.eitmodel")


def frame(values, number, **changes):
    values = np.asarray(values, dtype=complex).reshape(-1)
    return Frame(values, PROTOCOL, 0.1 * number, number, **changes)


@pytest.mark.slow
def test_a_press_has_a_position_and_nothing_else(opened):
    assert opened.targets.missing == ("the state", "the bend angle", "forces")
    noise = 1.0 + 1e-4 * np.random.default_rng(1).standard_normal((5, 15))
    for number, values in enumerate(FLAT * noise):
        assert opened.process(frame(values, number)).touches == ()
    estimate = opened.process(frame(pressed(PRESS), 5))
    ((x, y, strength),) = estimate.touches
    assert np.hypot(x - PRESS[0], y - PRESS[1]) < 0.004
    assert 0.2 < strength <= 1.0
    unknown = (estimate.state, estimate.bend_angle_deg, estimate.touch_map)
    assert unknown == (None, None, None)
    assert np.isnan(estimate.probabilities).all()
    assert np.isnan(estimate.touches[0].force)
    assert opened.process(frame(FLAT, 6)).touches == ()


@pytest.mark.slow
def test_bad_channels_are_left_out_and_other_frames_refused(opened):
    opened.process(frame(FLAT, 0))
    values = pressed(PRESS)
    values[0, 3] = np.nan
    estimate = opened.process(frame(values, 1))
    assert "channel 0-4 is left out" in estimate.problems[0]
    assert np.hypot(estimate.touches[0][0] - PRESS[0], estimate.touches[0][1] - PRESS[1]) < 0.01
    with pytest.raises(UnusableFrameError):
        opened.process(frame(np.full(15, np.nan), 2))
    with pytest.raises(FrameError, match="15 measurements"):
        opened.process(Frame(np.ones(28), Protocol.pairwise(8)))
    table = Protocol((PROTOCOL.table[1], PROTOCOL.table[0], *PROTOCOL.table[2:]), 6)
    with pytest.raises(FrameError, match="trained for"):
        opened.process(Frame(FLAT, table))
    with pytest.raises(FrameError, match="40000 Hz"):
        opened.process(frame(FLAT, 3, frequency=1e3))
