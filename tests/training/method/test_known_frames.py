"""Known frames: labels, references of touches, and what cannot be."""

from dataclasses import replace

import numpy as np
import pytest

from eitskin.datasets import Dataset, State
from eitskin.errors import ConfigurationError, DataError, FrameError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Frame
from eitskin.training import FrameLabel, Pipeline, TouchLabel
from eitskin.training.method.input_spec import InputSpec
from eitskin.training.method.known_frames import KnownFrames

from smooth_sensor import FLAT, PROTOCOL

SPEC = InputSpec(SensorDesign.reference(), PROTOCOL, 40e3, FLAT)
REST, BENT = FrameLabel(), FrameLabel(20.0)
PRESS = (TouchLabel(0.05, 0.03, 8.0),)


def frames(*levels):
    """Frames whose log V is this much above that of the flat sensor, half a second apart."""
    return [Frame(FLAT * np.exp(level) + 0j, PROTOCOL, 0.5 * i) for i, level in enumerate(levels)]


def known(labels, levels):
    return KnownFrames.of(frames(*levels), labels, SPEC)


def test_changes_are_from_the_mean_of_the_flat_frames():
    found = known([REST, REST, BENT], [0.001, 0.003, 0.012])
    seen = found.observations
    np.testing.assert_allclose(seen.flat, np.tile(FLAT * np.exp(0.002), (3, 1)))
    np.testing.assert_allclose(np.log1p(seen.static[2]), 0.010)
    np.testing.assert_allclose(seen.age, [0.0, 0.5, 1.0])
    assert seen.static_frames.tolist() == [2, 2, 2]
    assert found.bent.tolist() == [False, False, True]
    assert found.flat.tolist() == [True, True, False]


def test_a_touch_is_compared_with_the_latest_untouched_frames_of_its_angle():
    touched = FrameLabel(20.0, PRESS)
    labels = [REST, BENT, REST, BENT, BENT, touched, BENT]
    found = known(labels, [0.0, 0.5, 0.0, 0.010, 0.012, 0.031, 0.7])
    np.testing.assert_allclose(np.log1p(found.observations.dynamic[5]), 0.020)
    assert found.observations.dynamic_frames[5] == 2
    assert found.observations.dynamic_age[5] == 0.5
    assert found.reference_deg[5] == 20.0
    assert found.touched.tolist() == [False] * 5 + [True, False]
    np.testing.assert_allclose(found.touches[5, 0], [0.05, 0.03, 8.0])


def test_a_touch_before_any_frame_of_its_angle_is_compared_with_the_next_one():
    found = known([REST, FrameLabel(20.0, PRESS), BENT, REST, BENT], [0.0, 0.03, 0.01, 0.0, 0.5])
    np.testing.assert_allclose(np.log1p(found.observations.dynamic[1]), 0.02)


def test_a_touch_at_an_unknown_angle_is_compared_with_the_frame_before():
    labels = [REST, FrameLabel(None, ()), FrameLabel(None, PRESS)]
    found = known(labels, [0.0, 0.01, 0.04])
    np.testing.assert_allclose(np.log1p(found.observations.dynamic[2]), 0.03)
    assert np.isnan(found.reference_deg[2])


def test_a_touch_of_an_angle_that_no_frame_has_is_compared_with_the_flat_sensor():
    found = known([REST, FrameLabel(30.0, PRESS)], [0.0, 0.04])
    np.testing.assert_allclose(np.log1p(found.observations.dynamic[1]), 0.04)
    assert found.reference_deg[1] == 0.0


def test_what_is_unknown_is_neither_touched_nor_bent():
    found = known([REST, FrameLabel(20.0, None), FrameLabel(None, ())], [0.0, 0.1, 0.1])
    assert not found.touched.any()
    assert not found.bent.any()
    assert np.isnan(
        known([REST, FrameLabel(0.0, (TouchLabel(0.1, 0.03),))], [0, 0]).touches[1, 0, 2]
    )


@pytest.mark.parametrize(
    ("labels", "error", "message"),
    [
        ([REST], ConfigurationError, "1 labels and 2 frames"),
        ([BENT, BENT], ConfigurationError, "record the flat sensor"),
        ([REST, FrameLabel(0.0, (TouchLabel(75.0, 30.0),))], DataError, "places are in metres"),
    ],
)
def test_frames_that_cannot_be_known_are_refused(labels, error, message):
    with pytest.raises(error, match=message):
        known(labels, [0.0, 0.0])


def test_labels_that_cannot_be_are_refused():
    with pytest.raises(DataError, match="angle up to 360"):
        FrameLabel(float("inf"))
    with pytest.raises(DataError, match="above 0 N"):
        TouchLabel(0.1, 0.03, 0.0)
    with pytest.raises(DataError, match="place"):
        TouchLabel(float("nan"), 0.03)


def test_another_sensor_is_refused():
    with pytest.raises(FrameError, match="times those"):
        known([REST, BENT], [3.0, 3.1])


def dataset():
    """Frames idle, bent, and touched flat and bent, of one specimen."""
    levels = np.array([0.0, 0.01, 0.03, 0.04])
    x = np.full((4, 4), np.nan)
    x[2:, 0] = 0.05
    before = np.full((4, 28), np.nan)
    before[3] = FLAT * np.exp(0.01)
    return Dataset.from_arrays(
        FLAT * np.exp(levels[:, None]),
        FLAT,
        touch_reference=before,
        state=np.array([State.IDLE, State.BEND, State.TOUCH, State.TOUCH]),
        bend_angle_deg=np.array([0.0, 20.0, 0.0, 20.0]),
        touch_x=x,
        touch_y=np.where(np.isfinite(x), 0.03, np.nan),
        protocol=PROTOCOL,
    )


def test_a_dataset_has_labels_and_references_of_its_own():
    found = KnownFrames.of(dataset(), None, SPEC)
    assert found.flat.tolist() == [True, False, False, False]
    assert found.bent.tolist() == [False, True, False, False]
    assert found.touched.tolist() == [False, False, True, True]
    assert found.reference_deg.tolist() == [0.0, 0.0, 0.0, 20.0]
    np.testing.assert_allclose(found.observations.dynamic[2:, 0], np.expm1([0.03, 0.03]), rtol=1e-5)


def test_datasets_that_cannot_be_of_one_sensor_are_refused():
    data = dataset()
    two = replace(
        data,
        reference=np.tile(data.reference, (2, 1)),
        specimen=np.array([0, 0, 1, 1]),
        specimen_number=np.arange(2),
    )
    with pytest.raises(ConfigurationError, match="2 specimens"):
        KnownFrames.of(two, None, SPEC)
    with pytest.raises(ConfigurationError, match="no labels beside"):
        KnownFrames.of(data, [REST] * 4, SPEC)


def test_flat_frames_alone_change_no_estimate():
    pipeline = Pipeline.load("reference.eitmodel")
    reference, protocol = pipeline.layout.reference, pipeline.layout.protocol
    still = [Frame(reference + 0j, protocol, float(i)) for i in range(3)]
    before = pipeline.method.outputs(pipeline.examples)
    said = pipeline.adapt(still, [REST] * 3)
    assert (said.flat, said.bends, said.touches, said.left_out) == (3, 0, 0, 0)
    for name, array in pipeline.method.outputs(pipeline.examples).items():
        np.testing.assert_array_equal(array, before[name])
