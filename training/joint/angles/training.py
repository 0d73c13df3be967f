"""Training of the angle networks on bent frames. Imports torch at its top."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch  # noqa: TID253  see above
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from torch import Tensor, nn  # noqa: TID253  see above

from eitskin.training.joint.angles.networks import DRIFT, LOG_DEVIATION, UNIT_DEG, AngleNetworks
from eitskin.training.joint.bend_curve import SCALE
from eitskin.training.joint.combinations import Combinations
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
POWERS = 3  # of the angle, by which the curves of specimens are compared
RIDGE = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class BentFrames:
    """n bent frames, mirror images included.

    Attributes:
        change: combinations of the change from the flat sensor (n, K).
        angle_deg: of the bend (n,) [deg].
        features: of the specimens (n, P).
        specimen: number of the specimen (n,); mirror images share it.
        combinations: of the measurements.
    """

    change: Array
    angle_deg: Array
    features: Array
    specimen: Integers
    combinations: Combinations

    def __getitem__(self, rows: slice) -> "BentFrames":
        """Some of the frames."""
        return replace(
            self,
            change=self.change[rows],
            angle_deg=self.angle_deg[rows],
            features=self.features[rows],
            specimen=self.specimen[rows],
        )


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
    count, unit = len(frames.change), np.sqrt(np.mean(frames.change**2, axis=0))
    ends = (float(frames.angle_deg.min()), float(frames.angle_deg.max()))
    part = groups_of_specimens(frames, seed)[frames.specimen] % MEMBERS
    empty = AngleNetworks((), (), unit, ends)
    inputs = _tensor(empty.inputs(frames.change, frames.features, np.full(count, DRIFT[0])))
    target = _tensor(frames.angle_deg[:, None] / UNIT_DEG)
    noise = _tensor(np.sqrt(2.0) * frames.combinations.unit / unit)
    drift = _tensor(DRIFT[0] * frames.combinations.drift / unit)
    largest = float(np.log(DRIFT[1] / DRIFT[0]))
    sizes = [inputs.shape[1], *HIDDEN, 2]
    trained, curves = [], []
    for member in range(MEMBERS):
        seen, left = (
            torch.as_tensor(np.flatnonzero(rows)) for rows in (part != member, part == member)
        )

        def noisy(
            chosen: Tensor, generator: torch.Generator, rows: Tensor = seen
        ) -> tuple[Tensor, Tensor]:
            values, combinations = inputs[rows[chosen]], len(noise)

            def normal(columns: int) -> Tensor:
                return torch.randn(len(chosen), columns, generator=generator)

            size = largest * torch.rand(len(chosen), 1, generator=generator).square()
            values[:, :combinations] *= 1.0 + RELATIVE_NOISE * normal(combinations)
            values[:, :combinations] += normal(combinations) * noise
            values[:, :combinations] += size.exp() * normal(1) * drift
            values[:, combinations:-1] += FEATURE_NOISE * normal(inputs.shape[1] - combinations - 1)
            values[:, -1:] = size
            return values, target[rows[chosen]]

        def plain(chosen: Tensor, _: torch.Generator, rows: Tensor = left) -> tuple[Tensor, Tensor]:
            return inputs[rows[chosen]], target[rows[chosen]]

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
    networks = AngleNetworks(
        tuple(np.stack([_plain(x.weight) for x in each]) for each in zip(*layers, strict=True)),
        tuple(np.stack([_plain(x.bias) for x in each]) for each in zip(*layers, strict=True)),
        unit,
        ends,
    )
    losses = (
        np.mean([each for each in one if each], axis=0).tolist()
        for one in ([x.training for x in curves], [x.validation for x in curves])
    )
    return networks, LearningCurve(*map(tuple, losses))


def _tell(progress: Progress, member: int, done: int, total: int) -> None:
    """Report the epochs of all networks together."""
    progress("angles", member * total + done, MEMBERS * total)


def groups_of_specimens(frames: BentFrames, seed: int) -> Integers:
    """Number of the group of each specimen (S,), by the likeness of their bend curves.

    Specimens of one clamp bend alike. A network that goes without a group has not seen its clamp,
    as it will not have seen that of the next sensor. The curves are least-squares polynomials,
    compared by their first principal components, in k-means.
    """
    powers = (frames.angle_deg[:, None] / SCALE) ** np.arange(1, POWERS + 1)
    count = int(frames.specimen.max()) + 1
    curves = np.zeros((count, POWERS * frames.change.shape[1]))
    for number in range(count):
        rows = frames.specimen == number
        gram = powers[rows].T @ powers[rows] + RIDGE * np.eye(POWERS)
        curves[number] = np.linalg.solve(gram, powers[rows].T @ frames.change[rows]).ravel()
    left, sizes, _ = np.linalg.svd(curves - curves.mean(axis=0), full_matrices=False)
    kept = 2 * POWERS
    _, group = kmeans2(left[:, :kept] * sizes[:kept], min(GROUPS, count), minit="++", seed=seed)
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
