"""Training of the networks of the paper's method. Imports torch at its top.

The stages import this module inside the functions that need it, so that torch stays optional;
`training/paper/layers.py` evaluates trained networks without it.
"""

from collections.abc import Callable, Sequence
from contextlib import nullcontext

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn  # noqa: TID253  see above

from eitskin.threads import one_torch_thread
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.network_training import (
    Loss,
    Samples,
    seeded_network,
    train_network,
)
from eitskin.training.method.settings import NetworkSettings
from eitskin.training.paper.layers import Layer, coordinates

Flips = Sequence[tuple[bool, bool]]

MAX_SHOWN_ALONE = 30_000
"""Frames shown in a short training, for which several threads would wait longer than they work."""


def layer_network(layers: Sequence[Layer]) -> nn.Sequential:
    """Network of a table of layers, with weights drawn from torch's own generator."""
    modules: list[nn.Module] = []
    for layer in layers:
        if layer.kind == "dense" and not isinstance(modules[-1], nn.ReLU | nn.Flatten):
            modules.append(nn.Flatten())
        tail: list[nn.Module] = [nn.BatchNorm2d(layer.outputs)] if layer.normed else []
        tail += [nn.ReLU()] if layer.rectified else []
        tail += [nn.MaxPool2d(2)] if layer.pooled else []
        parts = [_weights(layer), *tail]
        modules += [nn.Sequential(*parts)] if layer.normed else parts
    return nn.Sequential(*modules)


def _weights(layer: Layer) -> nn.Module:
    ends = (layer.inputs, layer.outputs)
    if layer.kind == "dense":
        return nn.Linear(*ends)
    if layer.kind == "transposed":
        size = layer.size
        return nn.ConvTranspose2d(*ends, size, stride=2, padding=1, output_padding=size % 2)
    s, d = layer.stride, layer.dilation
    return nn.Conv2d(*ends, layer.size, stride=s, padding=d, dilation=d, bias=layer.bias)


def train_layers(
    layers: Sequence[Layer],
    frames: tuple[ArrayLike, NDArray[np.generic]],
    embedding: ArrayLike,
    shape: tuple[int, int],
    loss: Loss,
    settings: NetworkSettings,
    noise: ArrayLike,
    seed: int,
    progress: Callable[[int, int], None],
    validation: tuple[ArrayLike, NDArray[np.generic]] | None,
    *,
    compress: bool = False,
    placed: bool = False,
    flips: Flips = ((False, False),),
) -> tuple[dict[str, NDArray[np.generic]], LearningCurve]:
    """Weights and batch statistics, by name, of a network that is fitted to maps, and its losses.

    Args:
        layers: layers of the network.
        frames: dV (n, measurements) and targets (n, ...).
        embedding: linear, from dV to maps (maps, pixels, measurements).
        shape: rows and columns of a map.
        loss: loss of logits and targets.
        settings: settings of the training.
        noise: rms noise of dV, of all or of each channel, the unit of `settings.noise`.
        seed: seed of initial weights, order and added noise.
        progress: called after every epoch.
        validation: dV and targets of other frames, whose loss is recorded after every epoch.
        compress: whether asinh is taken of the maps.
        placed: whether the coordinates of the pixels are channels next to the maps.
        flips: mirror images of each frame, of which one is drawn whenever it is used: whether x
            and whether y is reversed.
    """

    place = torch.as_tensor(coordinates(shape))

    def samples(
        difference: ArrayLike, truth: NDArray[np.generic], rms: ArrayLike, flips: Flips = ()
    ) -> Samples:
        dV, matrix, deviation = (
            torch.as_tensor(np.asarray(values, dtype=np.float32))
            for values in (difference, embedding, rms)
        )
        targets = torch.as_tensor(truth)

        def batch(chosen: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
            rows = dV[chosen]
            if deviation.any():  # new noise whenever a frame is used
                rows = rows + deviation * torch.randn(rows.shape, generator=generator)
            maps = torch.einsum("nm,kpm->nkp", rows, matrix).reshape(len(rows), -1, *shape)
            maps, wanted = torch.asinh(maps) if compress else maps, targets[chosen]
            if len(flips) > 1:
                flip_samples((maps, wanted), flips, generator)
            if placed:
                maps = torch.cat([maps, place.expand(len(maps), -1, -1, -1)], dim=1)
            return maps, wanted

        return Samples(batch, len(targets))

    network = seeded_network(lambda: layer_network(layers), seed)
    # Convolutions take half as long.
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    fitted = samples(*frames, settings.noise * np.asarray(noise), flips)
    unseen = None if validation is None else samples(*validation, 0.0)
    batch, count = fitted.batch, fitted.count
    shown = settings.count_epochs(count) * count
    with one_torch_thread() if shown <= MAX_SHOWN_ALONE else nullcontext():
        history = train_network(network, batch, loss, count, settings, seed, progress, unseen)
    return network_weights(network), history


def flip_samples(pair: tuple[Tensor, Tensor], flips: Flips, generator: torch.Generator) -> None:
    """Replace samples by mirror images drawn from `flips`.

    Args:
        pair: maps and targets (n, maps, rows along y, columns along x).
        flips: whether x and whether y is reversed, for each mirror image.
        generator: random generator of the images.
    """
    image = torch.randint(len(flips), (len(pair[0]),), generator=generator)
    for number, (x, y) in enumerate(flips):
        axes = [axis for axis, flip in ((-1, x), (-2, y)) if flip]
        for maps in pair:
            maps[image == number] = maps[image == number].flip(axes)


def network_weights(network: nn.Module) -> dict[str, NDArray[np.generic]]:
    """All weights and batch statistics, by name."""
    return {name: tensor.numpy().copy() for name, tensor in network.state_dict().items()}
