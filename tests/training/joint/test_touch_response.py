"""The learned response to touches, what proposes them, and the mirrors that both obey."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from made_up_frames import made_up_frames

from eitskin.geometry import Bend, Polygon, SensorDesign
from eitskin.simulator import Protocol, Scene, Simulator, Touch
from eitskin.training.joint.networks import ProposalNetwork
from eitskin.training.joint.touch_response import MAX_TOUCHES, TouchPrior
from eitskin.training.joint.training import fit_mismatch
from eitskin.training.method.input_spec import mirrors

from on_demand import OnDemand
from smooth_sensor import MEASUREMENTS, RANGES, SIZE, TOUCH_PRIOR, curves, response, touch_change

torch, touch_training = OnDemand("torch"), OnDemand("eitskin.training.joint.touch_training")


@pytest.fixture(scope="module")
def learned():
    return response(features=2, unseen=2)


@pytest.fixture
def touches():
    return np.random.default_rng(1).uniform(TOUCH_PRIOR.low, TOUCH_PRIOR.high, (6, 3))


def plain(learned, p, touches, angle_deg):
    """The response by the formula of its docstring, touch by touch and layer by layer."""
    output = learned.output[0] + np.tensordot(p, learned.output[1:], axes=1)
    for touch in touches:
        hidden = learned.ranges.inputs(touch, angle_deg)
        for weight, bias in zip(learned.weights, learned.biases, strict=True):
            before = weight @ hidden + bias
            hidden = before / (1.0 + np.exp(-before))
        factor = touch[2] / learned.ranges.middle_force * learned.scale
        yield factor * output @ [*hidden, 1.0]


@pytest.mark.parametrize("layers", [1, 2, 4])
def test_response_is_that_of_the_plain_formula(learned, touches, layers):
    """Folding of scales into layers changes nothing, for any number of layers."""
    rng = np.random.default_rng(3)
    deep = replace(
        learned,
        weights=(learned.weights[0], *(0.1 * rng.standard_normal((layers - 1, 160, 160)))),
        biases=(learned.biases[0], *rng.standard_normal((layers - 1, 160))),
    )
    one, p = deep.for_specimen([0.5, -1.0]), [0.5, -1.0]
    expected = np.array(list(plain(deep, p, touches, 33.0)))
    size = np.abs(expected).max()
    np.testing.assert_allclose(one(touches, 33.0), expected, rtol=0, atol=1e-12 * size)
    said = one.with_derivatives(touches, 33.0)
    np.testing.assert_allclose(said[0], expected, rtol=0, atol=1e-12 * size)
    for by, step in zip(said[1:], 1e-6 * np.eye(3), strict=True):
        rise = one(touches + step, 33.0) - one(touches - step, 33.0)
        np.testing.assert_allclose(by, rise / 2e-6, rtol=0, atol=1e-5 * np.abs(by).max())


# Learning

STRENGTHS = np.exp(np.array([0.2, -0.2, 0.1, 0.0, -0.1, 0.15, -0.15, 0.0]))


def frames(count, seed):
    """Frames of one and two touches on eight specimens that differ in strength."""
    rng = np.random.default_rng(seed)
    touches = rng.uniform(TOUCH_PRIOR.low, TOUCH_PRIOR.high, (count, 2, 3))
    touches[rng.uniform(size=count) < 0.5, 1] = np.nan
    angle = rng.uniform(-20.0, 50.0, count)
    specimen = rng.integers(0, len(STRENGTHS), count)
    feature = np.linspace(-1.5, 1.5, len(STRENGTHS))[specimen]
    change = np.nansum([touch_change(touches[:, i], angle[:, None]) for i in range(2)], axis=0)
    # The feature makes some channels feel more and others less.
    change *= 1.0 + 0.05 * np.outer(feature, np.where(np.arange(28) % 2, 1.0, -1.0))
    change *= STRENGTHS[specimen][:, None]
    change += 1e-5 * rng.standard_normal(change.shape)
    return made_up_frames(change, angle, specimen, 1e-5, features=feature[:, None], touches=touches)


@pytest.mark.slow
@pytest.mark.parametrize("features", [0, 1])
def test_network_says_what_it_was_trained_to_say(features):
    """The response without torch equals the network's; one specimen gives no covariance."""
    data = frames(40, 4)
    data = replace(data, features=data.features[:, :features])
    network = touch_training.ResponseNetwork(data, RANGES)
    network.latent.data[:] = 0.4  # the same for all: then it is none
    with torch.inference_mode():
        said = network(touch_training.packed_inputs(data, RANGES)).numpy() * 0.5
    plain = touch_training.folded_response(network, np.unique(data.specimen), 0.5, RANGES)
    for i in range(40):
        touches = data.touches[i][np.isfinite(data.touches[i][:, 0])]
        alone = plain.for_specimen(data.features[i])(touches, float(data.angle_deg[i])).sum(axis=0)
        np.testing.assert_allclose(alone, said[i], atol=1e-5 * np.abs(said).max())


