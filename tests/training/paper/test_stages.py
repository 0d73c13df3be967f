"""Stages of the paper: picture, state, touch map, touches, bend angle."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.training import NetworkSettings, TrainingSettings
from eitskin.training.method.observations import MissingChannels
from eitskin.training.paper.layers import Network, state_layers, touch_map_layers
from eitskin.training.paper.stages import (
    MAX_SNR,
    BendAngle,
    Classifier,
    Reconstruction,
    find_touches,
    signal_to_noise,
)

from on_demand import OnDemand

torch, networks = OnDemand("torch"), OnDemand("eitskin.training.paper.networks")
network_training = OnDemand("eitskin.training.method.network_training")

SHAPE = (8, 16)
X, Y = np.meshgrid((np.arange(16) + 0.5) * 0.01, (np.arange(8) + 0.5) * 0.01)


# A toy sensor of 8 x 16 pixels: thirty channels, each of which sees a blurred column or row.
JACOBIAN = np.array(
    [np.exp(-((X - place) ** 2) / 3e-4).ravel() for place in np.linspace(0, 0.16, 20)]
    + [np.exp(-((Y - place) ** 2) / 3e-4).ravel() for place in np.linspace(0, 0.08, 10)]
)


@pytest.fixture(scope="module")
def reconstruction():
    return Reconstruction.fit(JACOBIAN, snr=100.0, shape=SHAPE)


@pytest.fixture(scope="module")
def embedding(reconstruction):
    return reconstruction.matrix[None]


@pytest.fixture(scope="module")
def presses():
    """dV and touch maps of 300 presses of the toy sensor, 20 mm across."""
    rng = np.random.default_rng(0)
    centres = rng.uniform([0.02, 0.02], [0.14, 0.06], size=(300, 2))
    distance = np.hypot(X - centres[:, :1, None], Y - centres[:, 1:, None])
    maps = np.clip(1.5 - distance / 0.01, 0, 1).astype(np.float32)
    return maps.reshape(300, -1) @ JACOBIAN.T, maps, centres


# Missing channels


def test_missing_channels_are_what_the_others_say():
    """Exact for signals of few shapes; nothing is made up where the channels say nothing."""
    rng = np.random.default_rng(0)
    shapes = rng.normal(size=(3, 10))
    dV = rng.normal(size=(500, 3)) @ shapes
    stage = MissingChannels.fit(dV, noise=1e-6)
    whole = rng.normal(size=3) @ shapes
    holed = np.where(np.isin(np.arange(10), [2, 7]), np.nan, whole)
    np.testing.assert_allclose(stage.fill(holed[None])[0], whole, atol=1e-6)
    np.testing.assert_array_equal(stage.fill(whole[None])[0], whole)
    independent = MissingChannels.fit(np.eye(10), noise=1e-6)
    assert independent.fill(holed[None])[0, 2] == pytest.approx(0.0, abs=1e-9)


# Networks

BRIEF = NetworkSettings(3e-3, epochs=20, batch=16)


@pytest.fixture(scope="module")
def states(presses):
    """dV and states: nothing, presses, and a smooth change along the sensor."""
    dV, _, _ = presses
    rng = np.random.default_rng(3)
    state = np.arange(300) % 3
    bend = np.concatenate([np.linspace(-1, 1, 20), np.zeros(10)]) * dV.std() * 3
    signal = np.where((state == 1)[:, None], dV, 0) + np.outer((state == 2), bend)
    return signal + rng.normal(size=dV.shape) * dV.std() * 0.05, state


@pytest.mark.slow
def test_classifier_learns_and_generalises(states, embedding):
    """From standardised maps or compressed ones."""
    dV, state = states
    brief = dataclasses.replace(BRIEF, epochs=8)
    plain, compressed = (
        Classifier.fit(dV[:240], state[:240], embedding, SHAPE, brief, compress=compress)
        for compress in (False, True)
    )
    for stage in (plain, compressed):
        probabilities = stage.apply(dV[240:])
        np.testing.assert_allclose(probabilities.sum(axis=1), 1.0)
        assert np.mean(probabilities.argmax(axis=1) == state[240:]) > 0.95
    maps = dV[:240] @ plain.embedding[0].T
    assert np.std(maps) == pytest.approx(1.0)
    assert np.std((dV[:240] @ compressed.embedding[0].T)[state[:240] == 0]) == pytest.approx(0.5)
    again = Classifier.from_arrays(compressed.arrays(), shape=SHAPE)
    assert again.history == compressed.history
    np.testing.assert_array_equal(again.apply(dV), compressed.apply(dV))
    pictures = maps.reshape(-1, 1, *SHAPE)
    logits = by_torch(networks.layer_network(state_layers(SHAPE, 1)), plain.weights, pictures)
    odds = np.exp(logits - logits.max(axis=1, keepdims=True))
    expected = odds / odds.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(plain.apply(dV[:240]), expected, atol=1e-6)


def by_torch(network, weights, maps):
    """Logits of torch's own evaluation of a network."""
    network.load_state_dict({name: torch.tensor(array) for name, array in weights.items()})
    with torch.inference_mode():
        return network.eval()(torch.tensor(maps, dtype=torch.float32)).numpy()


