"""How a touch response is trained. Imports torch at its top; import it where it is needed.

Everything that is trained here is evaluated by `TouchResponse` without torch.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import NDArray
from torch import Tensor, nn  # noqa: TID253  see above

from eitskin.training.joint.touch_response import Ranges, TouchResponse
from eitskin.training.method.learning_curve import History
from eitskin.training.method.networks import seeded, train
from eitskin.training.method.settings import NetworkSettings, Progress

Array = NDArray[np.float64]

HIDDEN = 96
LAYERS = 3
SPREAD = 0.15  # of the strengths with which touches act on different specimens
UNSEEN = 2  # ways in which specimens differ that only their touches show
TRUST = 0.05  # relative error of a frame's change that is of no more concern than its noise


@dataclass(frozen=True, slots=True, eq=False)
class TouchFrames:
    """n touched frames to learn from.

    Attributes:
        touches: x [m], y [m] and force [N] of up to k touches, NaN where absent (n, k, 3).
        angle_deg: (n,) [deg].
        features: of their specimens (n, P).
        specimen: number of the specimen, from 0 on (n,); mirror images keep it.
        change: of log V (n, C).
    """

    touches: Array
    angle_deg: Array
    features: Array
    specimen: NDArray[np.int64]
    change: Array

    def __getitem__(self, rows: NDArray[np.generic]) -> "TouchFrames":
        """The frames of `rows` (integers or mask)."""
        return TouchFrames(
            self.touches[rows],
            self.angle_deg[rows],
            self.features[rows],
            self.specimen[rows],
            self.change[rows],
        )


class ResponseNetwork(nn.Module):
    """The network of `TouchResponse`, and strength and q of each specimen that it learns from.

    How strongly a specimen feels does not show in its flat resistances; let free, strengths do
    not blur the shape of the response. Their geometric mean is held at one.
    """

    def __init__(self, frames: TouchFrames) -> None:
        """Make it for the touches, channels, features and specimens of these frames."""
        super().__init__()
        sizes = [4] + [HIDDEN] * LAYERS
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.touches, self.channels = frames.touches.shape[1], frames.change.shape[1]
        self.features = frames.features.shape[1]
        terms = 1 + self.features + UNSEEN
        self.output = nn.Linear(HIDDEN + 1, self.channels * terms, bias=False)
        with torch.no_grad():  # begin near a response that is the same for all specimens
            self.output.weight[self.channels :] *= 0.1
        specimens = int(frames.specimen.max()) + 1
        self.log_strength = nn.Parameter(torch.zeros(specimens))
        # Zeros would stay zeros: the gradient of each factor is the other.
        self.unseen = nn.Parameter(0.3 * torch.randn(specimens, UNSEEN))

    def forward(self, packed: Tensor) -> Tensor:
        """Changes (n, C), in units of `scale`, of frames packed as `_packed` does."""
        sizes = [4 * self.touches, self.touches, self.features, 1]
        inputs, factors, features, specimen = torch.split(packed, sizes, dim=1)
        hidden = inputs.reshape(len(packed), self.touches, 4)
        for layer in self.layers:
            hidden = nn.functional.silu(layer(hidden))
        hidden = torch.cat([hidden, torch.ones_like(hidden[..., :1])], dim=-1)
        # Linear in the touches' factors: added up before the large matrix product.
        summed = (hidden * factors[..., None]).sum(dim=1)
        terms = self.output(summed).reshape(len(packed), -1, self.channels)
        number = specimen[:, 0].long()
        share = torch.cat([torch.ones_like(specimen), features, self.unseen[number]], dim=1)
        strength = torch.exp(self.log_strength - self.log_strength.mean())
        change: Tensor = torch.einsum("npc,np->nc", terms, share)
        return change * strength[number][:, None]


def fit_response(
    frames: TouchFrames,
    ranges: Ranges,
    noise: float,
    settings: NetworkSettings,
    seed: int,
    progress: Progress,
) -> tuple[TouchResponse, History]:
    """Learn a response from frames whose changes have noise of this rms; mismatch is still zero."""
    scale = float(np.sqrt(np.mean(frames.change**2)))
    network = seeded(lambda: ResponseNetwork(frames), seed)
    inputs, change = _packed(frames, ranges), _tensor(frames.change / scale)
    # Strong touches may be a few percent off, weak ones by their noise: both count alike.
    variance = (noise / scale) ** 2 + TRUST**2 * change.square().mean(dim=1, keepdim=True)
    weighted = torch.cat([change, variance.mean() / variance], dim=1)

    def loss(said: Tensor, target: Tensor) -> Tensor:
        error = ((said - target[:, :-1]).square() * target[:, -1:]).mean()
        departures = (network.log_strength / SPREAD).square().mean()
        return error + 1e-3 * (departures + network.unseen.square().mean())

    history = train(
        network,
        lambda chosen, _: (inputs[chosen], weighted[chosen]),
        loss,
        len(change),
        settings,
        seed,
        lambda done, total: progress("touch response", done, total),
    )
    return _response(network, np.unique(frames.specimen), scale, ranges), history


def _packed(frames: TouchFrames, ranges: Ranges) -> Tensor:
    """One row per frame: inputs and factors of each touch, features, number of the specimen."""
    inputs = ranges.inputs(frames.touches, frames.angle_deg[:, None])
    columns = [
        np.nan_to_num(inputs).reshape(len(inputs), -1),
        np.nan_to_num(frames.touches[..., 2] / ranges.middle_force),  # of no touch, nothing
        frames.features,
        frames.specimen[:, None],
    ]
    return _tensor(np.concatenate(columns, axis=1))


def _tensor(values: Array) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(values, dtype=np.float32))


def _response(
    network: ResponseNetwork, specimens: NDArray[np.int64], scale: float, ranges: Ranges
) -> TouchResponse:
    """The trained response; q is brought to mean zero and variance one over the specimens."""

    def plain(tensor: Tensor) -> Array:
        array: Array = tensor.detach().numpy().astype(float)
        return array

    output = plain(network.output.weight).reshape(-1, network.channels, HIDDEN + 1)
    known, unseen = output[: 1 + network.features], output[1 + network.features :]
    q = plain(network.unseen)[specimens]
    known[0] += np.tensordot(q.mean(axis=0), unseen, axes=1)
    # One specimen says nothing of how others differ.
    variance = np.cov(q.T) if len(q) > UNSEEN else np.zeros((UNSEEN, UNSEEN))
    spread = np.linalg.cholesky(variance + 1e-12 * np.eye(UNSEEN))
    layers = [layer for layer in network.layers if isinstance(layer, nn.Linear)]
    return TouchResponse(
        tuple(plain(layer.weight) for layer in layers),
        tuple(plain(layer.bias) for layer in layers),
        known,
        np.tensordot(spread.T, unseen, axes=1),
        scale,
        ranges,
        mismatch=0.0,
    )
