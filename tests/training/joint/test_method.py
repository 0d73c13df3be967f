"""The joint method: predictions, bad channels, faults, calibration and saving."""

from dataclasses import fields, replace

import numpy as np
import pytest
from known_frames import known_frames
from smooth_joint import smooth_method

from eitskin.datasets import State
from eitskin.training import Observations
from eitskin.training.joint.method import JointMethod

from smooth_sensor import FLAT, LAYOUT, NOISE, PROTOCOL, TOUCH_PRIOR, powers

TOUCH = (0.045, 0.021, 8.0)
ELECTRODE = [i for i, row in enumerate(PROTOCOL.table) if 3 in row[:2]]


@pytest.fixture(scope="module")
def method():
    return smooth_method()


def observed(method, touches=(), angle_deg=0.0, rng=None, flat=FLAT, wrong=None, age=5.0):
    """One frame of the mean specimen; `wrong` is added to its log V."""
    touches = np.array(touches, dtype=float).reshape(-1, 3)
    one = method.response.for_specimen(method.features.apply(flat))
    bent = method.bend_prior.predict([0.0]).value(angle_deg)
    frame = bent + one(touches, angle_deg).sum(axis=0)
    if rng is not None:
        frame = frame + NOISE * rng.standard_normal(28)
        bent = bent + NOISE * rng.standard_normal(28)
    if wrong is not None:
        frame = frame + wrong
    values = {
        "static": np.expm1(frame),
        "dynamic": np.expm1(frame - bent),
        "flat": flat,
        "static_frames": np.inf,
        "age": age,
        "dynamic_age": 0.0,
    }
    given = {
        field.name: np.asarray(values.get(field.name, 1.0))[None] for field in fields(Observations)
    }
    return Observations(**given)


def broken(good, bad):
    """Frame with bad measurements."""
    static, dynamic = good.static.copy(), good.dynamic.copy()
    static[0, bad] = dynamic[0, bad] = np.nan
    return replace(good, static=static, dynamic=dynamic)


# What it says


def test_idle_bent_and_touched_frames_are_told_and_common_drift_is_neither(method):
    """Drift of a percent in four hours since the static reference, not the dynamic one."""
    rng = np.random.default_rng(1)
    idle = method.predict(observed(method, rng=rng))
    assert idle.state[0] == State.IDLE
    assert abs(idle.bend_angle_deg[0]) < 4 * idle.bend_deviation_deg[0]
    bent = method.predict(observed(method, angle_deg=30.0, rng=rng))
    assert bent.state[0] == State.BEND
    assert bent.bend_angle_deg[0] == pytest.approx(30.0, abs=4 * bent.bend_deviation_deg[0])
    for angle in (0.0, 30.0):
        said = method.predict(observed(method, [TOUCH, (0.110, 0.040, 9.0)], angle, rng))
        assert said.state[0] == State.TOUCH
        assert said.bend_angle_deg[0] == pytest.approx(angle, abs=4 * said.bend_deviation_deg[0])
        (found,) = said.touches
        assert len(found) == 2
        near = np.argsort(found.place[:, 0])
        away = found.place[near] - [TOUCH[:2], (0.110, 0.040)]
        assert (np.hypot(*away.T) < 4 * found.deviation[near]).all()
        assert found.force[near] == pytest.approx([8.0, 9.0], abs=1.0)
        assert ((found.strength >= 0.5) & (found.strength <= 1.0)).all()
        assert said.problems == ((),)
    for said in (idle, bent):
        assert len(said.touches[0]) == 0
        assert not said.touch_map.any()
        assert said.problems == ((),)
    aged = observed(method, angle_deg=20.0, age=4 * 3600.0)
    said = method.predict(replace(aged, static=(1.0 + aged.static) * 1.01 - 1.0))
    assert said.bend_angle_deg[0] == pytest.approx(20.0, abs=2.0)
    assert said.state[0] == State.BEND
    fresh = observed(method, angle_deg=20.0, age=0.0)
    wrong = method.predict(replace(fresh, static=(1.0 + fresh.static) * 1.01 - 1.0))
    assert abs(wrong.bend_angle_deg[0] - 20.0) > 2.0


# Broken frames


@pytest.mark.parametrize(
    "bad", [[4], [0, 6, 11, 19, 25], ELECTRODE], ids=["one", "five", "an electrode"]
)
def test_bad_channels_are_done_without(method, bad):
    rng = np.random.default_rng(3)
    for angle in (0.0, 25.0):
        still = method.predict(broken(observed(method, angle_deg=angle, rng=rng), bad))
        assert still.state[0] == (State.BEND if angle else State.IDLE)
        assert still.bend_angle_deg[0] == pytest.approx(angle, abs=1.0)
        touched = method.predict(broken(observed(method, [TOUCH], angle, rng), bad))
        assert touched.state[0] == State.TOUCH
        (found,) = touched.touches
        assert len(found) == 1
        assert np.hypot(*(found.place[0] - TOUCH[:2])) < 5 * found.deviation[0]


@pytest.mark.parametrize("size", [0.003, 0.3])
def test_wrong_channel_is_told_and_is_no_touch(method, size):
    rng = np.random.default_rng(4)
    for channel, angle in ((2, 0.0), (13, 25.0)):
        wrong = size * (np.arange(28) == channel)
        said = method.predict(observed(method, (), angle, rng, wrong=wrong))
        assert said.state[0] == (State.BEND if angle else State.IDLE)
        assert len(said.touches[0]) == 0
        assert said.bend_angle_deg[0] == pytest.approx(angle, abs=1.0)
        assert PROTOCOL.labels[channel] in said.problems[0][0]