NAN = np.nan
X = np.array([[0.010, 0.050, NAN], [0.001, NAN, NAN], [0.120, 0.120, 0.090]])
Y = np.array([[0.020, 0.020, NAN], [0.030, NAN, NAN], [0.050, 0.010, 0.030]])
FORCE = np.array([[4.0, 6.0, NAN], [8.0, NAN, NAN], [4.0, 10.0, 6.0]])


@pytest.mark.slow
def test_priors_are_estimated_and_followed_with_changes_of_the_response(model):
    """Bounds lie 3 mm and 30 % beyond the touches, but on the sensor."""
    prior = TouchPrior.fit(np.stack([X, Y, FORCE], axis=-1), SIZE, 0.0075)
    np.testing.assert_allclose(prior.low, [0.0, 0.007, 0.3 * 4.0])
    np.testing.assert_allclose(prior.high, [0.123, 0.053, 1.3 * 10.0])
    assert prior.separation == pytest.approx(np.hypot(0.030, 0.020))
    known = FORCE[np.isfinite(FORCE)]
    mean = known.mean()
    assert prior.force == pytest.approx((mean, np.hypot(known.std(), 0.15 * mean)))
    np.testing.assert_allclose(prior.box[0], [0.0615, 0.030, mean])
    # The mean change over specimens and noise is that of `TouchResponse`.
    _, places = model.frames(4000, np.random.default_rng(1))
    there = np.isfinite(places[..., 0])
    counts = there.sum(axis=1)
    assert set(counts) == {0, 1, 2, 3, 4}
    assert 0.12 < np.mean(counts == 0) < 0.3
    for axis in range(2):
        values = places[..., axis][there]
        assert TOUCH_PRIOR.low[axis] <= values.min() < TOUCH_PRIOR.low[axis] + 0.002
        assert TOUCH_PRIOR.high[axis] - 0.002 < values.max() <= TOUCH_PRIOR.high[axis]
    for i in range(MAX_TOUCHES):
        for j in range(i):
            apart = np.hypot(*(places[:, i] - places[:, j]).T)
            assert np.nanmin(apart) >= TOUCH_PRIOR.separation
    rng = np.random.default_rng(2)
    touches = np.full((2000, MAX_TOUCHES, 3), np.nan)
    touches[:, 0] = [0.05, 0.02, 9.0]
    angle, features = np.full(2000, 20.0), np.zeros((2000, 1))
    change = model.touch_changes(touches, angle, features, rng)
    expected = model.response.for_specimen([0.0])(touches[0, :1], 20.0)[0]
    strong = expected > 0.3 * expected.max()
    mean = change.mean(axis=0) / np.exp(0.5 * touch_training.LOG_SENSITIVITY_STD**2)
    np.testing.assert_allclose(mean[strong], expected[strong], rtol=0.02)
    spread = np.std(change / expected, axis=0)[strong]
    np.testing.assert_allclose(spread, np.hypot(touch_training.LOG_SENSITIVITY_STD, 0.1), rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("mismatch", [0.03, 0.2])
def test_errors_of_a_response_are_found_next_to_those_of_noise_and_specimens(model, mismatch):
    """By what is left of frames that have strengths, q, errors in proportion, and noise."""
    made = replace(model, response=response(mismatch, features=1, unseen=2))
    rng = np.random.default_rng(8)
    touches = rng.uniform(TOUCH_PRIOR.low, TOUCH_PRIOR.high, (1500, 1, 3))
    angle, features = rng.uniform(-20.0, 50.0, 1500), rng.standard_normal((1500, 3))
    change = made.touch_changes(touches, angle, features, rng)
    change += 3e-4 * rng.standard_normal(change.shape)
    frames = made_up_frames(
        change, angle, np.arange(1500), 3e-4, features=features[:, :1], touches=touches
    )
    assert fit_mismatch(made.response, frames) == pytest.approx(mismatch, rel=0.08)


# Made-up frames and the places that are proposed


@pytest.fixture(scope="module")
def model():
    known = response(mismatch=0.1, features=1), curves(features=1)
    return touch_training.SyntheticFrames(*known, TOUCH_PRIOR, MEASUREMENTS)


# CombinedChange the map


def picture(*touches):
    """Network of constant output: bumps of these x, y and values."""
    columns, rows = np.linspace(0.01, 0.14, 27), np.linspace(0.01, 0.05, 9)
    x, y = np.meshgrid(columns, rows)
    values = np.full(x.shape, 1e-3)
    for px, py, value in touches:
        bump = value * np.exp(-0.5 * ((x - px) ** 2 + (y - py) ** 2) / 0.004**2)
        values = np.maximum(values, bump)
    logits = np.log(values / (1.0 - values)).ravel()
    return ProposalNetwork((np.zeros((len(logits), 3)),), (logits,), columns, rows)


def test_maps_are_those_of_the_formula_and_places_their_peaks():
    rng = np.random.default_rng(7)
    sizes = (30, 64, 64, 40)
    weights = tuple(rng.standard_normal((m, n)) / n**0.5 for n, m in pairwise(sizes))
    biases = tuple(rng.standard_normal(m) for m in sizes[1:])
    network = ProposalNetwork(weights, biases, np.arange(8.0), np.arange(5.0))
    inputs = hidden = rng.standard_normal(30)
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        before = weight @ hidden + bias
        hidden = before / (1.0 + np.exp(-before))
    expected = 1.0 / (1.0 + np.exp(-(weights[-1] @ hidden + biases[-1])))
    said = network.map(inputs)
    assert said.shape == (5, 8)
    np.testing.assert_allclose(said.ravel(), expected, atol=1e-5)
    found = picture((0.032, 0.023, 0.5), (0.112, 0.037, 0.9)).places(np.zeros(3), 0.030)
    np.testing.assert_allclose(found, [[0.112, 0.037], [0.032, 0.023]], atol=1.5e-3)


# Mirrors


NONE, ACROSS_X, ACROSS_Y, TURNED = (False, False), (True, False), (False, True), (True, True)
PAIRWISE = Protocol.pairwise(8)


def flips(design, protocol=PAIRWISE):
    return [mirror.flips for mirror in mirrors(design, protocol)]


def with_electrode(number, **changes):
    design = SensorDesign.reference()
    electrodes = list(design.electrodes)
    electrodes[number] = replace(electrodes[number], **changes)
    return replace(design, electrodes=tuple(electrodes))


@pytest.mark.slow
def test_touch_in_the_mirror_measures_what_the_mirror_says():
    """Agreement to rounding, because the mesh has the sensor's symmetries."""
    design, protocol = SensorDesign.reference(), Protocol.opposite(8)
    simulator = Simulator(design, "coarse", protocol=protocol)

    def magnitudes(x, y):
        scene = Scene(Bend(20.0), (Touch(float(x), float(y), 8.0),))
        return np.abs(simulator.measure(scene).impedance)

    here = magnitudes(0.045, 0.021)
    for mirror in mirrors(design, protocol)[1:]:
        there = magnitudes(*mirror.places(np.float64(0.045), np.float64(0.021)))
        assert not np.allclose(there, here, rtol=1e-4)
        np.testing.assert_allclose(there, here[mirror.order], rtol=1e-8)


CORNERS = ((0.0, 0.0), (0.15, 0.0), (0.15, 0.06), (0.0, 0.06))
CUT = ((0.0, 0.0), (0.15, 0.0), (0.15, 0.048), (0.14, 0.06), (0.0, 0.06))
REFERENCE = SensorDesign.reference()


@pytest.mark.parametrize(
    ("design", "kept"),
    [
        (with_electrode(0, x=0.025), [NONE]),
        (with_electrode(0, contact_impedance=2e-3), [NONE]),
        (with_electrode(0, width=0.006), [NONE]),
        (with_electrode(0, height=0.003), [NONE]),
        (with_electrode(1, contact_impedance=2e-3), [NONE, ACROSS_X]),
        (with_electrode(3, contact_impedance=2e-3), [NONE, ACROSS_Y]),
        (replace(REFERENCE, outline=Polygon(CORNERS)), [NONE, ACROSS_X, ACROSS_Y, TURNED]),
        (replace(REFERENCE, outline=Polygon(CUT)), [NONE]),
        (replace(REFERENCE, electrodes=REFERENCE.electrodes[:4]), [NONE]),
    ],
)
def test_outline_and_electrodes_must_have_images(design, kept):
    assert flips(design, Protocol.pairwise(len(design.electrodes))) == kept
