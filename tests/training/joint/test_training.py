"""Training of the joint method on frames of a sensor in closed form."""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from known_frames import known_frames

from eitskin.datasets import Dataset, State
from eitskin.errors import DataError
from eitskin.geometry import SensorDesign
from eitskin.threads import one_torch_thread
from eitskin.training import (
    NetworkSettings,
    Observations,
    Targets,
    TrainingFrames,
    TrainingSettings,
)
from eitskin.training.joint import touch_training
from eitskin.training.joint import (
    training as joint_training,
)
from eitskin.training.joint.frame_predictions import ErrorScale
from eitskin.training.joint.method import JointMethod
from eitskin.training.joint.training import fit_joint, held_out_touches
from eitskin.training.method.settings import JointSettings

from smooth_sensor import (
    FLAT,
    LAYOUT,
    NOISE,
    PROTOCOL,
    TOUCH_PRIOR,
    bend_mean,
    powers,
    touch_change,
)

pytestmark = pytest.mark.slow


def dataset(count=750, specimens=24, seed=0):
    """Idle, touched and bent frames of specimens that differ in flat values and bend curves."""
    rng = np.random.default_rng(seed)
    flat = FLAT * np.exp(0.01 * rng.standard_normal((specimens, 28)))
    own = 5e-4 * rng.standard_normal((specimens, 28))
    specimen = rng.integers(0, specimens, count)
    state = np.arange(count) % 3
    state = np.where((state == State.IDLE) & (np.arange(count) % 2 == 0), State.TOUCH, state)
    bent = (state == State.BEND) | ((state == State.TOUCH) & (rng.uniform(size=count) < 0.5))
    angle = np.where(bent, rng.uniform(-20.0, 50.0, count), 0.0)
    touches = rng.uniform(TOUCH_PRIOR.low, TOUCH_PRIOR.high, (count, 2, 3))
    touches[..., 2] = rng.uniform(4.0, 12.0, (count, 2))
    apart = np.hypot(*(touches[:, 0, :2] - touches[:, 1, :2]).T)
    touches[(apart < 0.030) | (rng.uniform(size=count) < 0.5), 1] = np.nan
    touches[state != State.TOUCH] = np.nan
    log = powers(angle, 5) @ bend_mean() + powers(angle, 1) * own[specimen]
    free = flat[specimen] * np.exp(log + NOISE * rng.standard_normal(log.shape))
    each = [touch_change(touches[:, i], angle[:, None]) for i in range(2)]
    log = log + np.nansum(each, axis=0) + NOISE * rng.standard_normal(log.shape)
    columns = np.full((4, count, 4), np.nan)
    columns[:3, :, :2] = touches.transpose(2, 0, 1)
    columns[3] = np.where(np.isfinite(columns[0]), 0.0075, np.nan)
    return Dataset.from_arrays(
        (flat[specimen] * np.exp(log)).astype(complex),
        flat,
        touch_reference=free,
        specimen=specimen,
        state=state,
        bend_angle_deg=angle,
        touch_x=columns[0],
        touch_y=columns[1],
        touch_force=columns[2],
        touch_radius=columns[3],
        protocol=PROTOCOL,
        source="simulated",
        design=SensorDesign.reference(),
    )


