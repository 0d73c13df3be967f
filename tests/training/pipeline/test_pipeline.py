"""A pipeline trained by the paper's method: its errors, and sets that teach nothing."""

import dataclasses

import numpy as np
import pytest

from eitskin.datasets import State
from eitskin.errors import DataError
from eitskin.training import Pipeline, evaluate

from linear_sensor import SETTINGS, linear_sensor, trained_pipeline

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sensor():
    return linear_sensor()


@pytest.fixture(scope="module")
def dataset(sensor):
    return sensor.dataset()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    path, told = trained_pipeline(tmp_path_factory)
    assert {("state classifier", 9, 9), ("touch map", 1, 24)} <= set(map(tuple, told))
    return Pipeline.load(path)


def test_states_angles_and_touches_of_frames_never_seen(trained, dataset):
    unseen = trained.held_out(dataset)
    assert set(unseen).isdisjoint(dataset.split((0.6, 0.2, 0.2), SETTINGS.seed)[0])
    assert len(trained.held_out(dataset.select(slice(10)))) == 10
    held_out = dataset.select(unseen)
    report = evaluate(trained, held_out)
    assert report.frames == 48
    assert np.trace(report.states.confusion) >= 46
    assert report.bend.r2 > 0.999
    assert report.bend.touched_rmse_deg < 1.0
    one = report.touches["1"]
    assert one.frames == np.sum(held_out.state == State.TOUCH)
    assert one.found > 0.85
    assert one.mean_error_mm < 5.0
    assert one.ssim["touch_map"] > one.ssim["dynamic"] > one.ssim["static"]
    assert 0 < report.latency.p50_ms <= report.latency.p99_ms


def test_datasets_that_cannot_be_learned_from_or_judged_are_refused(trained, dataset):
    touched = (dataset.state == State.TOUCH) & (dataset.touch_count > 0)
    for data, message in (
        (dataclasses.replace(dataset, design=None), r"design and table.*touch positions"),
        (dataset.select(dataset.state == State.IDLE), "0 touch"),
        (dataset.select(touched), "positions of touches alone"),
    ):
        with pytest.raises(DataError, match=message):
            Pipeline.fit(data)
    with pytest.raises(DataError, match="no frames"):
        evaluate(trained, dataset.select(slice(0)))
    with pytest.raises(DataError, match="names its protocol"):
        evaluate(trained, dataclasses.replace(dataset, protocol=None))
