"""Training of the touch response. Imports torch at its top; import it where it is needed.

`TouchResponse` evaluates the trained network without torch.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import NDArray
from torch import Tensor, nn  # noqa: TID253  see above

from eitskin.training.joint.touch_response import LOG_STRENGTH_STD, InputRanges, TouchResponse
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.network_training import seeded_network, train_network
from eitskin.training.method.settings import NetworkSettings, Progress

Array = NDArray[np.float64]

HIDDEN = 96
LAYERS = 3
LATENT = 8  # most latent variables q of a specimen
SPECIMENS = 3  # to learn each of them from
RELATIVE_ERROR = 0.05  # of the model, which weights frames together with their noise


@dataclass(frozen=True, slots=True, eq=False)
class TouchFrames:
    """Training set of n touched frames.

    Attributes:
        touches: x [m], y [m] and force [N] of up to k touches, NaN where absent (n, k, 3).
        angle_deg: of the bend (n,) [deg].
        features: of the specimens (n, P).
        specimen: number of the specimen, from 0 on (n,); mirror images share it.
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
    """The network of `TouchResponse`, with strength and latent q of every training specimen.

    The strength with which touches act on a specimen does not show in its flat resistances; as free
    parameters, strengths do not blur the shape of the response. Their geometric mean is one.
    """

    def __init__(self, frames: TouchFrames) -> None:
        """Size the network for the touches, channels, features and specimens of `frames`."""
        super().__init__()
        sizes = [4] + [HIDDEN] * LAYERS
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(sizes))
        self.touches, self.channels = frames.touches.shape[1], frames.change.shape[1]
        self.features = frames.features.shape[1]
        specimens = int(frames.specimen.max()) + 1
        latent = min(LATENT, len(np.unique(frames.specimen)) // SPECIMENS)
        terms = 1 + self.features + latent
        self.output = nn.Linear(HIDDEN + 1, self.channels * terms, bias=False)
        with torch.no_grad():  # start near a response that all specimens share
            self.output.weight[self.channels :] *= 0.1
        self.log_strength = nn.Parameter(torch.zeros(specimens))
        # Zeros would stay zeros: the gradient by each factor is the other factor.
        self.latent = nn.Parameter(0.3 * torch.randn(specimens, latent))

    def forward(self, packed: Tensor) -> Tensor:
        """Changes of log V (n, C), in units of `scale`, of frames packed by `packed_inputs`."""
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
        share = torch.cat([torch.ones_like(specimen), features, self.latent[number]], dim=1)
        strength = torch.exp(self.log_strength - self.log_strength.mean())
        change: Tensor = torch.einsum("npc,np->nc", terms, share)
        return change * strength[number][:, None]


def fit_response(
    frames: TouchFrames,
    ranges: InputRanges,
    noise: float,
    settings: NetworkSettings,
    seed: int,
    progress: Progress,
) -> tuple[TouchResponse, LearningCurve]:
    """Learn a response by weighted least squares; its mismatch stays zero.

    Args:
        frames: training set.
        ranges: of the inputs.
        noise: rms noise of the frames' changes.
        settings: of the training.
        seed: of initial weights and order.
        progress: called after every epoch.
    """
    scale = float(np.sqrt(np.mean(frames.change**2)))
    network = seeded_network(lambda: ResponseNetwork(frames), seed)
    inputs, change = packed_inputs(frames, ranges), _tensor(frames.change / scale)
    # Weights: noise dominates the error of weak touches, model error that of strong ones.
    variance = (noise / scale) ** 2 + RELATIVE_ERROR**2 * change.square().mean(dim=1, keepdim=True)
    weighted = torch.cat([change, variance.mean() / variance], dim=1)

    def loss(modelled: Tensor, target: Tensor) -> Tensor:
        error = ((modelled - target[:, :-1]).square() * target[:, -1:]).mean()
        departures = (network.log_strength / LOG_STRENGTH_STD).square().mean()
        return error + 1e-3 * (departures + network.latent.square().mean())

    history = train_network(
        network,
        lambda chosen, _: (inputs[chosen], weighted[chosen]),
        loss,
        len(change),
        settings,
        seed,
        lambda done, total: progress("touch response", done, total),
    )
    return folded_response(network, np.unique(frames.specimen), scale, ranges), history


def packed_inputs(frames: TouchFrames, ranges: InputRanges) -> Tensor:
    """Rows (n, columns): inputs and factors of each touch, features, number of the specimen."""
    inputs = ranges.inputs(frames.touches, frames.angle_deg[:, None])
    columns = [
        np.nan_to_num(inputs).reshape(len(inputs), -1),
        np.nan_to_num(frames.touches[..., 2] / ranges.middle_force),  # zero where absent
        frames.features,
        frames.specimen[:, None],
    ]
    return _tensor(np.concatenate(columns, axis=1))


def _tensor(values: Array) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(values, dtype=np.float32))


def folded_response(
    network: ResponseNetwork, specimens: NDArray[np.int64], scale: float, ranges: InputRanges
) -> TouchResponse:
    """The trained response, with q shifted and scaled to zero mean and unit variance."""

    def plain(tensor: Tensor) -> Array:
        array: Array = tensor.detach().numpy().astype(float)
        return array

    output = plain(network.output.weight).reshape(-1, network.channels, HIDDEN + 1)
    known, latent = output[: 1 + network.features], output[1 + network.features :]
    q = plain(network.latent)[specimens]
    known[0] += np.tensordot(q.mean(axis=0), latent, axes=1)
    variance = np.cov(q.T).reshape(2 * q.shape[1:]) if q.size else np.zeros((0, 0))
    spread = np.linalg.cholesky(variance + 1e-12 * np.eye(len(variance)))
    layers = [layer for layer in network.layers if isinstance(layer, nn.Linear)]
    return TouchResponse(
        tuple(plain(layer.weight) for layer in layers),
        tuple(plain(layer.bias) for layer in layers),
        known,
        np.tensordot(spread.T, latent, axes=1),
        scale,
        ranges,
        mismatch=0.0,
    )
