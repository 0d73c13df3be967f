"""Features of frames for methods that regress tables."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from eitskin.training.method.missing_channels import MissingChannels
from eitskin.training.method.observations import Observations
from eitskin.training.method.training_frames import TrainingFrames

Array = NDArray[np.float64]

SOFT = 3.0  # noises below which the direction of a difference fades


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Features of a frame, each with mean 0 and standard deviation 1 over the training frames.

    They are dV from the static reference; the direction of dV from the dynamic reference, which a
    touch's force changes little; and the logarithms of the sizes of both, in units of the noise.

    Attributes:
        static, dynamic: imputation of bad channels of dV from either reference.
        noise: rms of dV over the channels in a frame of noise alone, dimensionless.
        mean, scale: of the raw features (F,).
    """

    static: MissingChannels
    dynamic: MissingChannels
    noise: float
    mean: Array
    scale: Array

    @classmethod
    def fit(cls, frames: TrainingFrames) -> "Features":
        """Features scaled to some frames."""
        seen, noise = frames.observations, max(frames.noise, 1e-9)
        static, dynamic = (MissingChannels.fit(dV, noise) for dV in (seen.static, seen.dynamic))
        raw = cls(static, dynamic, noise, np.zeros(1), np.ones(1))
        table = raw.apply(seen)
        scale = table.std(axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        return cls(static, dynamic, noise, table.mean(axis=0), scale)

    def apply(self, observations: Observations) -> Array:
        """Table of features (n, F)."""
        static, dynamic = (
            self.static.fill(observations.static),
            self.dynamic.fill(observations.dynamic),
        )
        floor = self.noise * np.sqrt(static.shape[1])
        sizes = [np.linalg.norm(dV, axis=1, keepdims=True) for dV in (static, dynamic)]
        direction = dynamic / np.hypot(sizes[1], SOFT * floor)
        logs = [np.log1p(size / floor) for size in sizes]
        table: Array = (np.hstack([static, direction, *logs]) - self.mean) / self.scale
        return table

    def arrays(self) -> dict[str, Array]:
        """Arrays from which `from_arrays` restores the features, (C, C), (F,) and ()."""
        return {
            "static": self.static.covariance,
            "dynamic": self.dynamic.covariance,
            "noise": np.array(self.noise),
            "mean": self.mean,
            "scale": self.scale,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> "Features":
        """Restore the features that `arrays` came from."""
        values = {name: array.astype(float) for name, array in arrays.items()}
        static, dynamic = (MissingChannels(values[name]) for name in ("static", "dynamic"))
        return cls(static, dynamic, float(values["noise"]), values["mean"], values["scale"])
