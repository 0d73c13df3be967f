"""Training of the proposal network on synthetic frames. Imports torch at its top.

The frames are drawn from the learned touch response, bend curves and touch prior.
"""

from dataclasses import dataclass

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import NDArray
from torch import Tensor, nn  # noqa: TID253  see above

from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.combinations import Combinations
from eitskin.training.joint.prior import MOST_TOUCHES, TouchPrior
from eitskin.training.joint.proposal_model import WIDTH, ProposalNetwork, network_inputs
from eitskin.training.joint.touch_response import TouchResponse
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.network_training import dense_layers, seeded_network
from eitskin.training.method.settings import NetworkSettings, Progress

Array = NDArray[np.float64]

PITCH = 0.005  # m, between cells
HIDDEN = (512, 512, 512)
STEPS_PER_EPOCH = 100  # each on new frames
LOG_SENSITIVITY_STD = 0.15  # of the specimens' sensitivity to touches
MOVED_DEG = 4.0  # standard deviation of the bend since the reference, in half of the frames


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticFrames:
    """Generative model of training frames; attributes as in `JointMethod`."""

    response: TouchResponse
    bend_prior: BendCurvePrior
    touch_prior: TouchPrior
    combinations: Combinations

    def frames(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draw network inputs (count, inputs) and touch positions (count, MOST_TOUCHES, 2) [m]."""
        known = len(self.response.output) - 1
        features = rng.standard_normal((count, known + len(self.response.latent_output)))
        low, high = self.bend_prior.angle_deg
        angle = np.where(rng.uniform(size=count) < 0.25, 0.0, rng.uniform(low, high, count))
        touches = self._touches(count, rng)
        change = self.touch_changes(touches, angle, features, rng)
        averaged = 1.0 / 2.0 ** rng.integers(0, 6, count)  # 1 to 32 frames in the reference
        unit = self.combinations.unit
        change += rng.standard_normal(change.shape) * unit * np.sqrt(1 + averaged)[:, None]
        moved = rng.standard_normal(count) * MOVED_DEG * (rng.uniform(size=count) < 0.5)
        curve = self.bend_prior.of(np.zeros(known))
        change += curve.value(angle + moved) - curve.value(angle)
        inputs = network_inputs(change, np.sqrt(2.0) * unit, angle, features[:, :known])
        return inputs, touches[..., :2]

    def _touches(self, count: int, rng: np.random.Generator) -> Array:
        """Draw x [m], y [m] and force [N] of touches (count, MOST_TOUCHES, 3), NaN where absent."""
        low, high = self.touch_prior.low, self.touch_prior.high
        touches = rng.uniform(low, high, (count, MOST_TOUCHES, 3))
        mean, deviation = self.touch_prior.force
        touches[..., 2] = np.clip(
            rng.uniform(-1.73, 1.73, (count, MOST_TOUCHES)) * deviation + mean, low[2], high[2]
        )
        touches[np.arange(MOST_TOUCHES) >= rng.integers(0, MOST_TOUCHES + 1, count)[:, None]] = (
            np.nan
        )
        for i in range(MOST_TOUCHES):
            for j in range(i):
                apart = np.hypot(*(touches[:, i, :2] - touches[:, j, :2]).T)
                touches[apart < self.touch_prior.separation, i] = np.nan
        return touches

    def touch_changes(
        self, touches: Array, angle: Array, features: Array, rng: np.random.Generator
    ) -> Array:
        """Change (count, K) by the touches, on specimens that differ."""
        response = self.response
        hidden = torch.as_tensor(
            np.nan_to_num(response.ranges.inputs(touches, angle[:, None])), dtype=torch.float32
        )
        for weight, bias in zip(response.weights, response.biases, strict=True):
            hidden = nn.functional.silu(
                hidden @ torch.as_tensor(weight.T, dtype=torch.float32)
                + torch.as_tensor(bias, dtype=torch.float32)
            )
        hidden = torch.cat([hidden, torch.ones_like(hidden[..., :1])], dim=-1)
        factors = np.nan_to_num(touches[..., 2]) / response.ranges.middle_force * response.scale
        summed = (hidden * torch.as_tensor(factors[..., None], dtype=torch.float32)).sum(dim=1)
        share = np.concatenate([np.ones((len(touches), 1)), features], axis=1)
        output = np.concatenate([response.output, response.latent_output])
        output_ = torch.as_tensor(output, dtype=torch.float32)
        terms = torch.einsum("nh,pch->npc", summed, output_)
        share_ = torch.as_tensor(share, dtype=torch.float32)
        change: Array = torch.einsum("npc,np->nc", terms, share_).numpy().astype(float)
        each = self.combinations.changes(change)  # the measurements err independently
        errors = self.combinations.of(each * rng.standard_normal(each.shape))
        strength = np.exp(LOG_SENSITIVITY_STD * rng.standard_normal((len(touches), 1)))
        return (change + response.mismatch * errors) * strength


def fit_proposals(
    model: SyntheticFrames, settings: NetworkSettings, seed: int, progress: Progress
) -> tuple[ProposalNetwork, LearningCurve]:
    """Train with binary cross-entropy per cell and Adam, on new frames in every step."""
    low, high = model.touch_prior.low, model.touch_prior.high
    columns, rows = (
        np.linspace(low[i], high[i], round((high[i] - low[i]) / PITCH) + 1) for i in (0, 1)
    )
    rng = np.random.default_rng(seed)
    inputs, _ = model.frames(2, rng)
    sizes = [inputs.shape[1], *HIDDEN, len(columns) * len(rows)]
    network = seeded_network(lambda: dense_layers(sizes), seed)
    steps = settings.epochs * STEPS_PER_EPOCH
    optimiser = torch.optim.Adam(network.parameters(), settings.learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, settings.learning_rate, steps)
    cells = [torch.as_tensor(axis, dtype=torch.float32) for axis in np.meshgrid(columns, rows)]
    losses = []
    for epoch in range(settings.epochs):
        total = 0.0
        for _ in range(STEPS_PER_EPOCH):
            inputs, places = model.frames(settings.batch, rng)
            logits = network(torch.as_tensor(inputs, dtype=torch.float32))
            target = _bumps(torch.as_tensor(places, dtype=torch.float32), cells)
            optimiser.zero_grad(set_to_none=True)
            loss = nn.functional.binary_cross_entropy_with_logits(logits, target)
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
            total += loss.item() / STEPS_PER_EPOCH
        losses.append(total)
        progress("proposals", epoch + 1, settings.epochs)
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    proposals = ProposalNetwork(
        tuple(layer.weight.detach().numpy().astype(float) for layer in layers),
        tuple(layer.bias.detach().numpy().astype(float) for layer in layers),
        columns,
        rows,
    )
    return proposals, LearningCurve(tuple(losses))


def _bumps(places: Tensor, cells: list[Tensor]) -> Tensor:
    """Target map (n, cells): the highest of the touches' bumps; none where a place is NaN."""
    x, y = (axis.reshape(1, 1, -1) for axis in cells)
    square = (x - places[..., 0:1]) ** 2 + (y - places[..., 1:2]) ** 2
    return torch.nan_to_num(torch.exp(-0.5 * square / WIDTH**2)).amax(dim=1)
