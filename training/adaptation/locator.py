"""Locators of a touch: from maps of all channels, and as version 0.1 learned it."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import barycentric_interpolate
from scipy.linalg import eigh

from eitskin.geometry import DataError
from eitskin.training.adaptation.channel_maps import PlaceKernel
from eitskin.training.method.stored_fields import StoredField, StoredFields

Array = NDArray[np.float64]

TAIL = 8.0  # degrees of freedom of the misfit: a frame that fits badly is trusted less
FINE = 6  # parts of a cell's side around the best places
MODES = 3
UNKNOWN_SCALE = 1e12  # of a channel that was bad in training
WIDE = 10.0  # cells that share the posterior, beyond which they are not divided
ROUNDS = 2  # of strength against the variance that depends on it
_SUPPORT = 6  # nodes of the interpolation between grid points
MAX_OMITTED_FRACTION = 4  # a channel in so many
SUSPECTS = 3  # channels that are tried without
MAX_SUSPECTED_CHANNELS = 4  # channels of one frame
MAX_SEPARATE_MAPS = 32  # channels, whose maps all count one by one
MIN_MEAN = 1e-2  # mean square of a map, in units of the noise, from which it counts alone


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Posterior of the place and strength of one touch in each of n frames.

    Attributes:
        place: posterior mean (n, 2) [m].
        deviation: posterior standard error, sqrt(var x + var y) (n,) [m].
        strength: relative strength (n,).
        misfit: residual of each channel, in standard deviations of it given all others (n, C).
    """

    place: Array
    deviation: Array
    strength: Array
    misfit: Array

    def shrink_towards(self, middle: Array, trust: float, extent: float) -> "Places":
        """Places drawn to the middle (2,) [m] of all presses by a factor, their errors with them.

        Args:
            middle: middle that is right where nothing is known.
            trust: factor of the distance from it, 0 to 1.
            extent: standard deviation of places along an axis [m].
        """
        place = middle + trust * (self.place - middle)
        spread = np.sqrt(trust * self.deviation**2 + (1.0 - trust) * 2.0 * extent**2)
        return replace(self, place=place, deviation=spread)


def mixture_places(each: Sequence[Places]) -> Places:
    """Mean and standard error of places by several models, each as likely as another.

    Strength and misfit are means, too.
    """
    if len(each) == 1:
        return each[0]
    place = np.mean([one.place for one in each], axis=0)
    squares = [one.deviation**2 + np.sum((one.place - place) ** 2, axis=1) for one in each]
    strength, misfit = (
        np.mean([getattr(one, name) for one in each], axis=0) for name in ("strength", "misfit")
    )
    return Places(place, np.sqrt(np.mean(squares, axis=0)), strength, misfit)


