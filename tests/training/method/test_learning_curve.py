"""The trainer of all networks: losses on training frames and on validation frames."""

import numpy as np
import pytest
import torch

from eitskin.errors import ConfigurationError
from eitskin.threads import one_torch_thread
from eitskin.training import NetworkSettings
from eitskin.training.method.network_training import Samples, train_network

INPUTS = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
TARGETS = INPUTS @ np.float32([[1.0], [-2.0], [0.5]])


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    with one_torch_thread():
        yield


def samples(inputs, targets):
    x, y = torch.tensor(inputs), torch.tensor(targets)
    return Samples(lambda chosen, _: (x[chosen], y[chosen]), len(x))


def fit(validation=None, rate=0.1, epochs=12):
    """Learning curve and weights of a line that begins at zero."""
    network = torch.nn.Linear(3, 1, bias=False)
    torch.nn.init.zeros_(network.weight)
    settings = NetworkSettings(rate, epochs=epochs, batch=16, one_cycle=False)
    given, loss = samples(INPUTS, TARGETS), torch.nn.functional.mse_loss
    history = train_network(
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


def test_divergence_is_refused():
    with pytest.raises(ConfigurationError, match=r"epoch \d+.*learning_rate"):
        fit(rate=1e30, epochs=30)