@contextmanager
def small_networks(steps=40):
    """Context with smaller networks, and fewer steps of the proposals in an epoch."""
    with one_torch_thread(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(touch_training, "HIDDEN_SIZE", 48)
        patch.setattr(touch_training, "LAYERS", 2)
        patch.setattr(touch_training, "PROPOSAL_HIDDEN", (96, 96))
        patch.setattr(touch_training, "STEPS_PER_EPOCH", steps)
        patch.setattr(joint_training, "PITCH", 0.008)
        yield


@pytest.fixture(scope="module")
def trained():
    """Method with smaller networks, trained for seconds."""
    said = []
    with small_networks():
        settings = JointSettings(
            response=NetworkSettings(1e-2, epochs=12, batch=48),
            proposals=NetworkSettings(1e-2, epochs=2, batch=64),
        )
        frames = TrainingFrames.from_dataset(dataset(), LAYOUT)
        whole = TrainingSettings(joint=settings)
        method = JointMethod.fit(frames, whole, lambda *told: said.append(told))
    return method, said


def test_what_is_learned_is_the_sensor(trained):
    method, said = trained
    np.testing.assert_allclose(method.combinations.noise, NOISE, rtol=0.04)
    assert method.touch_prior.separation == pytest.approx(0.030, abs=3e-4)
    assert method.touch_prior.force[0] == pytest.approx(8.0, abs=0.12)
    assert method.radius == pytest.approx(0.0075)
    assert method.response.ranges.angle_deg[0] < -18.0
    assert method.response.mismatch == pytest.approx(0.115, abs=0.04)
    angles = np.array([-15.0, 20.0, 45.0])
    bend = method.bend_prior.predict(np.zeros(len(method.features.directions))).value(angles)
    np.testing.assert_allclose(bend, powers(angles, 5) @ bend_mean(), atol=2.1e-4)
    spread = np.sqrt(np.diag(method.bend_prior.predict(np.zeros(4)).uncertainty(50.0)))
    assert np.median(spread) == pytest.approx(5e-4 * powers(50.0, 1)[0], rel=0.06)
    assert {stage for stage, *_ in said} == {"bend curve", "touch response", "proposals"}
    assert all(done <= total for _, done, total in said)


def test_standard_errors_of_places_are_scaled_by_specimens_held_out(trained):
    """To the scale that an unscaled method has there; no other specimen takes part."""
    method, _ = trained
    checked = held_out_touches(dataset())
    specimens = np.unique(dataset().specimen[dataset().state == State.TOUCH])
    numbers = checked.specimen_number[checked.specimen]
    assert set(numbers.tolist()) == set(specimens[7::8].tolist())
    assert (checked.touch_count > 0).all()
    seen = Observations.from_dataset(checked)
    plain = replace(method, error_scale=ErrorScale()).predict(seen).touches
    known = np.stack([checked.touch_x, checked.touch_y], axis=-1)
    features = method.features.clip(seen.flat)
    assert method.error_scale == ErrorScale.fit(known, plain, features)
    assert method.error_scale != ErrorScale()
    scaled = method.predict(seen).touches
    shares = []
    for before, after, p in zip(plain, scaled, features, strict=True):
        scale = method.error_scale.evaluate(p)
        low, high = sorted((before.deviation, scale * before.deviation), key=np.sum)
        # What a hidden neighbour adds is not scaled.
        assert np.all((after.deviation > 0.999 * low) & (after.deviation < 1.001 * high))
        shares += (after.deviation / (scale * before.deviation)).tolist()
    assert np.median(shares) == pytest.approx(1.0, abs=0.01)


def restored(method):
    return type(method).from_arrays(method.arrays(), LAYOUT)


def without_forces(data):
    return replace(data, touch_force=np.full_like(data.touch_force, np.nan))


BRIEF = JointSettings(
    response=NetworkSettings(1e-2, epochs=12, batch=48),
    proposals=NetworkSettings(1e-2, epochs=1, batch=32),
)


def test_a_sensor_that_is_never_bent_and_touches_without_forces_of_two_specimens():
    """The flat sensor is the reference of every frame. Places are learned with a strength in place
    of the force, which is never told as a force. Two specimens are too few for latent variables.
    """
    data = without_forces(dataset(specimens=2))
    data = data.select(data.bend_angle_deg == 0)
    data = replace(data, touch_reference=np.full_like(data.touch_reference, np.nan))
    with small_networks(steps=10):
        method = restored(fit_joint(JointMethod, data, LAYOUT, BRIEF))
    assert method.targets == Targets(("idle", "touch"), angle=False, force=False)
    unseen = dataset(90, specimens=2)
    unseen = unseen.select(unseen.bend_angle_deg == 0)
    said = method.predict(Observations.from_dataset(unseen))
    assert np.mean(said.state == unseen.state) > 0.9
    for unknown in (said.bend_angle_deg, said.bend_deviation_deg, said.probabilities[:, 2]):
        assert np.isnan(unknown).all()
    assert np.isfinite(said.probabilities[:, :2]).all()
    single = np.flatnonzero((unseen.touch_count == 1) & [len(t) > 0 for t in said.touches])
    assert len(single) > 10
    true = np.stack([unseen.touch_x, unseen.touch_y], axis=2)[single, 0]
    found = np.array([said.touches[i].place[0] for i in single])
    assert np.median(np.hypot(*(found - true).T)) < 0.008
    assert all(np.isnan(touches.force).all() for touches in said.touches)
    flat = np.abs(data.reference[0]).astype(float)
    told = method.adapt(known_frames(flat, 1, np.full((1, len(flat)), 0.01), [20.0]))[1]
    assert (told.bends, told.left_out) == (0, 1)


def with_plates(data):
    """The same frames; the second half of the specimens are on plates, where all is nearer in x."""
    on_plates = data.specimen >= 12
    nearer = (0.075 + 0.7 * (data.touch_x - 0.075)).astype(np.float32)
    return replace(
        data,
        touch_x=np.where(on_plates[:, None], nearer, data.touch_x),
        support_gap=np.where(on_plates, 0.04, 0.0).astype(np.float32),
    )


def test_touches_on_plates_are_learned_apart():
    data = with_plates(dataset(1500))
    with small_networks(steps=10):
        method = restored(fit_joint(JointMethod, data, LAYOUT, BRIEF))
    assert set(held_out_touches(data).specimen.tolist()) == {7, 19}
    unseen = with_plates(dataset(400, seed=1))
    unseen = unseen.select((unseen.touch_count == 1) & (unseen.specimen >= 12))
    touches = np.stack([unseen.touch_x, unseen.touch_y, unseen.touch_force], axis=2)[:, :1]
    change = np.log(np.abs(unseen.impedance / unseen.touch_reference))
    flat, angles = np.abs(unseen.reference[unseen.specimen]), unseen.bend_angle_deg.astype(float)
    base, plates = (
        [one(touch, angle)[0] for one, touch, angle in zip(ones, touches, angles, strict=True)]
        for ones in zip(*map(method.responses, flat), strict=True)
    )
    errors = [np.linalg.norm(each @ method.combinations.back - change) for each in (base, plates)]
    assert errors[1] < 0.5 * errors[0]


def test_a_sensor_that_is_never_touched():
    """Idle or bent, and the angle; nothing of touches, with no network."""
    data = dataset(450)
    data = data.select(data.state != State.TOUCH)
    method = restored(fit_joint(JointMethod, data, LAYOUT, BRIEF))
    assert method.targets == Targets(("idle", "bend"), touches=False, force=False)
    unseen = dataset(90, seed=1)
    unseen = unseen.select(unseen.state != State.TOUCH)
    said = method.predict(Observations.from_dataset(unseen))
    clear = np.abs(unseen.bend_angle_deg) > 5.0
    assert (said.state[clear] == State.BEND).all()
    assert np.mean(said.state[unseen.state == State.IDLE] == State.IDLE) > 0.9
    assert np.sqrt(np.mean((said.bend_angle_deg - unseen.bend_angle_deg) ** 2)) < 1.5
    assert np.isnan(said.probabilities[:, State.TOUCH]).all()
    assert np.isnan(said.touch_map).all()
    assert not any(len(touches) for touches in said.touches)
    changed = unseen.impedance * np.where(np.arange(28) == 5, 1.3, 1.0)
    told = method.predict(Observations.from_dataset(replace(unseen, impedance=changed))).problems
    assert all(any(PROTOCOL.labels[5] in problem for problem in each) for each in told)


def test_too_little_to_learn_from_is_told():
    data = dataset()
    with pytest.raises(DataError, match="at least 100 frames"):
        fit_joint(JointMethod, data.select(slice(60)), LAYOUT, JointSettings())
    some = without_forces(data).touch_force.copy()
    first = np.flatnonzero(data.state == State.TOUCH)[:5]
    some[first] = data.touch_force[first]
    with pytest.raises(DataError, match="5 touched frames"):
        fit_joint(JointMethod, replace(data, touch_force=some), LAYOUT, JointSettings())
    still = data.select((data.state == State.IDLE) & (data.bend_angle_deg == 0))
    with pytest.raises(DataError, match="0 bent frames"):
        fit_joint(JointMethod, still, LAYOUT, JointSettings())
