"""Training of the angle networks on bent frames. Imports torch at its top."""

from dataclasses import replace
from functools import partial

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from torch import Tensor  # noqa: TID253  see above

from eitskin.training.joint.bend_curve import BendCurvePrior
from eitskin.training.joint.clamp_curves import ClampCurves
from eitskin.training.joint.mirrored_frames import SCALE, MirroredFrames
from eitskin.training.joint.networks import (
    DRIFT,
    LOG_DEVIATION,
    UNIT_DEG,
    AngleNetworks,
    without_drift,
)
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.network_training import (
    Samples,
    as_tensor,
    dense_layers,
    linear_layers,
    seeded_network,
    train_network,
)
from eitskin.training.method.settings import NetworkSettings, Progress

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

MEMBERS = 5
HIDDEN_SIZES = (128, 128, 128)
GROUPS = 25
"""Groups of similar specimens, of which each network goes without a `MEMBERS`-th."""
MIX_RANGE = (-0.25, 0.25)
"""Range of the share of another specimen's bend curve in that of a frame's."""
MOVED_SHARE = 0.9  # share of the frames of known clamps that move to another clamp in each step
RELATIVE_NOISE = 0.05  # of the change, of frames that do not move
FEATURE_NOISE = 0.3  # standard deviations, of frames that do not move


def fit_angles(
    frames: MirroredFrames,
    features: Array,
    curves: BendCurvePrior,
    settings: NetworkSettings,
    seed: int,
    progress: Progress,
) -> tuple[AngleNetworks, LearningCurve]:
    """Networks trained by maximum likelihood of the angle, each without a share of the specimens.

    Every step bends the sensors as in clamps that the training set does not have. Where clamps are
    known, most frames move to another one drawn again: they change by the difference of both mean
    curves (`ClampCurves`). Otherwise the curve of a frame's specimen gets a share of that of
    another one (mixup of Zhang et al. 2018, at equal angles), and further noise, with which
    networks overfit less. Every step adds the noise of a frame and of its reference, and a common
    drift of any size, which the networks are given next to features (n, Q) of the specimens.

    Losses are the means of all networks; validation is on the specimens that each goes without.
    """
    part = groups_of_specimens(frames, seed)[frames.specimen] % MEMBERS
    empty = _without_layers(frames)
    bends = curves.expected_coefficients(frames)
    clamps = ClampCurves.fit(frames, curves, bends, seed)
    inputs = _Inputs(frames, features, bends, empty, clamps)
    sizes = [inputs.raw.shape[1], *HIDDEN_SIZES, 2]
    trained, learned = [], []

    def tell(member: int, done: int, total: int) -> None:
        progress("angles", member * total + done, MEMBERS * total)

    for member in range(MEMBERS):
        training_rows, rows = (
            torch.as_tensor(np.flatnonzero(rows)) for rows in (part != member, part == member)
        )
        network = seeded_network(lambda: dense_layers(sizes), seed + member)
        learned.append(
            train_network(
                network,
                partial(inputs.noisy, training_rows),
                _loss,
                len(training_rows),
                settings,
                seed + member,
                partial(tell, member),
                Samples(partial(inputs.plain, rows), len(rows)) if len(rows) else None,
            )
        )
        trained.append(network)
    weights, biases = (
        tuple(map(np.stack, zip(*each, strict=True)))
        for each in zip(*map(linear_layers, trained), strict=True)
    )
    networks = replace(empty, weights=weights, biases=biases)
    losses = (
        np.mean([each for each in inputs if each], axis=0).tolist()
        for inputs in ([x.training for x in learned], [x.validation for x in learned])
    )
    return networks, LearningCurve(*map(tuple, losses))


def _without_layers(frames: MirroredFrames) -> AngleNetworks:
    """Networks without layers: the scales of their inputs, and the filter of the drift."""
    unit = np.sqrt(np.mean(frames.change**2, axis=0))
    change, drift = frames.change / unit, frames.combinations.drift / unit
    noise = (frames.combinations.unit / unit) ** 2 + RELATIVE_NOISE**2
    moments = change.T @ change / len(change) + np.diag(noise)
    ends = (float(frames.angle_deg.min()), float(frames.angle_deg.max()))
    return AngleNetworks((), (), unit, drift, np.linalg.solve(moments, drift), ends)


