"""Training loop of the networks. Imports torch at its top.

Stages import this module inside the functions that need it, so that torch stays optional.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import isfinite
from typing import TypeVar

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import NDArray
from torch import Tensor, nn  # noqa: TID253  see above

from eitskin.geometry import ConfigurationError
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.settings import NetworkSettings
from eitskin.training.method.soap import Soap

Network = TypeVar("Network", bound=nn.Module)
Batch = Callable[[Tensor, torch.Generator], tuple[Tensor, Tensor]]
Loss = Callable[[Tensor, Tensor], Tensor]

WARM_UP, SOAP_WARM_UP = 0.3, 0.1  # shares of the steps of a one-cycle schedule, of Adam and SOAP
EVALUATED_AT_ONCE = 256  # samples; bounds the memory that a large dataset takes


def seeded_network(make: Callable[[], Network], seed: int) -> Network:
    """Network that `make` returns, with weights drawn from `seed`; torch's seed is kept."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


def as_tensor(values: NDArray[np.floating]) -> Tensor:
    """Tensor (...) of an array (...), in single precision."""
    return torch.as_tensor(np.ascontiguousarray(values, dtype=np.float32))


def as_array(tensor: Tensor) -> NDArray[np.float64]:
    """Array (...) of a tensor (...), in double precision."""
    array: NDArray[np.float64] = tensor.detach().numpy().astype(float)
    return array


def linear_layers(
    layers: Iterable[nn.Module],
) -> tuple[tuple[NDArray[np.float64], ...], tuple[NDArray[np.float64], ...]]:
    """Weights (outputs, inputs) and biases (outputs,) of the linear ones among some layers."""
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    return tuple(as_array(x.weight) for x in linear), tuple(as_array(x.bias) for x in linear)


def dense_layers(sizes: Sequence[int], between: type[nn.Module] = nn.SiLU) -> nn.Sequential:
    """Linear layers of these sizes, with a function between them."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), between()]
    return nn.Sequential(*layers[:-1])


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples for validation.

    Attributes:
        batch: inputs and targets of given indices.
        count: number of samples.
    """

    batch: Batch
    count: int


def train_network(
    network: nn.Module,
    batch: Batch,
    loss: Loss,
    count: int,
    settings: NetworkSettings,
    seed: int,
    progress: Callable[[int, int], None],
    validation: Samples | None = None,
) -> LearningCurve:
    """Train with Adam or SOAP and return the mean losses of every epoch.

    Args:
        network: trained in place.
        batch: inputs and targets of given indices.
        loss: loss of outputs and targets.
        count: number of samples.
        settings: settings of the training.
        seed: seed of the order of samples and of added noise.
        progress: called after every epoch with epochs done and total.
        validation: samples whose loss is recorded; the weights do not depend on them.

    Raises ConfigurationError where the loss is no longer finite.
    """
    generator = torch.Generator().manual_seed(seed)
    optimiser: torch.optim.Optimizer = (
        Soap(network.parameters(), settings.learning_rate)
        if settings.soap
        else torch.optim.Adam(network.parameters(), lr=settings.learning_rate)
    )
    batch_size, epochs = settings.batch, settings.count_epochs(count)
    steps = epochs * -(-count // batch_size)
    # Only where asked for: creating the schedule already lowers the learning rate.
    anneal = (
        torch.optim.lr_scheduler.OneCycleLR(
            optimiser,
            settings.learning_rate,
            steps,
            pct_start=SOAP_WARM_UP if settings.soap else WARM_UP,
            cycle_momentum=not settings.soap,
        )
        if settings.one_cycle
        else None
    )
    fitted, unseen = [], []
    for epoch in range(epochs):
        network.train()
        total = 0.0
        for chosen in torch.split(torch.randperm(count, generator=generator), batch_size):
            inputs, targets = batch(chosen, generator)
            optimiser.zero_grad(set_to_none=True)
            value = loss(network(inputs), targets)
            value.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            if anneal:
                anneal.step()
            total += value.item() * len(chosen)
        network.eval()
        fitted.append(_finite(total / count, epoch, settings))
        if validation is not None:
            unseen.append(_finite(mean_loss(network, validation, loss), epoch, settings))
        progress(epoch + 1, epochs)
    return LearningCurve(tuple(fitted), tuple(unseen))


def mean_loss(network: nn.Module, samples: Samples, loss: Loss) -> float:
    """Mean loss per sample of a network in evaluation mode."""
    generator = torch.Generator()
    total = 0.0
    with torch.inference_mode():
        for chosen in torch.split(torch.arange(samples.count), EVALUATED_AT_ONCE):
            inputs, targets = samples.batch(chosen, generator)
            total += loss(network(inputs), targets).item() * len(chosen)
    return total / samples.count


def _finite(value: float, epoch: int, settings: NetworkSettings) -> float:
    """The loss; raises ConfigurationError where it is not finite."""
    if not isfinite(value):
        raise ConfigurationError(
            f"training diverged in epoch {epoch + 1}: the loss is {value}; lower learning_rate, "
            f"which is {settings.learning_rate:g}, and look for values in the frames that are not "
            "finite"
        )
    return value
