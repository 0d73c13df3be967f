"""Touch positions by Gaussian-process regression, on a toy skin and on a measured one."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from eitskin.datasets import Dataset, RecordingNames, State, read_recording
from eitskin.errors import DataError, FrameError
from eitskin.simulator import Protocol
from eitskin.training import RecordedTouches
from eitskin.training.positions.position_regressor import PositionRegressor

DATA = Path(os.environ.get("EITSKIN_DATA", Path(__file__).parents[4] / "shared" / "data"))


def recorded(count=150, seed=0):
    """Ratios of a toy skin of eight channels, each sensitive near its own position."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.05, 0.05, size=(count, 2))
    angles = np.arange(8) * np.pi / 4
    own = 0.05 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    distance = np.linalg.norm(places[:, None] - own, axis=2)
    strength = rng.uniform(0.5, 2.0, size=(count, 1))
    change = 0.02 * strength * np.exp(-((distance / 0.04) ** 2))
    return 1 + change + rng.normal(size=change.shape) * 1e-5, places


def test_touch_position_is_learned_whatever_the_strength():
    stage = PositionRegressor.fit(*recorded())
    ratio, places = recorded(50, seed=1)
    assert np.mean(np.linalg.norm(stage.apply(ratio) - places, axis=1)) < 0.002
    harder = stage.apply(ratio**3)  # three times the press, in log ratios
    np.testing.assert_allclose(harder, stage.apply(ratio), atol=1e-9)


def test_touch_position_is_scikit_learns_prediction():
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import Matern

    ratio, places = recorded()
    stage = PositionRegressor.fit(ratio, places)
    kernel = stage.variance * Matern(stage.length, nu=2.5)
    process = GaussianProcessRegressor(kernel, optimizer=None)
    process.X_train_, process.alpha_ = stage.directions, stage.weights
    process._y_train_mean, process._y_train_std = 0.0, 1.0
    process.kernel_ = kernel
    logs = np.log(ratio) / stage.channel_scale
    directions = logs / np.linalg.norm(logs, axis=1, keepdims=True)
    np.testing.assert_allclose(
        process.predict(directions) + stage.centre, stage.apply(ratio), atol=1e-9
    )


def test_learned_positions_keep_the_protocol_of_their_recording(tmp_path):
    ratio, (x, y) = recorded(40)[0], recorded(40)[1].T
    touches = {name: np.full((40, 4), np.nan) for name in ("touch_x", "touch_y")}
    touches["touch_x"][:, 0], touches["touch_y"][:, 0] = x, y
    touches["state"] = np.full(40, State.TOUCH)
    table = Protocol(Protocol.skip(8, 1).table[:8], 8)
    recording = Dataset.from_arrays(ratio, np.ones(8), protocol=table, **touches)
    loaded = RecordedTouches.load(RecordedTouches.fit(recording).save(tmp_path / "a.eitmodel"))
    assert loaded.protocol == table
    unknown = dataclasses.replace(recording, protocol=None)
    assert loaded.evaluate(unknown).frames == 8
    other = dataclasses.replace(recording, protocol=Protocol(table.table[::-1], 8))
    with pytest.raises(FrameError, match=r"learned from .* the dataset has"):
        loaded.evaluate(other)


def test_touch_position_edges():
    ratio, places = recorded()
    stage = PositionRegressor.fit(ratio, places)
    ratio[0, 0], ratio[1] = np.nan, 1.0
    assert np.isfinite(stage.apply(ratio)).all()
    with pytest.raises(DataError, match="8 channels, got 7"):
        stage.apply(ratio[:, :7])
    with pytest.raises(DataError, match="at least 20"):
        PositionRegressor.fit(ratio[:5], places[:5])


def test_measured_hydrogel_skin():
    """500 presses of a real skin: better than extremely randomised trees' 4.5 mm."""
    if not (DATA / "ohmc8.mat").is_file():
        pytest.skip(f"no ohmc8.mat in {DATA}; set EITSKIN_DATA to the folder that holds it")
    names = RecordingNames("responsedowns", "responseups", "positions")
    recording = read_recording(DATA / "ohmc8.mat", names)
    score = RecordedTouches.fit(recording).evaluate(recording)
    assert score.frames == 100
    assert score.mean_error_mm < 3.0
    assert score.guess_error_mm > 40.0
