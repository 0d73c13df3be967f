"""Learning curves: losses on training frames and on validation frames."""

import numpy as np
import pytest
import torch

from eitskin.errors import ConfigurationError
from eitskin.threads import one_torch_thread
from eitskin.training import NetworkSettings
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.network_training import Samples, mean_loss, train_network
from eitskin.training.paper.reconstruction import Reconstruction
from eitskin.training.paper.stages import Classifier, PostProcessor

SHAPE = (8, 16)
RNG = np.random.default_rng(0)
INPUTS = RNG.normal(size=(40, 3)).astype(np.float32)
TARGETS = INPUTS @ np.float32([[1.0], [-2.0], [0.5]])


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    with one_torch_thread():
        yield


def samples(inputs, targets):
    x, y = torch.tensor(inputs), torch.tensor(targets)
    return Samples(lambda chosen, _: (x[chosen], y[chosen]), len(x))


def line(weight=0.0):
    network = torch.nn.Linear(3, 1, bias=False)
    torch.nn.init.constant_(network.weight, weight)
    return network


def fit(network, validation=None, rate=0.1, epochs=12):
    settings = NetworkSettings(rate, epochs=epochs, batch=16, one_cycle=False)
    given = samples(INPUTS, TARGETS)
    loss = torch.nn.functional.mse_loss
    return train_network(
        network, given.batch, loss, given.count, settings, 0, lambda *_: None, validation
    )


def test_mean_loss_weighs_samples_and_not_pieces():
    """300 samples in batches of 256 and 44, with the squared target as loss."""
    targets = np.arange(300, dtype=np.float32)[:, None]
    given = samples(np.zeros((300, 3), np.float32), targets)
    found = mean_loss(line(), given, torch.nn.functional.mse_loss)
    assert found == pytest.approx(np.mean(np.arange(300.0) ** 2), rel=1e-6)


@pytest.mark.slow
def test_losses_fall_to_those_of_the_trained_network():
    network = line()
    history = fit(network, samples(INPUTS[:10], TARGETS[:10]))
    assert len(history.training) == len(history.validation) == 12
    assert history.training[0] > 20 * history.training[-1]
    error = INPUTS[:10] @ network.weight.detach().numpy().T - TARGETS[:10]
    assert history.validation[-1] == pytest.approx(np.mean(error**2), rel=1e-5)


@pytest.mark.slow
def test_first_loss_is_that_of_the_epoch_with_weights_that_hardly_move():
    history = fit(line(), rate=1e-12, epochs=1)
    assert history.training[0] == pytest.approx(np.mean(TARGETS**2), rel=1e-5)
    assert history.validation == ()


@pytest.mark.slow
def test_looking_at_other_frames_changes_no_weight():
    first, second = line(), line()
    fit(first)
    fit(second, samples(INPUTS[:7], -TARGETS[:7]))
    assert np.array_equal(first.weight.detach().numpy(), second.weight.detach().numpy())


def test_divergence_is_refused():
    with pytest.raises(ConfigurationError, match=r"epoch \d+.*learning_rate"):
        fit(line(), rate=1e30, epochs=30)


def test_history_survives_as_arrays():
    history = LearningCurve((0.5, 0.25), (0.75,))
    assert LearningCurve.from_arrays(history.arrays()) == history
    assert LearningCurve.from_arrays({}) == LearningCurve()


def test_stages_keep_their_history_beside_their_weights():
    X, _ = np.meshgrid(np.arange(16), np.arange(8))
    J = np.array([np.exp(-((X - place) ** 2) / 4).ravel() for place in range(0, 16, 2)])
    reconstruction = Reconstruction.fit(J, snr=100.0, shape=SHAPE)
    dV = RNG.normal(size=(30, 8))
    state = np.arange(30) % 3
    brief = NetworkSettings(1e-3, epochs=2, batch=16)
    told = {"validation": (dV[:9], state[:9])}
    embedding = reconstruction.matrix[None]
    classifier = Classifier.fit(dV, state, embedding, SHAPE, brief, **told)
    alone = Classifier.fit(dV, state, embedding, SHAPE, brief)
    assert [len(losses) for losses in (classifier.history.training, alone.history.training)] == [
        2,
        2,
    ]
    assert (len(classifier.history.validation), alone.history.validation) == (2, ())
    ours, theirs = classifier.weights, alone.weights
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)
    assert Classifier.from_arrays(classifier.arrays(), shape=SHAPE).history == classifier.history

    maps = (reconstruction.apply(dV) > 0).astype(float)
    processor = PostProcessor.fit(dV, maps, reconstruction, brief, validation=(dV[:9], maps[:9]))
    assert len(processor.history.training) == len(processor.history.validation) == 2
    assert PostProcessor.from_arrays(processor.arrays()).history == processor.history
