"""Noise of channels, as training learns it from frames that differ by nothing else."""

from dataclasses import asdict

import numpy as np
import pytest

from eitskin.datasets import Dataset
from eitskin.errors import ConfigurationError
from eitskin.training.method.observations import Observations, channel_noise, frame_noise
from eitskin.training.method.settings import NetworkSettings, TrainingSettings

TRUE = np.geomspace(1e-3, 1e-1, 8)


def idle(frames, noise):
    """Dataset of idle frames whose channels have the noise given (8,)."""
    rng = np.random.default_rng(0)
    values = 500.0 * (1.0 + noise * rng.normal(size=(frames, 8)))
    return Dataset.from_arrays(values, np.full(8, 500.0), state=np.zeros(frames))


def found(data):
    return channel_noise(data, Observations.of(data))


def test_each_channel_has_its_own_noise():
    assert found(idle(4000, TRUE)) == pytest.approx(TRUE, rel=0.1)


def test_few_frames_lean_on_the_median_channel():
    data = idle(1, np.full(8, 1e-2))
    drawn = np.abs(Observations.of(data).dynamic[0])
    assert np.ptp(np.log(found(data))) < 0.5 * np.ptp(np.log(drawn))


def test_a_channel_that_never_differs_has_a_floor():
    data = idle(200, np.where(np.arange(8) < 6, 0.0, 1e-2))
    noise = found(data)
    assert (noise[:6] > 0).all()
    assert (
        noise[:6] < 1e-3 * noise[6:].min() + 1e-3 * frame_noise(data, Observations.of(data))
    ).all()


def test_there_are_more_epochs_where_frames_are_few():
    settings = NetworkSettings(1e-3, epochs=40, batch=32, fewest_steps=800)
    assert [settings.epochs_of(count) for count in (5, 40, 240, 640, 6400)] == [
        800,
        400,
        100,
        40,
        40,
    ]
    assert NetworkSettings(1e-3, epochs=40, batch=32).epochs_of(5) == 40
    assert TrainingSettings.preset("quick").with_epochs(3).postprocessor.epochs_of(5) == 3


def test_settings_that_were_saved_with_two_numbers_of_steps_are_read():
    settings = TrainingSettings.preset("quick")
    document = asdict(settings)
    assert TrainingSettings.from_document(document) == settings
    for network in (document["joint"]["response"], document["postprocessor"]):
        network |= {"fewest_steps": 0, "least_steps": network["fewest_steps"]}
    document["classifier"]["least_steps"] = 0
    assert TrainingSettings.from_document(document) == settings
    with pytest.raises(ConfigurationError, match="stepss"):
        TrainingSettings.from_document({"joint": {"stepss": 3}})
