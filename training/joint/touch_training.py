"""Training of the touch response, and of the proposals. Imports torch at its top.

`TouchResponse` and `ProposalNetwork` evaluate the trained networks without torch. Proposals are
learned from synthetic frames, drawn from the learned response, bend curves and touch prior.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import NDArray
from torch import Tensor, nn  # noqa: TID253  see above

from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.combinations import Combinations
from eitskin.training.joint.mirrored_frames import MirroredFrames
from eitskin.training.joint.networks import WIDTH, ProposalNetwork, network_inputs
from eitskin.training.joint.touch_response import (
    LOG_STRENGTH_STD,
    MAX_TOUCHES,
    InputRanges,
    TouchPrior,
    TouchResponse,
)
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.network_training import (
    as_array,
    as_tensor,
    dense_layers,
    linear_layers,
    seeded_network,
    train_network,
)
from eitskin.training.method.settings import NetworkSettings, Progress

Array = NDArray[np.float64]

HIDDEN_SIZE = 96
LAYERS = 3
LATENT = 12  # most latent variables q of a specimen
SPECIMENS = 3  # to learn each of them from
RELATIVE_ERROR = 0.05  # of the model, which weights frames together with their noise
# Standard deviations of the first weights, of x, y, force and angle in units of the inputs. Changes
# near the rim turn within millimetres; from layers that begin smooth they are learned some four
# times more slowly (Rahaman et al. 2019).
FIRST_WEIGHTS = (4.0, 3.0, 0.5, 0.5)
CELL = 0.005  # m, between cells
PROPOSAL_HIDDEN = (512, 512, 512)
STEPS_PER_EPOCH = 100  # each on new frames
LOG_SENSITIVITY_STD = 0.15  # of the specimens' sensitivity to touches
MOVED_DEG = 4.0  # standard deviation of the bend since the reference, in half of the frames


class ResponseNetwork(nn.Module):
    """The network of `TouchResponse`, with strength and latent q of every training specimen.

    The strength with which touches act on a specimen does not show in its flat resistances; as free
    parameters, strengths do not blur the shape of the response. Their geometric mean is one. Mirror
    images share the strength of a specimen, while each has q of its own.
    """

    def __init__(self, frames: MirroredFrames, ranges: InputRanges) -> None:
        """Size the network for the touches, channels, features and specimens of `frames`.

        Units of the first layer turn where touches are, within `ranges`.
        """
        super().__init__()
        sizes = [4] + [HIDDEN_SIZE] * LAYERS
        layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
        low, high = (as_tensor(corner) for corner in ranges.corners())
        with torch.no_grad():
            weight = torch.randn(HIDDEN_SIZE, 4) * torch.tensor(FIRST_WEIGHTS)
            turn = low + (high - low) * torch.rand(HIDDEN_SIZE, 4)
            layers[0].weight.copy_(weight)
            layers[0].bias.copy_(-(weight * turn).sum(dim=1))
        self.layers = nn.ModuleList(layers)
        self.touches, self.channels = frames.touches.shape[1], frames.change.shape[1]
        self.features = frames.features.shape[1]
        self.specimens, curves = frames.specimens, int(frames.curve.max()) + 1
        latent = min(LATENT, len(np.unique(frames.specimen)) // SPECIMENS)
        terms = 1 + self.features + latent
        self.output = nn.Linear(HIDDEN_SIZE + 1, self.channels * terms, bias=False)
        with torch.no_grad():  # start near a response that all specimens share
            self.output.weight[self.channels :] *= 0.1
        self.log_strength = nn.Parameter(torch.zeros(self.specimens))
        # Zeros would stay zeros: the gradient by each factor is the other factor.
        self.latent = nn.Parameter(0.3 * torch.randn(curves, latent))

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
        return change * strength[number % self.specimens][:, None]


def fit_response(
    frames: MirroredFrames,
    ranges: InputRanges,
    settings: NetworkSettings,
    seed: int,
    progress: Progress,
) -> tuple[TouchResponse, LearningCurve]:
    """Learn a response by weighted least squares; its mismatch stays zero."""
    scale = float(np.sqrt(np.mean(frames.change**2)))
    network = seeded_network(lambda: ResponseNetwork(frames, ranges), seed)
    inputs, change = packed_inputs(frames, ranges), as_tensor(frames.change / scale)
    # Weights: noise dominates the error of weak touches, model error that of strong ones.
    noise = float(np.sqrt(np.mean(np.diagonal(frames.noise))))
    variance = (noise / scale) ** 2 + RELATIVE_ERROR**2 * change.square().mean(dim=1, keepdim=True)
    weighted = torch.cat([change, variance.mean() / variance], dim=1)

    def loss(modelled: Tensor, target: Tensor) -> Tensor:
        error = ((modelled - target[:, :-1]).square() * target[:, -1:]).mean()
        departures = (network.log_strength / LOG_STRENGTH_STD).square().mean()
        if network.latent.numel():  # few specimens have none, and a mean of nothing is NaN
            departures = departures + network.latent.square().mean()
        return error + 1e-3 * departures

    history = train_network(
        network,
        lambda chosen, _: (inputs[chosen], weighted[chosen]),
        loss,
        len(change),
        settings,
        seed,
        lambda done, total: progress("touch response", done, total),
    )
    return folded_response(network, np.unique(frames.curve), scale, ranges), history


def packed_inputs(frames: MirroredFrames, ranges: InputRanges) -> Tensor:
    """Rows (n, columns): inputs and factors of each touch, features, number of the curve."""
    angles = np.broadcast_to(frames.angle_deg[:, None], frames.touches.shape[:2])
    inputs = ranges.inputs(frames.touches, angles)
    columns = [
        np.nan_to_num(inputs).reshape(len(inputs), -1),
        np.nan_to_num(frames.touches[..., 2] / ranges.middle_force),  # zero where absent
        frames.features,
        frames.curve[:, None],
    ]
    return as_tensor(np.concatenate(columns, axis=1))


def folded_response(
    network: ResponseNetwork, curves: NDArray[np.int64], scale: float, ranges: InputRanges
) -> TouchResponse:
    """The trained response, with q shifted and scaled to zero mean and unit variance."""
    output = as_array(network.output.weight).reshape(-1, network.channels, HIDDEN_SIZE + 1)
    feature_output, latent = output[: 1 + network.features], output[1 + network.features :]
    q = as_array(network.latent)[curves]
    feature_output[0] += np.tensordot(q.mean(axis=0), latent, axes=1)
    variance = np.cov(q.T).reshape(2 * q.shape[1:]) if q.size else np.zeros((0, 0))
    spread = np.linalg.cholesky(variance + 1e-12 * np.eye(len(variance)))
    return TouchResponse(
        *linear_layers(network.layers),
        feature_output,
        np.tensordot(spread.T, latent, axes=1),
        scale,
        ranges,
        mismatch=0.0,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticFrames:
    """Generative model of training frames; attributes as in `JointMethod`."""

    response: TouchResponse
    bend_prior: BendCurvePrior
    touch_prior: TouchPrior
    combinations: Combinations

    def frames(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw network inputs (count, inputs) and touch positions (count, MOST_TOUCHES, 2) [m]."""
        feature_count = len(self.response.output) - 1
        features = rng.standard_normal((count, feature_count + len(self.response.latent_output)))
        low, high = self.bend_prior.angle_deg
        angle = np.where(rng.uniform(size=count) < 0.25, 0.0, rng.uniform(low, high, count))
        touches = self._touches(count, rng)
        change = self.touch_changes(touches, angle, features, rng)
        averaged = 1.0 / 2.0 ** rng.integers(0, 6, count)  # 1 to 32 frames in the reference
        unit = self.combinations.unit
        change += rng.standard_normal(change.shape) * unit * np.sqrt(1 + averaged)[:, None]
        moved = rng.standard_normal(count) * MOVED_DEG * (rng.uniform(size=count) < 0.5)
        curve = self.bend_prior.predict(np.zeros(feature_count))
        change += curve.value(angle + moved) - curve.value(angle)
        inputs = network_inputs(change, np.sqrt(2.0) * unit, angle, features[:, :feature_count])
        return inputs, touches[..., :2]

    def _touches(self, count: int, rng: np.random.Generator) -> Array:
        """Draw x [m], y [m] and force [N] of touches (count, MOST_TOUCHES, 3), NaN where absent."""
        low, high = self.touch_prior.low, self.touch_prior.high
        touches = rng.uniform(low, high, (count, MAX_TOUCHES, 3))
        mean, deviation = self.touch_prior.force
        force = rng.uniform(-1.73, 1.73, (count, MAX_TOUCHES)) * deviation + mean
        touches[..., 2] = np.clip(force, low[2], high[2])
        absent = np.arange(MAX_TOUCHES) >= rng.integers(0, MAX_TOUCHES + 1, count)[:, None]
        touches[absent] = np.nan
        for i in range(MAX_TOUCHES):
            for j in range(i):
                apart = np.hypot(*(touches[:, i, :2] - touches[:, j, :2]).T)
                touches[apart < self.touch_prior.separation, i] = np.nan
        return touches

    def touch_changes(
        self, touches: Array, angle: Array, features: Array, rng: np.random.Generator
    ) -> Array:
        """Change (count, K) by the touches, on specimens that differ."""
        response = self.response
        summed = response.hidden_output(np.nan_to_num(touches), angle[:, None]).sum(axis=1)
        share = np.concatenate([np.ones((len(touches), 1)), features], axis=1)
        output = np.concatenate([response.output, response.latent_output])
        change: Array = np.einsum("npc,np->nc", np.tensordot(summed, output, axes=(1, 2)), share)
        each = change @ self.combinations.back  # the measurements have an error independently
        errors = each * rng.standard_normal(each.shape) @ self.combinations.forward
        strength = np.exp(LOG_SENSITIVITY_STD * rng.standard_normal((len(touches), 1)))
        return (change + response.mismatch * errors) * strength


