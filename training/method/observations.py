"""Input of a method: differences of frames to both references; channels that are missing."""

import hashlib
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.datasets import Dataset, State
from eitskin.extras import old_names
from eitskin.geometry import DataError
from eitskin.training.method.stored_fields import StoredFields

Array = NDArray[np.float64]

UNKNOWN_AGE = 5.0
"""Assumed age of a dataset's static references, which carry no time [s]."""


MEDIAN_FRAMES = 4  # of the median channel, which each channel's noise is estimated with
NOISE_FLOOR = 1e-3  # least noise of a channel, of the rms of all


def relative_difference(impedance: ArrayLike, reference: ArrayLike) -> NDArray[np.float64]:
    """Real part of dV = (V - ref) / ref per channel, dimensionless.

    The sensor is resistive: bends and touches change the magnitude, whose relative change is the
    real part to first order; the imaginary part holds noise and phase error only. A phase or gain
    common to V and ref cancels. NaN where V or ref is NaN.

    Args:
        impedance: V (..., measurements) [ohm].
        reference: ref (..., measurements) [ohm].
    """
    V, ref = np.asarray(impedance), np.asarray(reference)
    with np.errstate(invalid="ignore"):  # complex NaN marks a bad channel
        difference: NDArray[np.float64] = np.real((V - ref) / ref).astype(float)
    return difference


@old_names(of="from_dataset")
@dataclass(frozen=True, slots=True, eq=False)
class Observations(StoredFields):
    """n frames of C measurements next to their references; NaN where a measurement is bad.

    Attributes:
        static: dV from the flat, untouched sensor (n, C), dimensionless.
        dynamic: dV from the untouched sensor at the same bend (n, C), or from a session's estimate
            of that reference.
        flat: magnitudes of the flat, untouched sensor (n, C) [ohm].
        frames: number of frames of a held touch averaged into each (n,). These numbers count in
            frames with the noise of training: one of a quieter session counts as several.
        static_frames, dynamic_frames: number of frames averaged into the references (n,).
        age, dynamic_age: time since the static, the dynamic reference was renewed (n,) [s].

    Example:
        >>> from eitskin.training import Observations
        >>> [*Observations.__dataclass_fields__][:2]
        ['static', 'dynamic']
    """

    static: Array
    dynamic: Array
    flat: Array
    frames: Array
    static_frames: Array
    dynamic_frames: Array
    age: Array
    dynamic_age: Array

    @classmethod
    def from_dataset(cls, dataset: Dataset) -> "Observations":
        """All frames of a dataset, each independent of the others.

        The static reference replaces an unknown dynamic one. Static references of simulated
        datasets are free of noise.
        """
        flat = dataset.reference[dataset.specimen]
        bad = dataset.status != 0
        return cls(
            np.where(bad, np.nan, relative_difference(dataset.impedance, flat)),
            np.where(
                bad, np.nan, relative_difference(dataset.impedance, dataset.values_before_touch)
            ),
            np.abs(flat).astype(float),
            np.where(dataset.touch_count > 0, float(dataset.touch_frames), 1.0),
            np.full(len(dataset), np.inf if dataset.source == "simulated" else 1.0),
            np.full(len(dataset), float(dataset.reference_frames)),
            np.full(len(dataset), UNKNOWN_AGE),
            np.zeros(len(dataset)),
        )

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.static)

    def __getitem__(self, rows: slice | NDArray[np.generic]) -> "Observations":
        """The frames of `rows` (slice, integers or mask)."""
        return Observations(*(getattr(self, field.name)[rows] for field in fields(self)))


def least_spread(observations: Observations) -> float:
    """Least spread of the channels in a frame over the mean of their changes, of all frames."""
    spreads = [np.inf]
    for change in observations.static:
        finite = change[np.isfinite(change)]
        if len(finite) and (mean := abs(finite.mean())) > 0.0:
            spreads.append(float(finite.std() / mean))
    return min(spreads)