class _Inputs:
    """Inputs of the networks, K combinations and Q features of n frames, and their targets.

    Attributes:
        raw: inputs without added noise (n, K + Q + 1).
        target: angles, in units (n, 1).
        noise: noise of a frame and of its reference (K,).
        drift, filter: drift and filter of the networks (K,).
        bends: coefficients of the expected curve of each frame (curves, M, K), and their `curve`.
        powers: powers of each frame's angle (n, M).
        moved: share of the steps in which each frame moves to another clamp (n, 1).
        left: coefficients (S, M, K) of the mean curve of the clamp of each `specimen`.
        drawn: coefficients (D, M, K) of those of clamps to which frames move.
    """

    def __init__(
        self,
        frames: MirroredFrames,
        features: Array,
        bends: Array,
        empty: AngleNetworks,
        clamps: ClampCurves,
    ) -> None:
        """Inputs from bent frames and their curves, for networks without layers."""
        still = np.full(len(frames.change), DRIFT[0])
        powers = (frames.angle_deg[:, None] / SCALE) ** np.arange(1, bends.shape[1] + 1)
        self.raw = as_tensor(empty.inputs(frames.change, features, still))
        self.target = as_tensor(frames.angle_deg[:, None] / UNIT_DEG)
        self.noise = as_tensor(np.sqrt(2.0) * frames.combinations.unit / empty.unit)
        self.drift, self.filter = as_tensor(empty.drift), as_tensor(empty.filter)
        self.bends, self.curve = as_tensor(bends / empty.unit), torch.as_tensor(frames.curve)
        self.powers = as_tensor(powers)
        self.moved = as_tensor(np.where(clamps.known, MOVED_SHARE, 0.0)[frames.specimen, None])
        self.specimen = torch.as_tensor(frames.specimen)
        self.left, self.drawn = (as_tensor(x / empty.unit) for x in (clamps.own, clamps.drawn))

    def plain(self, rows: Tensor, chosen: Tensor, _: torch.Generator) -> tuple[Tensor, Tensor]:
        """Inputs and targets of some of the frames `rows`."""
        return self.raw[rows[chosen]], self.target[rows[chosen]]

    def noisy(
        self, rows: Tensor, chosen: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """The same, in other clamps and with noise; see `fit_angles`."""
        count, combinations = len(chosen), len(self.noise)

        def normal(columns: int) -> Tensor:
            return torch.randn(count, columns, generator=generator)

        def uniform() -> Tensor:
            return torch.rand(count, 1, generator=generator)

        own = rows[chosen]
        other = rows[torch.randint(len(rows), (count,), generator=generator)]
        values = self.raw[own]
        stays = (uniform() >= self.moved[own]).float()
        share = stays * (MIX_RANGE[0] + (MIX_RANGE[1] - MIX_RANGE[0]) * uniform())
        apart = share[:, :, None] * (self.bends[self.curve[other]] - self.bends[self.curve[own]])
        clamp = torch.randint(len(self.drawn), (count,), generator=generator)
        moved = self.drawn[clamp] - self.left[self.specimen[own]]
        apart += (1.0 - stays)[:, :, None] * moved
        change = values[:, :combinations]
        change += torch.einsum("np,npk->nk", self.powers[own], apart)
        change *= 1.0 + stays * RELATIVE_NOISE * normal(combinations)
        change += normal(combinations) * self.noise
        size = float(np.log(DRIFT[1] / DRIFT[0])) * uniform().square()
        common = DRIFT[0] * size.exp()
        change += common * normal(1) * self.drift
        variance = common[:, 0].square()
        values[:, :combinations] = without_drift(change, variance, self.drift, self.filter)
        features = values.shape[1] - combinations - 1
        values[:, combinations:-1] += stays * FEATURE_NOISE * normal(features)
        values[:, -1:] = size
        return values, self.target[own]


def groups_of_specimens(frames: MirroredFrames, seed: int) -> Integers:
    """Number of the group of each specimen (S,), by the likeness of their bend curves.

    Specimens of one clamp bend alike. A network that goes without a group has not seen its clamp,
    as it will not have seen that of the next sensor. Groups are those of k-means.
    """
    coordinates = frames.coordinates()
    groups = min(GROUPS, frames.specimens)
    _, group = kmeans2(coordinates, groups, minit="++", seed=seed)
    return np.asarray(group, dtype=np.int64)


def loss_of_estimates(frames: MirroredFrames, estimates: Array) -> float:
    """Loss of the networks for estimates of other origin.

    Args:
        frames: n frames.
        estimates: angle and its standard error (n, 2) [deg].
    """
    output = np.column_stack([estimates[:, 0], UNIT_DEG * np.log(estimates[:, 1] / UNIT_DEG)])
    return _loss(
        as_tensor(output / UNIT_DEG), as_tensor(frames.angle_deg[:, None] / UNIT_DEG)
    ).item()


def _loss(output: Tensor, angle: Tensor) -> Tensor:
    """Mean negative log-likelihood of angles (n, 1) under normal distributions (n, 2)."""
    logs = output[:, 1].clamp(*LOG_DEVIATION)
    return (0.5 * ((output[:, 0] - angle[:, 0]) / logs.exp()).square() + logs).mean()