@pytest.mark.slow
@pytest.mark.parametrize("layers", [touch_map_layers(), state_layers((16, 40), 2)])
def test_networks_evaluated_by_numpy_are_torchs(layers):
    """Weights and batch statistics that were drawn, on maps of other sides than the toy sensor."""
    network = networks.layer_network(layers)
    rng = np.random.default_rng(1)
    weights = {
        name: rng.uniform(0.5, 1.5, array.shape).astype(np.float32)
        if name.endswith(("running_var", "1.weight"))
        else rng.normal(0.0, 0.1, array.shape).astype(array.dtype)
        for name, array in networks.network_weights(network).items()
    }
    inputs = rng.normal(size=(70, layers[0].inputs, 16, 40)).astype(np.float32)  # two batches
    expected = by_torch(network, weights, inputs)
    found = Network.from_arrays(layers, weights).logits(inputs)
    assert np.ptp(expected) > 0.01
    np.testing.assert_allclose(found, expected, atol=2e-6 * np.abs(expected).max())


@pytest.mark.slow
def test_mirror_images_are_drawn_with_their_targets():
    maps = torch.arange(12.0).reshape(2, 1, 2, 3)
    flips = [(False, False), (True, False), (False, True), (True, True)]
    seen, generator = set(), torch.Generator().manual_seed(0)
    for _ in range(40):
        pictures, targets = maps[1:].clone(), 10.0 * maps[1:]
        networks.flip_samples((pictures, targets), flips, generator)
        assert torch.equal(targets, 10.0 * pictures)
        seen.add(tuple(pictures.ravel().tolist()))
    assert seen == {(6, 7, 8, 9, 10, 11), (8, 7, 6, 11, 10, 9), (9, 10, 11, 6, 7, 8),
                    (11, 10, 9, 8, 7, 6)}  # fmt: skip


def test_settings_are_the_papers_and_touches_weighted_centroids_strongest_first():
    whole = TrainingSettings.preset("paper")
    paper = whole.classifier
    assert (paper.learning_rate, paper.epochs, paper.batch, paper.noise) == (1e-5, 150, 64, 0)
    assert not any((paper.one_cycle, whole.bend_free_map, whole.compressed_maps))
    touch_map = np.zeros((32, 80))
    touch_map[10:14, 20:24] = 0.8
    touch_map[20:24, 60:64] = [[0.5, 0.5, 1.0, 1.0]] * 4
    touch_map[2:6, 2:6] = 0.2  # faint
    touch_map[28, 40:43] = 1.0  # tiny
    pixel = 0.150 / 80
    weighted = (60.5 + 61.5 + 2 * 62.5 + 2 * 63.5) / 6
    expected = [(weighted * pixel, 22 * pixel, 1.0), (22 * pixel, 12 * pixel, 0.8)]
    assert find_touches(touch_map, (0.150, 0.060)) == pytest.approx(np.array(expected))
    assert find_touches(np.zeros((32, 80)), (0.150, 0.060)).shape == (0, 3)


# One-step Gauss-Newton with the NOSER prior


@pytest.fixture
def jacobian():
    return np.random.default_rng(0).normal(size=(12, 128)) * np.geomspace(0.4, 1, 128)


def test_channels_weigh_by_noise_which_signal_to_noise_takes_off(jacobian):
    noise = np.geomspace(1e-4, 1e-1, 12)
    made = Reconstruction.fit(jacobian, 20.0, SHAPE, noise)
    precision = np.diag(noise**-2)
    seen = np.einsum("mp,mn,np->p", jacobian, precision, jacobian)
    prior = np.diag(np.maximum(seen, 0.1 * np.median(seen)))
    gram = jacobian.T @ precision @ jacobian + made.regularisation**2 * prior
    expected = np.linalg.solve(gram, jacobian.T @ precision)
    np.testing.assert_allclose(made.matrix, expected, rtol=1e-6, atol=1e-9)
    alike = Reconstruction.fit(jacobian, 20.0, SHAPE, np.full(12, 0.3)).matrix
    plain = Reconstruction.fit(jacobian, 20.0, SHAPE).matrix
    np.testing.assert_allclose(alike, plain, rtol=1e-9)
    touch = np.random.default_rng(2).normal(size=(5000, 20)) * np.hypot(3.0, 1.0)
    assert signal_to_noise(touch, 1.0) == pytest.approx(3.0, rel=0.02)
    assert signal_to_noise(touch, 0.0) == MAX_SNR
    assert 0 < signal_to_noise(touch, 100.0) < 1
    assert Reconstruction.fit(jacobian, snr=np.inf, shape=SHAPE).regularisation > 0


