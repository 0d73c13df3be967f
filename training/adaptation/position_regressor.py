"""Touch positions learned by version 0.1: a regression from the direction of a frame's change."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError
from eitskin.training.adaptation.map_grid import Places


@dataclass(frozen=True, slots=True, eq=False)
class PositionRegressor:
    """Gaussian-process regression from a frame and its reference to (x, y).

    The features are log |V / ref| per channel, divided by the channel's root mean square over the
    training touches and then by the norm of the vector: to first order a touch changes all channels
    in proportion to its strength, so the direction of the vector depends on position alone. The
    covariance is a Matern 5/2 function of the distance of two directions, plus white noise
    (Rasmussen and Williams 2006, section 4.2). Loaded from saved pipelines; no longer learned.

    Attributes:
        channel_scale: root mean square of the log ratios (C,).
        directions: unit feature vectors of the training touches (k, C).
        weights: of the training touches in a prediction (k, 2) [m].
        centre: mean of the training positions (2,) [m].
        length: length scale of the covariance, dimensionless.
        variance: covariance at distance zero.
    """

    channel_scale: NDArray[np.float64]
    directions: NDArray[np.float64]
    weights: NDArray[np.float64]
    centre: NDArray[np.float64]
    length: float
    variance: float

    def apply(self, ratio: ArrayLike) -> NDArray[np.float64]:
        """Positions (n, 2) [m] of one touch in each frame, from |V / ref| (n, C).

        Raises DataError for another number of channels.
        """
        logs = log_ratio(ratio)
        self.require_channels(logs.shape[-1])
        directions = _directions(logs / self.channel_scale)
        inner = directions @ self.directions.T
        square = np.sum(directions**2, axis=1)[:, None] + np.sum(self.directions**2, axis=1)
        d = np.sqrt(5.0 * np.maximum(square - 2.0 * inner, 0.0)) / self.length
        covariance = self.variance * (1.0 + d + d**2 / 3.0) * np.exp(-d)
        places: NDArray[np.float64] = covariance @ self.weights + self.centre
        return places

    def locate(self, ratio: ArrayLike) -> tuple[Places, NDArray[np.bool_]]:
        """Places of `apply`, without standard errors, and no channel left out (n, C)."""
        place, strength = self.apply(ratio), self.strength(ratio)
        none = np.zeros(np.shape(ratio))
        return Places(place, np.full(len(place), np.nan), strength, none), none > 0

    def strength(self, ratio: ArrayLike) -> NDArray[np.float64]:
        """Strength (n,) of the changes |V / ref| (n, C), relative to the touches trained with.

        Root mean square over the channels, each in units of its `channel_scale`.
        """
        strength: NDArray[np.float64] = np.sqrt(
            np.mean((log_ratio(ratio) / self.channel_scale) ** 2, axis=-1)
        )
        return strength

    def require_channels(self, channels: int) -> None:
        """Refuse another number of channels than the trained one; raises DataError."""
        if channels != len(self.channel_scale):
            raise DataError(
                f"these touch positions were learned from {len(self.channel_scale)} channels, "
                f"got {channels}; train on recordings of this sensor"
            )

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Arrays from which `from_arrays` restores the regressor, by name."""
        return {
            "channel_scale": self.channel_scale,
            "directions": self.directions,
            "weights": self.weights,
            "centre": self.centre,
            "length": np.array(self.length),
            "variance": np.array(self.variance),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "PositionRegressor":
        """Restore the regressor that `arrays` came from."""
        values = {name: array.astype(float) for name, array in arrays.items()}
        length, variance = float(values.pop("length")), float(values.pop("variance"))
        return cls(**values, length=length, variance=variance)


def log_ratio(ratio: ArrayLike) -> NDArray[np.float64]:
    """log |V / ref| of ratios (n, C); zero where a channel is bad."""
    size = np.abs(np.asarray(ratio))
    usable = np.isfinite(size) & (size > 0)
    return np.log(np.where(usable, size, 1.0))


def _directions(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors (n, C) divided by their norms."""
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    directions: NDArray[np.float64] = vectors / np.where(norm > 0, norm, 1.0)
    return directions
