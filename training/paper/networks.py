"""Networks of the paper's method, for training: state classifier and post-processor.

Imports torch at its top. The stages import this module inside the functions that need it, so that
torch stays optional; `training/paper/layers.py` evaluates trained networks without it.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn  # noqa: TID253  see above

from eitskin.training.method.network_training import Batch

Maps = Callable[[Tensor, torch.Generator], Tensor]


class StateNetwork(nn.Module):
    """Encoder-decoder classifier of the paper, from a map to the logits of the three states.

    Three 3x3 convolutions (16, 32, 64) with batch norm and max pooling, mirrored by transposed
    convolutions that bring the map back to its size, two fully connected layers down to 16, and
    the layer whose softmax is taken. Maps (n, maps, rows, columns), multiples of eight.
    """

    def __init__(self, shape: tuple[int, int], maps: int) -> None:
        """Build the layers for `maps` maps of `shape`."""
        super().__init__()
        encoder = [_down(maps, 16), _down(16, 32), _down(32, 64)]
        decoder = [_up(64, 32), _up(32, 16), _up(16, 1)]
        head = [nn.Linear(shape[0] * shape[1], 64), nn.ReLU(), nn.Linear(64, 16), nn.ReLU()]
        self.layers = nn.Sequential(*encoder, *decoder, nn.Flatten(), *head, nn.Linear(16, 3))

    def forward(self, maps: Tensor) -> Tensor:
        """Logits (n, 3)."""
        logits: Tensor = self.layers(maps)
        return logits


class TouchMapNetwork(nn.Module):
    """Light post-processor, from a reconstruction to the logits of the touch map.

    One step down, dilated 3x3 convolutions whose receptive field is the whole sensor, one step up.
    Two further channels hold the coordinates of each pixel, because a reconstruction is sharp near
    the electrodes and blurred in the middle. Maps (n, 1, rows, columns), multiples of two.
    """

    place: Tensor

    def __init__(self, shape: tuple[int, int], width: int = 24) -> None:
        """Build the layers for maps of `shape`, with `width` channels at half resolution."""
        super().__init__()
        y, x = torch.meshgrid(*(torch.linspace(-1, 1, n) for n in shape), indexing="ij")
        self.register_buffer("place", torch.stack([y, x])[None], persistent=False)
        self.layers = nn.Sequential(
            nn.Conv2d(3, width, 3, stride=2, padding=1),
            nn.ReLU(),
            *(_dilated(width, dilation) for dilation in (1, 2, 4, 8, 1)),
            nn.ConvTranspose2d(width, 8, 4, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(8, 1, 3, padding=1),
        )

    def forward(self, maps: Tensor) -> Tensor:
        """Logits of the touch maps (n, 1, rows, columns)."""
        place = self.place.expand(len(maps), -1, -1, -1)
        logits: Tensor = self.layers(torch.cat([maps, place], dim=1))
        return logits


def _down(channels: int, filters: int) -> nn.Module:
    convolution = nn.Conv2d(channels, filters, 3, padding=1)
    return nn.Sequential(convolution, nn.BatchNorm2d(filters), nn.ReLU(), nn.MaxPool2d(2))


def _up(channels: int, filters: int) -> nn.Module:
    convolution = nn.ConvTranspose2d(channels, filters, 3, stride=2, padding=1, output_padding=1)
    return nn.Sequential(convolution, nn.BatchNorm2d(filters), nn.ReLU())


def _dilated(width: int, dilation: int) -> nn.Module:
    convolution = nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(width), nn.ReLU())


def noisy_maps(
    difference: ArrayLike, embedding: ArrayLike, shape: tuple[int, int], noise: ArrayLike
) -> Maps:
    """Source of maps of chosen frames, with new noise at every call.

    Args:
        difference: dV (n, measurements).
        embedding: linear, from dV to the maps (maps, pixels, measurements).
        shape: of a map.
        noise: rms, of all or of each channel, in units of dV.
    """
    dV = torch.as_tensor(np.asarray(difference, dtype=np.float32))
    layers = torch.as_tensor(np.asarray(embedding, dtype=np.float32))
    rms = torch.as_tensor(np.asarray(noise, dtype=np.float32))

    def maps(chosen: Tensor, generator: torch.Generator) -> Tensor:
        rows = dV[chosen]
        if rms.any():
            rows = rows + rms * torch.randn(rows.shape, generator=generator)
        return torch.einsum("nm,kpm->nkp", rows, layers).reshape(len(rows), -1, *shape)

    return maps


def mirrored(batch: Batch, flips: Sequence[tuple[bool, bool]]) -> Batch:
    """Source of samples that shows each one as a mirror image drawn from `flips`.

    Args:
        batch: maps and targets (n, maps, rows along y, columns along x).
        flips: whether x and whether y is reversed, for each mirror image.
    """
    if len(flips) < 2:
        return batch

    def drawn(chosen: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        pair = batch(chosen, generator)
        image = torch.randint(len(flips), (len(chosen),), generator=generator)
        for number, (x, y) in enumerate(flips):
            axes = [axis for axis, flip in ((-1, x), (-2, y)) if flip]
            for maps in pair:
                maps[image == number] = maps[image == number].flip(axes)
        return pair

    return drawn


def weights_of(network: nn.Module) -> dict[str, NDArray[np.generic]]:
    """All weights and batch statistics, by name."""
    return {name: tensor.numpy().copy() for name, tensor in network.state_dict().items()}