def frame_noise(dataset: Dataset, observations: Observations) -> float:
    """Rms relative difference of two frames of an untouched sensor at one bend.

    Idle and bent frames differ from their own dynamic reference by noise alone; where that is
    unknown, idle frames differ so from the flat sensor.

    Raises DataError where the dataset has no such frames.
    """
    quiet = _quiet(dataset)
    if not quiet.any():
        raise DataError(
            "a pipeline learns the noise from idle frames, and this dataset has none; record or "
            "generate some"
        )
    return float(np.sqrt(np.nanmean(_squares_of_two(dataset, observations))))


def _quiet(dataset: Dataset) -> NDArray[np.bool_]:
    """Frames (n,) that differ from their dynamic reference by noise alone."""
    quiet: NDArray[np.bool_] = (dataset.state == State.IDLE) | (
        (dataset.state == State.BEND) & dataset.has_touch_reference
    )
    return quiet


def _squares_of_two(dataset: Dataset, observations: Observations) -> Array:
    """Squares of the differences of quiet frames (n, C), as if no reference had averaged frames."""
    averaged = np.where(dataset.has_touch_reference, observations.dynamic_frames, 1.0)
    squares: Array = observations.dynamic**2 * (2.0 / (1.0 + 1.0 / averaged))[:, None]
    return squares[_quiet(dataset)]


def channel_noise(dataset: Dataset, observations: Observations) -> Array:
    """Rms relative difference of two frames of an untouched sensor, for each channel (C,).

    White noise is the larger part of a reading the smaller that is, as between neighbours far from
    the driven electrodes. Few frames are helped out by the median channel, which counts as
    `MEDIAN_FRAMES` more; a channel that never differs has a floor.

    Raises DataError where the dataset has no such frames.
    """
    overall = frame_noise(dataset, observations)
    squares = _squares_of_two(dataset, observations)
    finite = np.isfinite(squares)
    total, count = np.sum(np.where(finite, squares, 0.0), axis=0), finite.sum(axis=0)
    usual = float(np.median((total / np.maximum(count, 1))[count > 0]))
    variance = (total + MEDIAN_FRAMES * usual) / (count + MEDIAN_FRAMES)
    noise: Array = np.sqrt(np.maximum(variance, (NOISE_FLOOR * overall) ** 2))
    return noise


def fingerprint(dataset: Dataset) -> str:
    """SHA-256 of all frames in their order, by which a pipeline knows its own training set."""
    return hashlib.sha256(np.ascontiguousarray(dataset.impedance).view(np.uint8).data).hexdigest()


@dataclass(frozen=True, slots=True, eq=False)
class MissingChannels(StoredFields):
    """Imputation of bad channels by their conditional mean under a normal distribution of dV.

    Zeros, no signal, would be wrong: on a bent sensor, channels that stay at zero among others
    that have all changed look like a touch.

    Attributes:
        covariance: covariance of dV, with mean zero, (C, C), dimensionless.
    """

    covariance: NDArray[np.float64]

    @classmethod
    def fit(cls, difference: ArrayLike, noise: float) -> "MissingChannels":
        """Covariance of dV (n, C), rows with bad channels left out; `noise` is its rms noise."""
        dV = np.asarray(difference, dtype=float)
        dV = dV[np.isfinite(dV).all(axis=1)]
        floor = max(noise, 1e-9) ** 2  # keeps the good channels' covariance invertible
        return cls(dV.T @ dV / max(len(dV), 1) + floor * np.eye(dV.shape[1]))

    def fill(self, difference: ArrayLike) -> NDArray[np.float64]:
        """dV (n, C) with gaps (not finite) replaced by E[bad | good] = C_bg C_gg^-1 good."""
        dV = np.array(difference, dtype=float)
        gaps = ~np.isfinite(dV)
        patterns = {row.tobytes(): row for row in gaps[gaps.any(axis=1)]}
        for pattern in patterns.values():
            rows = (gaps == pattern).all(axis=1)
            good = ~pattern
            weights = np.linalg.solve(self.covariance[np.ix_(good, good)], dV[rows][:, good].T)
            dV[np.ix_(rows, pattern)] = (self.covariance[np.ix_(pattern, good)] @ weights).T
        return dV