def fit_proposals(
    model: SyntheticFrames, settings: NetworkSettings, seed: int, progress: Progress
) -> tuple[ProposalNetwork, LearningCurve]:
    """Train with binary cross-entropy per cell and Adam, on new frames in every step."""
    low, high = model.touch_prior.low, model.touch_prior.high
    columns, rows = (
        np.linspace(low[i], high[i], round((high[i] - low[i]) / CELL) + 1) for i in (0, 1)
    )
    rng = np.random.default_rng(seed)
    inputs, _ = model.frames(2, rng)
    sizes = [inputs.shape[1], *PROPOSAL_HIDDEN, len(columns) * len(rows)]
    network = seeded_network(lambda: dense_layers(sizes), seed)
    cells = [as_tensor(axis) for axis in np.meshgrid(columns, rows)]

    def batch(chosen: Tensor, _: torch.Generator) -> tuple[Tensor, Tensor]:
        inputs, places = model.frames(len(chosen), rng)
        return as_tensor(inputs), _bumps(as_tensor(places), cells)

    history = train_network(
        network,
        batch,
        nn.functional.binary_cross_entropy_with_logits,
        settings.batch * STEPS_PER_EPOCH,
        settings,
        seed,
        lambda done, total: progress("proposals", done, total),
    )
    return ProposalNetwork(*linear_layers(network), columns, rows), history


def _bumps(places: Tensor, cells: list[Tensor]) -> Tensor:
    """Target map (n, cells): the highest of the touches' bumps; none where a place is NaN."""
    x, y = (axis.reshape(1, 1, -1) for axis in cells)
    square = (x - places[..., 0:1]) ** 2 + (y - places[..., 1:2]) ** 2
    return torch.nan_to_num(torch.exp(-0.5 * square / WIDTH**2)).amax(dim=1)
