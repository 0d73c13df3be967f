"""Baselines: each regression against a plain twin, and as pipelines that are saved and opened."""

from dataclasses import replace

import numpy as np
import pytest

from eitskin.datasets import State
from eitskin.errors import DataError
from eitskin.training import Pipeline, TrainingSettings, evaluate
from eitskin.training.baselines.regressions import (
    PARAMETERS,
    ExtraTreesMethod,
    RidgeMethod,
    RidgeOptions,
    TreeOptions,
)
from eitskin.training.method.settings import silent

from linear_sensor import linear_sensor
from made_up_sensor import frames
from on_demand import OnDemand

ensemble, linear_model = OnDemand("sklearn.ensemble"), OnDemand("sklearn.linear_model")

SMALL = {"ridge": {}, "mlp": {"epochs": 25, "width": 64}, "extra-trees": {"trees": 10}}


@pytest.fixture(scope="module")
def dataset():
    return frames(420)


def settings(name):
    return replace(TrainingSettings.preset(name), options=SMALL[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_a_baseline_learns_states_angles_and_touches(dataset, name, tmp_path):
    pipeline = Pipeline.fit(dataset, settings(name))
    unseen = frames(120, seed=3)
    report = evaluate(pipeline, unseen)
    assert min(report.states.accuracy.values()) > 0.9
    assert report.bend.rmse_deg < 4.0
    assert report.touches["1"].mean_error_mm < 8.0
    assert {len(each) for each in pipeline.perceive(unseen).touches} == {0, 1, 2}
    loaded = Pipeline.load(pipeline.save(tmp_path / "a.eitmodel"))
    said, again = (each.perceive(unseen) for each in (pipeline, loaded))
    np.testing.assert_allclose(again.bend_angle_deg, said.bend_angle_deg, rtol=1e-6)
    assert loaded.targets == pipeline.targets
    assert loaded.targets.force


def test_baselines_estimate_what_has_labels(dataset):
    flat = dataset.select(dataset.state != State.BEND)
    unknown = np.full_like(flat.touch_force, np.nan)
    flat = replace(flat, bend_angle_deg=0.0 * flat.bend_angle_deg, touch_force=unknown)
    said = Pipeline.fit(flat, settings("ridge")).perceive(flat)
    assert np.isnan(said.bend_angle_deg).all()
    assert np.isnan(said.probabilities[:, State.BEND]).all()
    assert all(np.isnan(touches.force).all() for touches in said.touches)
    untouched = dataset.select(dataset.state != State.TOUCH)
    pipeline = Pipeline.fit(untouched, settings("ridge"))
    assert pipeline.targets.states == ("idle", "bend")
    assert np.isnan(pipeline.perceive(untouched).touch_map).all()
    status = np.broadcast_to(np.uint8(np.arange(28) == 5), untouched.status.shape)
    angles = pipeline.perceive(replace(untouched, status=status)).bend_angle_deg
    assert np.sqrt(np.mean((angles - untouched.bend_angle_deg) ** 2)) < 5.0


@pytest.fixture
def table():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(150, 6))
    truth = np.stack([features[:, 0] + 0.3 * rng.normal(size=150), np.sin(features[:, 1])], axis=1)
    return features, truth - truth.mean(axis=0)


@pytest.mark.slow
def test_ridge_and_trees_are_those_of_scikit_learn(table):
    features, truth = table
    errors, fits = [], []
    for parameter in len(features) * PARAMETERS:
        model = linear_model.Ridge(alpha=parameter).fit(features, truth)
        X = features - features.mean(axis=0)
        hat = X @ np.linalg.solve(X.T @ X + parameter * np.eye(6), X.T)
        misfit = np.sum((truth - model.predict(features)) ** 2)
        errors.append(misfit / (len(X) - np.trace(hat)) ** 2)
        fits.append(model)
    best = fits[int(np.argmin(errors))]
    arrays = RidgeMethod.learn(features, truth, RidgeOptions(squares=False), 0, silent)
    np.testing.assert_allclose(
        RidgeMethod.apply(arrays, features), best.predict(features), atol=1e-9
    )
    features = np.round(features, 1)  # many values on thresholds' own ground
    for wanted in (truth, truth[:, :1]):
        arrays = ExtraTreesMethod.learn(features, wanted, TreeOptions(7, 3), 4, silent)
        forest = ensemble.ExtraTreesRegressor(7, min_samples_leaf=3, random_state=4)
        forest.fit(features, wanted if wanted.shape[1] > 1 else wanted[:, 0])
        unseen = np.round(np.random.default_rng(1).normal(size=(200, 6)), 1)
        expected = forest.predict(unseen).reshape(200, -1)
        np.testing.assert_allclose(ExtraTreesMethod.apply(arrays, unseen), expected, atol=1e-6)
    arrays = {
        "roots": np.array([0]),
        "left": np.array([1, -1, -1]),
        "right": np.array([2, -1, -1]),
        "feature": np.array([0, -2, -2]),
        "threshold": np.array([0.5, -2.0, -2.0]),
        "value": np.array([[0.0], [1.0], [2.0]]),
    }
    found = ExtraTreesMethod.apply(arrays, np.array([[0.5], [0.5001]]))
    assert found.tolist() == [[1.0], [2.0]]


@pytest.mark.slow
def test_centroids_of_pictures_are_where_the_touches_are(tmp_path):
    data = linear_sensor().dataset()
    pipeline = Pipeline.fit(data, TrainingSettings.preset("greit"))
    report = evaluate(pipeline, data.select(pipeline.held_out(data)))
    assert report.touches["1"].mean_error_mm < 7.0
    assert report.touches["1"].found > 0.8
    assert report.bend.rmse_deg is None
    loaded = Pipeline.load(pipeline.save(tmp_path / "greit.eitmodel"))
    loaded.reset()
    estimate = loaded.process(data.frame(0))
    assert estimate.state is State.IDLE
    assert estimate.bend_angle_deg is None
    with pytest.raises(DataError, match="finds touches"):
        Pipeline.fit(data.select(data.state != State.TOUCH), TrainingSettings.preset("greit"))