# The bend angle: which channels it is learned from, how many, and from whom


def bends(count=200, seed=0):
    """Two of six channels follow the angle; the others are noise."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-20, 50, count)
    dV = rng.normal(size=(count, 6)) * 1e-4
    dV[:, 1] += 1e-3 * angle
    dV[:, 4] -= 2e-3 * angle
    return dV, angle


@pytest.mark.slow
@pytest.mark.parametrize(("specimens", "count"), [(1, 200), (7, 200), (9, 53), (1, 11), (5, 13)])
def test_bend_angle_is_what_a_search_over_a_grid_finds(specimens, count):
    """scikit-learn's own search, also where there are more features than frames of a fold."""
    from sklearn.feature_selection import SelectKBest, f_regression
    from sklearn.linear_model import LinearRegression
    from sklearn.model_selection import GridSearchCV, GroupKFold, KFold
    from sklearn.pipeline import make_pipeline

    dV, angle = bends(count, seed=5)
    dV = np.concatenate([dV, 0.5 * dV[::-1]], axis=1) if count < 20 else dV
    specimen = (np.arange(count) ** 2 // 5 if specimens == 9 else np.arange(count)) % specimens
    stage = BendAngle.fit(dV, angle, specimen, seed=3, squares=False)
    folds = KFold(5, shuffle=True, random_state=3) if specimens == 1 else GroupKFold(5)
    search = GridSearchCV(
        make_pipeline(SelectKBest(f_regression), LinearRegression()),
        {"selectkbest__k": range(1, dV.shape[1] + 1)},
        scoring="neg_mean_squared_error",
        cv=folds,
    ).fit(dV, angle, groups=None if specimens == 1 else specimen)
    selection, regression = (step for _, step in search.best_estimator_.steps)
    np.testing.assert_array_equal(stage.features, np.flatnonzero(selection.get_support()))
    np.testing.assert_allclose(stage.coefficients, regression.coef_, rtol=1e-9)
    assert stage.intercept == pytest.approx(regression.intercept_, rel=1e-9)


# The trainer of all networks: losses on training frames and on validation frames

INPUTS = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
TARGETS = INPUTS @ np.float32([[1.0], [-2.0], [0.5]])


def samples(inputs, targets):
    x, y = torch.tensor(inputs), torch.tensor(targets)
    return network_training.Samples(lambda chosen, _: (x[chosen], y[chosen]), len(x))


def fit(validation=None, rate=0.1, epochs=12):
    """Learning curve and weights of a line that begins at zero."""
    network = torch.nn.Linear(3, 1, bias=False)
    torch.nn.init.zeros_(network.weight)
    settings = NetworkSettings(rate, epochs=epochs, batch=16, one_cycle=False)
    given, loss = samples(INPUTS, TARGETS), torch.nn.functional.mse_loss
    history = network_training.train_network(
        network, given.batch, loss, given.count, settings, 0, lambda *_: None, validation
    )
    return history, network.weight.detach().numpy()


@pytest.mark.slow
def test_losses_fall_to_those_of_the_trained_network():
    """Looking at other frames changes no weight."""
    history, weights = fit(samples(INPUTS[:10], TARGETS[:10]))
    assert len(history.training) == len(history.validation) == 12
    assert history.training[0] > 20 * history.training[-1]
    error = INPUTS[:10] @ weights.T - TARGETS[:10]
    assert history.validation[-1] == pytest.approx(np.mean(error**2), rel=1e-5)
    alone, same = fit()
    assert alone.validation == ()
    np.testing.assert_array_equal(same, weights)
    first, _ = fit(rate=1e-12, epochs=1)
    assert first.training[0] == pytest.approx(np.mean(TARGETS**2), rel=1e-5)


@pytest.mark.slow
def test_divergence_is_refused():
    with pytest.raises(ConfigurationError, match=r"epoch \d+.*learning_rate"):
        fit(rate=1e30, epochs=30)