@pytest.mark.parametrize("touches", [[TOUCH], [TOUCH, (0.110, 0.040, 9.0)]], ids=["one", "two"])
@pytest.mark.parametrize("size", [0.003, 0.01])
@pytest.mark.parametrize("name", ["measurement 2-3", "contact of electrode 2"])
def test_a_fault_beside_touches_is_told_and_the_touches_are_found(method, touches, size, name):
    """A contact in series adds to all its measurements; touches alone would fit much of either."""
    series = np.array([2 in row[:2] for row in PROTOCOL.table]) * np.median(FLAT) / FLAT
    channel = np.array([label == "2-3" for label in PROTOCOL.labels])
    wrong = size * (channel if name.startswith("measurement") else series)
    said = method.predict(observed(method, touches, rng=np.random.default_rng(4), wrong=wrong))
    (told,) = said.problems[0]
    assert f"{name} " in told
    found = said.touches[0].place
    assert len(found) == len(touches)
    expected = np.array(touches)[:, :2]
    np.testing.assert_allclose(found[found[:, 0].argsort()], expected, atol=1e-3)


# Copies, and one sensor


def sample(method):
    rng = np.random.default_rng(7)
    frames = [
        observed(method, rng=rng),
        observed(method, angle_deg=-10.0, rng=rng),
        observed(method, [TOUCH], 20.0, rng),
        broken(observed(method, [TOUCH], 0.0, rng), [3]),
    ]
    return Observations(
        *(
            np.concatenate([getattr(f, field.name) for f in frames])
            for field in fields(Observations)
        )
    )


def calibrated(method, angles=(-15.0, 10.0, 30.0, 45.0), offset=1e-3, flat_frames=4):
    """Calibration to a sensor whose channels bend a little more than the mean's."""
    change = method.bend_prior.predict([0.0]).value(angles) + offset * powers(angles, 1)
    adapted, adaptation = method.adapt(known_frames(FLAT, flat_frames, change, angles))
    return adapted, adaptation.calibration


def test_calibration_makes_angles_surer_and_arrays_make_the_method_again(method):
    """Copies agree to single precision, in which weights are saved."""
    frames = sample(method)
    for one in (method, calibrated(method)[0]):
        again = JointMethod.from_arrays(one.arrays(), LAYOUT)
        assert one.arrays()["response.weight0"].dtype == np.float32
        expected, said = one.outputs(frames), again.outputs(frames)
        assert set(said) == {"probabilities", "bend_angle_deg", "touch_map"}
        for name, array in expected.items():
            np.testing.assert_allclose(said[name], array, atol=1e-4)
        np.testing.assert_array_equal(again.combinations.noise, one.combinations.noise)
        assert again.drift == one.drift
    one, calibration = calibrated(method)
    frame = observed(method, angle_deg=35.0)
    own = np.exp(1e-3 * 35.0 / 50.0)
    frame = replace(frame, static=(1.0 + frame.static) * own - 1.0)
    before, after = method.predict(frame), one.predict(frame)
    assert abs(after.bend_angle_deg[0] - 35.0) < 0.3 * abs(before.bend_angle_deg[0] - 35.0)
    assert after.bend_deviation_deg[0] < before.bend_deviation_deg[0]
    after_deg = np.max(calibration.error_after_deg)
    assert after_deg < np.max(calibration.error_before_deg)
    assert calibration.residual_deg < 0.3
    surer = calibrated(method, flat_frames=100)[1]
    assert np.max(surer.error_after_deg) < after_deg


def test_known_touches_tell_how_far_to_trust_standard_errors(method):
    rng = np.random.default_rng(4)
    touches = rng.uniform(TOUCH_PRIOR.low, TOUCH_PRIOR.high, (12, 3))
    change = method.response.for_specimen(method.features.apply(FLAT))(touches, 0.0)
    told_places = touches + np.array([0.004, 0.0, 0.0])
    known = known_frames(FLAT, 4, change, np.zeros(12), touches=told_places[:, None])
    one, told = method.adapt(known)
    assert (told.touches, told.left_out) == (12, 0)
    assert told.error_scale == one.own_error_scale > 1.0
    unscaled = replace(one, own_error_scale=1.0)
    before, after = (each.predict(known.observations).touches for each in (unscaled, one))
    for plain, scaled in zip(before, after, strict=True):
        # What may be two touches adds its own part, which known single touches do not tell.
        np.testing.assert_allclose(scaled.deviation, one.own_error_scale * plain.deviation, 2e-3)
        np.testing.assert_array_equal(scaled.place, plain.place)
    again = JointMethod.from_arrays(one.arrays(), LAYOUT)
    assert again.own_error_scale == one.own_error_scale
    assert method.adapt(known_frames(FLAT, 4, np.zeros((1, 28)), [0.0]))[0].own_error_scale == 1.0


def test_noise_is_that_of_untouched_frames_at_the_angle_of_their_reference(method):
    """The mean square without what all measurements share, next to one frame as in training."""
    rng, angles = np.random.default_rng(6), np.full(5, 25.0)
    white = rng.standard_normal((5, 28))
    white -= white.mean(axis=1, keepdims=True)
    white *= 2.0 * np.sqrt(27.0) / np.linalg.norm(white, axis=1, keepdims=True)
    bent = method.bend_prior.predict([0.0]).value(angles)
    known = known_frames(FLAT, 4, bent + NOISE * (white + 3.0), angles, before=bent)
    adaptation = method.adapt(known)[1]
    assert adaptation.noise_scale == pytest.approx(np.sqrt((1.0 + 5 * 2.0**2) / 6))
    assert method.adapt(replace(known, reference_deg=np.zeros(5)))[1].noise_scale == 1.0
