"""Stored references: their file, and sessions of the shipped pipeline that begin with one."""

import dataclasses
import json

import numpy as np
import pytest

from eitskin.datasets import State
from eitskin.errors import ConfigurationError, DataError, FrameError
from eitskin.geometry import Bend, SensorDesign
from eitskin.simulator import Frame, Protocol, Scene, Simulator, Touch
from eitskin.training import StoredReference, Zero
from eitskin.training.pipeline.references import FORMAT_VERSION

NOISE = 1e-4
PROTOCOL = Protocol.pairwise(8)
PRESS = (Touch(0.05, 0.02, force=9.0),)


@pytest.fixture
def pipeline(pipeline):
    pipeline.use(None)
    return pipeline


@pytest.fixture(scope="module")
def truth():
    """Noise-free values by name."""
    scenes = [Scene(), Scene(Bend(30.0)), Scene(Bend(30.0), PRESS), Scene(Bend(20.0))]
    simulator = Simulator(SensorDesign.reference(), resolution="fast")
    names = ("flat", "bent", "pressed", "back")
    return dict(zip(names, simulator.measure_all(scenes), strict=True))


def frames(values, count=8, first=0, seed=0):
    noisy = values * (1 + NOISE * np.random.default_rng(seed).normal(size=(count, 28)))
    return [Frame(z, PROTOCOL, 0.3 * n, n) for n, z in enumerate(noisy, first)]


def last(pipeline, given):
    return [pipeline.process(frame) for frame in given][-1]


@pytest.mark.parametrize("name", ["flat", "bent", "pressed"])
def test_a_start_that_is_not_flat_is_told_and_its_angle_unknown(pipeline, truth, name):
    estimate = last(pipeline, frames(truth[name]))
    assert estimate.zero is Zero.FIRST_FRAMES
    if name == "flat":
        assert (estimate.state, estimate.problems) == (State.IDLE, ())
        return
    assert estimate.state is None
    assert estimate.bend_angle_deg is estimate.bend_deviation_deg is None
    assert np.isnan(estimate.probabilities[[State.IDLE, State.BEND]]).all()
    (problem,) = estimate.problems
    assert "does not look flat" in problem
    assert "eitskin tare" in problem
    naive = dataclasses.replace(pipeline, flat_sensors=None)  # knows too few specimens
    assert last(naive, frames(truth["bent"])).problems == ()


@pytest.mark.parametrize(
    ("name", "state", "touches"),
    [("flat", State.IDLE, 0), ("bent", State.BEND, 0), ("pressed", State.TOUCH, 1)],
)
def test_with_a_reference_any_start_is_estimated(pipeline, truth, name, state, touches):
    pipeline.tare(frames(truth["flat"]))
    estimate = last(pipeline, frames(1.01 * truth[name], seed=1))
    assert (estimate.state, len(estimate.touches)) == (state, touches)
    assert estimate.bend_angle_deg == pytest.approx(0.0 if name == "flat" else 30.0, abs=3.0)
    assert (estimate.zero, estimate.problems) == (Zero.FLAT, ())
    if touches:
        assert estimate.touches[0][:2] == pytest.approx((0.05, 0.02), abs=5e-3)


def test_a_mounted_sensor_is_estimated_from_its_own_shape(pipeline, truth):
    with pytest.raises(DataError, match="--mounted"):
        pipeline.tare(frames(truth["bent"]))
    pipeline.tare(frames(truth["bent"]), Zero.MOUNTED)
    estimate = last(pipeline, frames(truth["bent"], seed=2))
    assert (estimate.state, estimate.zero, estimate.problems) == (State.IDLE, Zero.MOUNTED, ())
    estimate = last(pipeline, frames(truth["back"], first=8))
    assert estimate.state is State.BEND
    assert estimate.bend_angle_deg == pytest.approx(-10.0, abs=9.0)
    assert estimate.bend_deviation_deg is None


def test_frames_that_give_no_reference_leave_the_pipeline_as_it_was(pipeline, truth):
    reference = pipeline.tare(frames(truth["flat"]), board="0102", source="virtual:")
    moving = [*frames(truth["flat"], 3), *frames(truth["bent"], 3, first=3)]
    with pytest.raises(DataError, match="moves in frame 4 of 6"):
        pipeline.tare(moving)
    with pytest.raises(ConfigurationError, match="got none"):
        pipeline.tare([])
    with pytest.raises(FrameError, match="times those"):
        pipeline.use(dataclasses.replace(reference, impedance=40.0 * reference.impedance))
    assert pipeline.stored_reference is reference


@pytest.fixture
def reference(truth):
    values = [frame.impedance for frame in frames(truth["flat"])]
    return StoredReference.from_frames(
        values, PROTOCOL, 40e3, Zero.FLAT, board="0102", source="virtual:"
    )


def test_the_file_brings_everything_back(reference, tmp_path):
    impedance = np.where(np.arange(28) == 4, np.nan, reference.impedance)
    kept = dataclasses.replace(reference, impedance=impedance)
    again = StoredReference.read(kept.write(tmp_path / "r.json"))
    np.testing.assert_array_equal(again.impedance, impedance)
    others = StoredReference.__slots__[1:]
    assert [getattr(again, name) for name in others] == [getattr(kept, name) for name in others]
    assert reference.noise == pytest.approx(NOISE * np.sqrt(2), rel=0.3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "other"}, "is no reference"),
        ({"format_version": FORMAT_VERSION + 1}, "newer eitskin"),
        ({"real": [1.0]}, "expected 28 real"),
        ({"real": [None] * 28}, "good channel"),
        ({"zero": "bent"}, "bent"),
        ({"zero": "first frames"}, "expected 'flat'"),
        ({"taken": "yesterday"}, "yesterday"),
        ({"frames": 0}, "positive"),
        ({"colour": 1}, "colour"),
    ],
)
def test_files_that_are_no_reference_are_refused(reference, tmp_path, change, said):
    path = reference.write(tmp_path / "r.json")
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(DataError, match=said):
        StoredReference.read(path)
    path.write_text('{"format": "eitskin-refe')
    with pytest.raises(DataError, match="no whole reference"):
        StoredReference.read(path)
    with pytest.raises(DataError, match="eitskin tare"):
        StoredReference.read(tmp_path / "none.json")