@dataclass(frozen=True, slots=True, eq=False)
class MapGrid(StoredFields):
    """Posterior maps of the channels on a regular grid.

    The first K independent maps count one by one; the mean of the others is zero, and their
    variance that of their mean.

    Attributes:
        low: first grid point (2,) [m].
        step: step of the grid [m].
        mean: mean of the independent maps (rows along y, columns along x, K).
        variance: variance of the independent maps, of the same shape.
        log_prior: log prior of a touch at each grid point (rows, columns); -inf where none can be.
        whitening: whitening from channels to independent answers (C, I), those of the K maps first.
        strength: prior mean and standard deviation of the strength (2,).
        rest: variance of each of the other I - K maps (rows, columns); None without any.
    """

    low: Array
    step: float
    mean: Array
    variance: Array
    log_prior: Array
    whitening: Array
    strength: Array
    rest: Array | None = None

    @property
    def middle(self) -> Array:
        """Middle of the region where touches can be (2,) [m]."""
        row, column = np.nonzero(np.isfinite(self.log_prior))
        middle: Array = self.low + self.step * np.array([column.mean(), row.mean()])
        return middle

    def merge_weak_maps(self) -> "MapGrid":
        """Grid whose maps of little mean, share one variance, unless there are few."""
        size = np.mean(self.mean**2, axis=(0, 1))
        order = np.argsort(-size, kind="stable")
        map_count = max(1, int(np.sum(size > MIN_MEAN)))
        if self.rest is not None or map_count >= len(size) or len(size) <= MAX_SEPARATE_MAPS:
            return self
        first, others = order[:map_count], order[map_count:]
        return replace(
            self,
            mean=self.mean[..., first],
            variance=self.variance[..., first],
            whitening=self.whitening[:, order],
            rest=self.variance[..., others].mean(axis=-1),
        )

    def drop_channels(self, bad: NDArray[np.bool_]) -> "MapGrid":
        """Grid of the channels that are not bad (C,), which the values of bad ones do not change.

        Their noise stays what it was; the maps are made independent again by their mean squares
        over the grid, and covariances that are left at a single place are neglected.
        """
        return _grid_without_channels(self, bad.tobytes())

    def locate(self, answers: ArrayLike, bad: NDArray[np.bool_] | None = None) -> Places:
        """Place and strength of one touch in each frame.

        The posterior of the place is summed over the cells of the grid, with the strength at its
        best for each place (Laplace), and over finer cells around the best ones.

        Args:
            answers: answers of the channels, in the units of the maps (n, C).
            bad: channels that are left out of a frame (n, C); none when omitted.
        """
        y = np.asarray(answers, dtype=float)
        out = np.zeros(y.shape, dtype=bool) if bad is None else bad
        densities = [
            (self.drop_channels(skip) if skip.any() else self)._locate(np.where(skip, 0.0, row))
            for row, skip in zip(y, out, strict=True)
        ]
        place, deviation, strength, misfit = (list(each) for each in zip(*densities, strict=True))
        return Places(np.array(place), np.array(deviation), np.array(strength), np.array(misfit))

    def _locate(self, answer: Array) -> tuple[Array, float, float, Array]:
        rows, columns, map_count = self.mean.shape
        whitened = answer @ self.whitening
        likelihood = partial(score, self.strength, whitened)
        allowed = np.flatnonzero(np.isfinite(self.log_prior))
        log = np.full(rows * columns, -np.inf)
        means, variances = (m.reshape(-1, map_count)[allowed] for m in (self.mean, self.variance))
        allowed_rest = None if self.rest is None else self.rest.ravel()[allowed]
        log[allowed], _ = likelihood(means, variances, allowed_rest)
        log = (log + self.log_prior.ravel()).reshape(rows, columns)
        coarse, points, parts = log.copy(), [], []
        wide = np.exp(log - log.max()).sum() > WIDE  # of few presses: cells are fine enough
        for _ in range(0 if wide else MODES):
            row, column = np.unravel_index(int(np.argmax(coarse)), coarse.shape)
            if not coarse[row, column] > log.max() - 12.0:
                break
            near = (
                slice(max(int(row) - 1, 0), int(row) + 2),
                slice(max(int(column) - 1, 0), int(column) + 2),
            )
            fine, log_prior = self._fine(near, np.isfinite(coarse[near]))
            points.append(fine)
            parts.append(likelihood(*self._interpolate(fine))[0] + log_prior - 2 * np.log(FINE))
            coarse[near] = -np.inf
        candidates = np.argwhere(coarse > log.max() - 12.0)
        points.append(candidates[:, ::-1].astype(float))
        parts.append(coarse[tuple(candidates.T)])
        at, log_mass = np.concatenate(points), np.concatenate(parts)
        mass = np.exp(log_mass - log_mass.max())
        mass /= mass.sum()
        middle = mass @ at
        spread = mass @ np.sum((at - middle) ** 2, axis=1) + 1.0 / (6.0 * FINE**2)
        best = at[int(np.argmax(log_mass))]
        maps = self._interpolate(best[None])
        strength = float(likelihood(*maps)[1][0])
        return (
            self.low + self.step * middle,
            self.step * float(np.sqrt(spread)),
            strength,
            self._misfit(whitened, *maps, strength),
        )

    def _fine(self, near: tuple[slice, slice], free: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Finer points x, y (n, 2) of the free cells of a block of the grid, and their prior."""
        rows, columns = self.log_prior.shape
        inner = (np.arange(FINE) + 0.5) / FINE - 0.5
        cells = np.argwhere(free) + np.array([near[0].start, near[1].start])
        offsets = np.stack(np.meshgrid(inner, inner, indexing="ij"), axis=-1).reshape(-1, 2)
        at = (cells[:, None] + offsets).reshape(-1, 2)[:, ::-1]
        prior = np.repeat(self.log_prior[tuple(cells.T)], FINE**2)
        return np.clip(at, 0.0, [columns - 1.0, rows - 1.0]), prior

    def _interpolate(self, at: Array) -> tuple[Array, Array, Array | None]:
        """Mean, by polynomials, and variances, of the nearest point, at indices x, y (n, 2)."""
        rows, columns, _ = self.mean.shape
        size = (min(_SUPPORT, columns), min(_SUPPORT, rows))
        starts = [
            np.clip(np.floor(at[:, axis]).astype(int) - size[axis] // 2 + 1, 0, n - size[axis])
            for axis, n in enumerate((columns, rows))
        ]
        weights = [  # of the nodes 0, 1, ... in the polynomial through them
            barycentric_interpolate(np.arange(nodes), np.eye(nodes), at[:, axis] - starts[axis])
            for axis, nodes in enumerate(size)
        ]
        y, x = (starts[axis][:, None] + np.arange(size[axis]) for axis in (1, 0))
        near = self.mean[y[:, :, None], x[:, None]]
        mean = np.einsum("ni,nj,nijk->nk", weights[1], weights[0], near, optimize=True)
        column, row = np.rint(at).astype(int).T
        return (
            mean,
            self.variance[row, column],
            None if self.rest is None else self.rest[row, column],
        )

    def _misfit(
        self, whitened: Array, mean: Array, variance: Array, rest: Array | None, strength: float
    ) -> Array:
        """Residual of each channel given all others, in standard deviations (C,)."""
        map_count = mean.shape[1]
        spread = np.full(len(whitened), 0.0 if rest is None else rest[0])
        spread[:map_count] = variance[0]
        residual = whitened.copy()
        residual[:map_count] -= strength * mean[0]
        precision = 1.0 / (strength**2 * spread + 1.0)
        size = np.sum(self.whitening**2 * precision, axis=1)
        misfit: Array = self.whitening @ (precision * residual) / np.sqrt(np.maximum(size, 1e-12))
        return misfit


@lru_cache(maxsize=16)
def _back(grid: MapGrid) -> Array:
    """Channels of the independent maps (I, C): the inverse of the whitening."""
    return np.asarray(np.linalg.pinv(grid.whitening), dtype=np.float64)


@lru_cache(maxsize=64)
def _grid_without_channels(grid: MapGrid, pattern: bytes) -> MapGrid:
    """`MapGrid.drop_channels`, the bad channels as bytes; sessions have few patterns of them."""
    good = np.flatnonzero(~np.frombuffer(pattern, dtype=bool))
    kept, count = grid.mean.shape[2], grid.whitening.shape[1]
    back = _back(grid)[:, good]
    rest = np.zeros(grid.log_prior.shape) if grid.rest is None else grid.rest
    size = np.full(count, float(rest.mean()))
    size[:kept] = np.mean(grid.mean**2 + grid.variance, axis=(0, 1))
    gain, own = eigh(back.T @ (size[:, None] * back), back.T @ back)
    own = own[:, np.argsort(-gain, kind="stable")]
    turn = back @ own
    most = min(kept, len(good))
    whitening = np.zeros((len(grid.whitening), len(good)))
    whitening[good] = own
    square = turn**2
    variance = grid.variance @ square[:kept] + rest[..., None] * square[kept:].sum(axis=0)
    return replace(
        grid,
        mean=grid.mean @ turn[:kept, :most],
        variance=variance[..., :most],
        whitening=whitening,
        rest=variance[..., most:].mean(axis=-1) if most < len(good) else None,
    )


def score(
    prior: Array, whitened: Array, mean: Array, variance: Array, rest: Array | None = None
) -> tuple[Array, Array]:
    """Log likelihood of places for one frame, with the strength at its best, and that (n,) each.

    Args:
        prior: mean and standard deviation of the strength (2,).
        whitened: independent answers (I,).
        mean, variance: moments of the first K maps at the places (n, K).
        rest: variance of the other maps, whose mean is zero (n,); None without any.
    """
    s = np.full(len(mean), prior[0])
    weight, map_count = 1.0 / prior[1] ** 2, mean.shape[1]
    first, others = whitened[:map_count], float(np.sum(whitened[map_count:] ** 2))
    for _ in range(ROUNDS):
        precision = 1.0 / (s[:, None] ** 2 * variance + 1.0)
        weighted = precision * mean
        ym, mm = weighted @ first, np.einsum("nk,nk->n", weighted, mean)
        yy, log = precision @ first**2, np.log(precision).sum(axis=1)
        if rest is not None:
            alike = 1.0 / (s**2 * rest + 1.0)
            yy, log = yy + alike * others, log + (len(whitened) - map_count) * np.log(alike)
        s = np.maximum((ym + prior[0] * weight) / (mm + weight), 0.05 * prior[0])
    square = np.maximum(yy - 2.0 * s * ym + s**2 * mm, 0.0)
    likelihood = -0.5 * (TAIL + len(whitened)) * np.log1p(square / TAIL) + 0.5 * log
    off = (s - prior[0]) ** 2 * weight
    return likelihood - 0.5 * off - 0.5 * np.log(mm + weight), s


class Locator(StoredFields, ABC):
    """Base of locators: how strong a touch is, relative to those learned from.

    Attributes:
        channel_scale: root mean square of the log ratios (C,).
        centre: mean of the training places (2,) [m].
    """

    __slots__ = ()
    channel_scale: Array
    centre: Array

    def strength(self, ratio: ArrayLike) -> Array:
        """Strength (n,) of the changes |V / ref| (n, C), relative to the touches trained with.

        Root mean square over the channels, each in units of its `channel_scale`.
        """
        strength: Array = np.sqrt(np.mean((log_ratio(ratio) / self.channel_scale) ** 2, axis=-1))
        return strength

    @abstractmethod
    def locate(self, ratio: ArrayLike) -> tuple[Places, NDArray[np.bool_]]:
        """Place and strength of one touch in each frame, and the channels left out (n, C).

        Args:
            ratio: |V / ref| (n, C).

        Raises DataError for another number of channels.
        """

    def apply(self, ratio: ArrayLike) -> Array:
        """Positions (n, 2) [m] of `locate`."""
        return self.locate(ratio)[0].place

    def require_channels(self, channels: int) -> None:
        """Refuse another number of channels than the trained one; raises DataError."""
        if channels != len(self.channel_scale):
            raise DataError(
                f"these touch positions were learned from {len(self.channel_scale)} channels, "
                f"got {channels}; train on recordings of this sensor"
            )


@dataclass(frozen=True, slots=True, eq=False)
class PositionRegressor(Locator):
    """Gaussian-process regression from a frame and its reference to (x, y).

    The features are log |V / ref| per channel, divided by the channel's root mean square over the
    training touches and then by the norm of the vector: to first order a touch changes all channels
    in proportion to its strength, so the direction of the vector depends on position alone. The
    covariance is a Matern 5/2 function of the distance of two directions, plus white noise
    (Rasmussen and Williams 2006, section 4.2). Loaded from saved pipelines; no longer learned.

    Attributes:
        channel_scale: root mean square of the log ratios (C,).
        directions: unit feature vectors of the training touches (k, C).
        weights: weights of the training touches in a prediction (k, 2) [m].
        centre: mean of the training positions (2,) [m].
        length: length scale of the covariance, dimensionless.
        variance: covariance at distance zero.
    """

    channel_scale: Array
    directions: Array
    weights: Array
    centre: Array
    length: float
    variance: float

    def locate(self, ratio: ArrayLike) -> tuple[Places, NDArray[np.bool_]]:
        """Places without standard errors, and no channel left out (n, C)."""
        logs = log_ratio(ratio)
        self.require_channels(logs.shape[-1])
        vectors = logs / self.channel_scale
        norm = np.linalg.norm(vectors, axis=1, keepdims=True)
        directions = vectors / np.where(norm > 0, norm, 1.0)
        covariance = self.variance * PlaceKernel(self.length)(directions, self.directions)
        place, none = covariance @ self.weights + self.centre, np.zeros(logs.shape)
        return Places(place, np.full(len(place), np.nan), self.strength(ratio), none), none > 0


def log_ratio(ratio: ArrayLike) -> Array:
    """log |V / ref| of ratios (n, C); zero where a channel is bad."""
    size = np.abs(np.asarray(ratio))
    usable = np.isfinite(size) & (size > 0)
    return np.log(np.where(usable, size, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class PressLocator(Locator):
    """Gaussian-process maps of all channels, inverted for the place of a touch.

    Attributes:
        grid: the maps.
        gain: gain of the channels (C,), by which log |V / ref| is divided; 0 of those that were
            bad.
        channel_scale: root mean square of the log ratios (C,).
        centre: mean of the training places (2,) [m].
        error_factor: factor of the standard errors, from presses that were left out.
        misfit_limit: misfit of a channel beyond which a frame is located without it.
        others: further models of the maps, in the same units; places are means over all.
        trust: factor of distances from the middle, below 1 where presses show little.
        extent: standard deviation of the presses' places along an axis [m].
        lost_factor: factor of the standard errors where channels are left out.
    """

    grid: MapGrid
    gain: Array
    channel_scale: Array
    centre: Array
    error_factor: float
    misfit_limit: float
    others: Annotated[tuple[MapGrid, ...], StoredField("other")] = ()
    trust: float = 1.0
    extent: float = 0.0
    lost_factor: float = 1.0

    def locate(self, ratio: ArrayLike) -> tuple[Places, NDArray[np.bool_]]:
        """Place and strength of one touch in each frame, and the channels left out (n, C).

        Bad channels are left out. Where a channel departs by more than `misfit_limit` from what all
        others say, that of the worst ones is left out without which the rest agrees best, and so
        on, at most one in `MAX_OMITTED_FRACTION`, and `MAX_SUSPECTED_CHANNELS` in all.
        """
        size = np.abs(np.asarray(ratio))
        logs = log_ratio(ratio)
        self.require_channels(logs.shape[-1])
        bad = ~(np.isfinite(size) & (size > 0) & (self.gain != 0))
        lost = (bad & (self.gain != 0)).sum(axis=1) > 1
        answers = logs / np.where(self.gain == 0, 1.0, self.gain)
        located = self._locate_combined(answers, bad)
        rounds = min(logs.shape[1] // MAX_OMITTED_FRACTION, MAX_SUSPECTED_CHANNELS)
        most = bad.sum(axis=1) + rounds
        for _ in range(rounds):
            over = np.abs(located.misfit).max(axis=1) > self.misfit_limit
            again = np.flatnonzero(over & (bad.sum(axis=1) < most))
            if not len(again):
                break
            worst = np.argsort(-np.abs(located.misfit[again]), axis=1)[:, :SUSPECTS]
            smallest = np.full(len(again), np.inf)
            before = bad[again]
            for suspect in worst.T:
                less = before.copy()
                less[np.arange(len(again)), suspect] = True
                other = self._locate_combined(answers[again], less)
                size = np.abs(other.misfit).max(axis=1)
                better = size < smallest
                smallest[better] = size[better]
                bad[again[better]] = less[better]
                for field in fields(Places):
                    getattr(located, field.name)[again[better]] = getattr(other, field.name)[better]
        located = located.shrink_towards(self.grid.middle, self.trust, self.extent)
        factor = self.error_factor * np.where(lost, self.lost_factor, 1.0)
        return replace(located, deviation=located.deviation * factor), bad

    def _locate_combined(self, answers: Array, bad: NDArray[np.bool_]) -> Places:
        """Places by all models from answers (n, C) without the bad ones (n, C)."""
        return mixture_places([grid.locate(answers, bad) for grid in (self.grid, *self.others)])
