"""Training of the angle networks on bent frames. Imports torch at its top."""

from dataclasses import replace
from functools import partial

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from torch import Tensor, nn  # noqa: TID253  see above

from eitskin.training.joint.angles.bent_frames import BentFrames
from eitskin.training.joint.angles.networks import DRIFT, LOG_DEVIATION, UNIT_DEG, AngleNetworks
from eitskin.training.method.learning_curve import LearningCurve
from eitskin.training.method.network_training import (
    Samples,
    dense_layers,
    seeded_network,
    train_network,
)
from eitskin.training.method.settings import NetworkSettings, Progress

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

MEMBERS = 5
HIDDEN = (128, 128, 128)
GROUPS = 25
"""Groups of similar specimens, of which each network goes without a `MEMBERS`-th."""
RELATIVE_NOISE = 0.05  # of the change
FEATURE_NOISE = 0.3  # standard deviations


def fit_angles(
    frames: BentFrames, settings: NetworkSettings, seed: int, progress: Progress
) -> tuple[AngleNetworks, LearningCurve]:
    """Networks trained by maximum likelihood of the angle, each without a share of the specimens.

    Every step adds the noise of a frame and of its reference, a common drift of any size, which the
    networks are told, and further noise, with which they overfit less.

    Returns:
        the networks.
        means of their losses; validation is on the specimens that each goes without.
    """
    part = groups_of_specimens(frames, seed)[frames.specimen] % MEMBERS
    empty = _without_layers(frames)
    plainly = (frames.change, frames.features, np.full(len(frames.change), DRIFT[0]))
    raw = _tensor(empty.inputs(*plainly))
    target = _tensor(frames.angle_deg[:, None] / UNIT_DEG)
    noise = _tensor(np.sqrt(2.0) * frames.combinations.unit / empty.unit)
    drift, weights = _tensor(empty.drift), _tensor(empty.filter)
    largest = float(np.log(DRIFT[1] / DRIFT[0]))
    sizes = [raw.shape[1], *HIDDEN, 2]
    trained, curves = [], []
    for member in range(MEMBERS):
        seen, left = (
            torch.as_tensor(np.flatnonzero(rows)) for rows in (part != member, part == member)
        )

        def noisy(
            chosen: Tensor, generator: torch.Generator, rows: Tensor = seen
        ) -> tuple[Tensor, Tensor]:
            values, combinations = raw[rows[chosen]], len(noise)

            def normal(columns: int) -> Tensor:
                return torch.randn(len(chosen), columns, generator=generator)

            size = largest * torch.rand(len(chosen), 1, generator=generator).square()
            values[:, :combinations] *= 1.0 + RELATIVE_NOISE * normal(combinations)
            values[:, :combinations] += normal(combinations) * noise
            common = DRIFT[0] * size.exp()
            change = values[:, :combinations] + common * normal(1) * drift
            variance = common.square()
            told = variance * (change @ weights)[:, None] / (1.0 + variance * (drift @ weights))
            values[:, :combinations] = change - told * drift
            values[:, combinations:-1] += FEATURE_NOISE * normal(raw.shape[1] - combinations - 1)
            values[:, -1:] = size
            return values, target[rows[chosen]]

        def plain(chosen: Tensor, _: torch.Generator, rows: Tensor = left) -> tuple[Tensor, Tensor]:
            return raw[rows[chosen]], target[rows[chosen]]

        network = seeded_network(lambda: dense_layers(sizes), seed + member)
        curves.append(
            train_network(
                network,
                noisy,
                _loss,
                len(seen),
                settings,
                seed + member,
                partial(_tell, progress, member),
                Samples(plain, len(left)) if len(left) else None,
            )
        )
        trained.append(network)
    layers = [[x for x in network if isinstance(x, nn.Linear)] for network in trained]
    networks = replace(
        empty,
        weights=tuple(
            np.stack([_plain(x.weight) for x in each]) for each in zip(*layers, strict=True)
        ),
        biases=tuple(
            np.stack([_plain(x.bias) for x in each]) for each in zip(*layers, strict=True)
        ),
    )
    losses = (
        np.mean([each for each in one if each], axis=0).tolist()
        for one in ([x.training for x in curves], [x.validation for x in curves])
    )
    return networks, LearningCurve(*map(tuple, losses))


def _without_layers(frames: BentFrames) -> AngleNetworks:
    """Networks without layers: the scales of their inputs, and the filter of the drift."""
    unit = np.sqrt(np.mean(frames.change**2, axis=0))
    change, drift = frames.change / unit, frames.combinations.drift / unit
    noise = (frames.combinations.unit / unit) ** 2 + RELATIVE_NOISE**2
    moments = change.T @ change / len(change) + np.diag(noise)
    ends = (float(frames.angle_deg.min()), float(frames.angle_deg.max()))
    return AngleNetworks((), (), unit, drift, np.linalg.solve(moments, drift), ends)


def _tell(progress: Progress, member: int, done: int, total: int) -> None:
    """Report the epochs of all networks together."""
    progress("angles", member * total + done, MEMBERS * total)


def groups_of_specimens(frames: BentFrames, seed: int) -> Integers:
    """Number of the group of each specimen (S,), by the likeness of their bend curves.

    Specimens of one clamp bend alike. A network that goes without a group has not seen its clamp,
    as it will not have seen that of the next sensor. Groups are those of k-means.
    """
    coordinates = frames.coordinates()
    groups = min(GROUPS, frames.specimens)
    _, group = kmeans2(coordinates, groups, minit="++", seed=seed)
    return np.asarray(group, dtype=np.int64)


def loss_of_estimates(frames: BentFrames, estimates: Array) -> float:
    """Loss of the networks for estimates of other origin.

    Args:
        frames: n frames.
        estimates: angle and its standard error (n, 2) [deg].
    """
    output = np.column_stack([estimates[:, 0], UNIT_DEG * np.log(estimates[:, 1] / UNIT_DEG)])
    return _loss(_tensor(output / UNIT_DEG), _tensor(frames.angle_deg[:, None] / UNIT_DEG)).item()


def _loss(output: Tensor, angle: Tensor) -> Tensor:
    """Mean negative log-likelihood of angles (n, 1) under normal distributions (n, 2)."""
    logs = output[:, 1].clamp(*LOG_DEVIATION)
    return (0.5 * ((output[:, 0] - angle[:, 0]) / logs.exp()).square() + logs).mean()


def _tensor(values: Array) -> Tensor:
    return torch.as_tensor(np.ascontiguousarray(values, dtype=np.float32))


def _plain(tensor: Tensor) -> Array:
    array: Array = tensor.detach().numpy().astype(float)
    return array
