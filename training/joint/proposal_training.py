"""How proposals are trained: on frames made up from the learned model. Imports torch at its top."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import NDArray
from torch import Tensor, nn  # noqa: TID253  see above

from eitskin.training.joint.bend_curve import BendCurves
from eitskin.training.joint.objective import Habits
from eitskin.training.joint.proposal_model import MOST, WIDTH, Proposals, network_inputs
from eitskin.training.joint.touch_response import TouchResponse
from eitskin.training.method.learning_curve import History
from eitskin.training.method.networks import seeded
from eitskin.training.method.settings import NetworkSettings, Progress

Array = NDArray[np.float64]

PITCH = 0.005  # m, between cells
HIDDEN = (512, 512, 512)
PER_EPOCH = 100  # steps, each on frames that were never seen before
STRENGTHS = 0.15  # standard deviation of the logarithm of how strongly specimens feel
MOVED_DEG = 4.0  # standard deviation of the bend since the reference, in half of the frames


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """What frames are made up from; see `JointMethod`."""

    response: TouchResponse
    curves: BendCurves
    habits: Habits
    noise: Array

    def frames(self, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Inputs of the network (count, inputs), and the places of touches (count, MOST, 2)."""
        known = len(self.response.output) - 1
        features = rng.standard_normal((count, known + len(self.response.hidden_output)))
        low, high = self.curves.angle_deg
        angle = np.where(rng.uniform(size=count) < 0.25, 0.0, rng.uniform(low, high, count))
        touches = self._touches(count, rng)
        change = self._touched(touches, angle, features, rng)
        averaged = 1.0 / 2.0 ** rng.integers(0, 6, count)  # 1 to 32 frames in the reference
        change += rng.standard_normal(change.shape) * self.noise * np.sqrt(1 + averaged)[:, None]
        moved = rng.standard_normal(count) * MOVED_DEG * (rng.uniform(size=count) < 0.5)
        curve = self.curves.of(np.zeros(known))
        change += curve.value(angle + moved) - curve.value(angle)
        inputs = network_inputs(change, np.sqrt(2.0) * self.noise, angle, features[:, :known])
        return inputs, touches[..., :2]

    def _touches(self, count: int, rng: np.random.Generator) -> Array:
        """Up to MOST touches a frame that keep their distance, NaN where absent."""
        low, high = self.habits.low, self.habits.high
        touches = rng.uniform(low, high, (count, MOST, 3))
        mean, deviation = self.habits.force
        touches[..., 2] = np.clip(
            rng.uniform(-1.73, 1.73, (count, MOST)) * deviation + mean, low[2], high[2]
        )
        touches[np.arange(MOST) >= rng.integers(0, MOST + 1, count)[:, None]] = np.nan
        for i in range(MOST):
            for j in range(i):
                apart = np.hypot(*(touches[:, i, :2] - touches[:, j, :2]).T)
                touches[apart < self.habits.separation, i] = np.nan
        return touches

    def _touched(
        self, touches: Array, angle: Array, features: Array, rng: np.random.Generator
    ) -> Array:
        """Changes (count, C) by the touches, on specimens that each feel in their own way."""
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
        output = np.concatenate([response.output, response.hidden_output])
        output_ = torch.as_tensor(output, dtype=torch.float32)
        terms = torch.einsum("nh,pch->npc", summed, output_)
        share_ = torch.as_tensor(share, dtype=torch.float32)
        change: Array = torch.einsum("npc,np->nc", terms, share_).numpy().astype(float)
        own = 1.0 + response.mismatch * rng.standard_normal(change.shape)
        return change * own * np.exp(STRENGTHS * rng.standard_normal((len(touches), 1)))


def fit_proposals(
    model: Model, settings: NetworkSettings, seed: int, progress: Progress
) -> tuple[Proposals, History]:
    """Train with binary cross-entropy per cell and Adam, on frames made up anew in every step."""
    low, high = model.habits.low, model.habits.high
    columns, rows = (
        np.linspace(low[i], high[i], round((high[i] - low[i]) / PITCH) + 1) for i in (0, 1)
    )
    rng = np.random.default_rng(seed)
    inputs, _ = model.frames(2, rng)
    sizes = [inputs.shape[1], *HIDDEN, len(columns) * len(rows)]
    network = seeded(lambda: _layers(sizes), seed)
    steps = settings.epochs * PER_EPOCH
    optimiser = torch.optim.Adam(network.parameters(), settings.learning_rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, settings.learning_rate, steps)
    cells = [torch.as_tensor(axis, dtype=torch.float32) for axis in np.meshgrid(columns, rows)]
    losses = []
    for epoch in range(settings.epochs):
        total = 0.0
        for _ in range(PER_EPOCH):
            inputs, places = model.frames(settings.batch, rng)
            logits = network(torch.as_tensor(inputs, dtype=torch.float32))
            target = _bumps(torch.as_tensor(places, dtype=torch.float32), cells)
            optimiser.zero_grad(set_to_none=True)
            loss = nn.functional.binary_cross_entropy_with_logits(logits, target)
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
            total += loss.item() / PER_EPOCH
        losses.append(total)
        progress("proposals", epoch + 1, settings.epochs)
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    proposals = Proposals(
        tuple(layer.weight.detach().numpy().astype(float) for layer in layers),
        tuple(layer.bias.detach().numpy().astype(float) for layer in layers),
        columns,
        rows,
    )
    return proposals, History(tuple(losses))


def _layers(sizes: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.SiLU()]
    return nn.Sequential(*layers[:-1])


def _bumps(places: Tensor, cells: list[Tensor]) -> Tensor:
    """The largest bump over each cell (n, cells); none for places that are NaN."""
    x, y = (axis.reshape(1, 1, -1) for axis in cells)
    square = (x - places[..., 0:1]) ** 2 + (y - places[..., 1:2]) ** 2
    return torch.nan_to_num(torch.exp(-0.5 * square / WIDTH**2)).amax(dim=1)
