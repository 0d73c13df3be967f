"""Stages of the paper's method: reconstruction, classifier, bend angle, and touches in its maps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.datasets import State
from eitskin.extras import require
from eitskin.geometry import DataError
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.settings import NetworkSettings, Progress, silent
from eitskin.training.method.stored_fields import GIVEN_FIELD, Arrays, StoredField, StoredFields
from eitskin.training.paper.layers import (
    Network,
    coordinates,
    state_layers,
    touch_map_layers,
)
from eitskin.training.reconstruction.regularised_inverse import (
    MAX_SNR,
    gauss_newton,
    noser_weights,
)

Array = NDArray[np.float64]

TOLERANCE = 1.05  # of the residual of bend frames, over the noise
THRESHOLD = 0.4  # of the map, whose values are probabilities of being under an indenter
MIN_COMPONENT_PIXELS = 4  # pixels; a smaller component is no indenter
FOLDS = 5  # of the cross-validation of the bend angle's features
_CUT = float(np.finfo(float).eps)  # singular value, over the largest, that counts as zero

Frames = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction(StoredFields):
    """Linear reconstruction of the relative conductivity change from dV.

    Attributes:
        matrix: reconstruction matrix (pixels, measurements), dimensionless.
        shape: shape of an image, (rows along y, columns along x).
        regularisation: lambda of the one-step Gauss-Newton method, dimensionless.
    """

    matrix: Array
    shape: tuple[int, int]
    regularisation: float

    @classmethod
    def fit(
        cls, jacobian: ArrayLike, snr: float, shape: tuple[int, int], noise: ArrayLike = 1.0
    ) -> "Reconstruction":
        """Reconstruction matrix for a Jacobian and a signal-to-noise ratio.

        The matrix of the paper is (J^T J + lambda^2 R)^-1 J^T with NOSER's R = diag(J^T J), with a
        floor (`noser_weights`). lambda is not tuned but that of the signal-to-noise ratio
        (`RegularisedInverse.lambda_from_snr`).

        Args:
            jacobian: relative Jacobian (measurements, pixels), dimensionless.
            snr: signal-to-noise ratio of a touch, root mean squares; see `signal_to_noise`.
            shape: shape of an image, (rows along y, columns along x).
            noise: rms noise of each channel's dV (measurements,) in a common unit; channels count
                by its inverse, equally for a single number.

        """
        J = np.asarray(jacobian, dtype=float)
        rms = np.broadcast_to(np.asarray(noise, dtype=float), J.shape[:1])
        whitened = J / rms[:, None]
        family = gauss_newton(whitened, noser_weights(whitened))
        regularisation = family.lambda_from_snr(snr)
        return cls(family.matrix(regularisation) / rms, shape, regularisation)

    def apply(self, difference: ArrayLike) -> Array:
        """Relative conductivity change (..., rows, columns) from dV (..., measurements)."""
        dV = np.asarray(difference, dtype=float)
        images = dV @ self.matrix.T
        return images.reshape(*dV.shape[:-1], *self.shape)


def signal_to_noise(touch: ArrayLike, noise: float) -> float:
    """Signal-to-noise ratio of touches' dV (n, measurements) with noise of rms `noise` in it."""
    total = float(np.mean(np.square(np.asarray(touch, dtype=float))))
    if noise <= 0:
        return MAX_SNR
    # A signal below a tenth of the noise cannot be seen; the difference of squares may be negative.
    return float(np.sqrt(max(total / noise**2 - 1.0, 0.01)))


def bend_free_projection(bend: ArrayLike, noise: float) -> Array:
    """Orthogonal projection (C, C) that reduces the dV (n, C) of bend frames to their noise.

    Bending moves one sensor along a curve in the space of its channels, several sensors along
    several curves; the leading right singular vectors of their frames span these. The rank is the
    smallest that leaves a residual within five percent of `noise`, the rms of idle dV, and at most
    half the number of channels.
    """
    dV = np.asarray(bend, dtype=float)
    count, channels = dV.shape
    _, sizes, directions = np.linalg.svd(dV, full_matrices=False)
    energy = np.sum(sizes**2) - np.concatenate([[0.0], np.cumsum(sizes**2)])
    freedom = count * (channels - np.arange(len(energy)))
    residual = np.sqrt(np.maximum(energy, 0.0) / np.maximum(freedom, 1))
    # At least half of the channels' freedom stays: touches need it.
    rank = min(int(np.count_nonzero(residual > TOLERANCE * noise)), channels // 2)
    basis = directions[:rank]
    projection: Array = np.eye(channels) - basis.T @ basis
    return projection


@dataclass(frozen=True, eq=False)
class Classifier(StoredFields):
    """Classifier of the three states of `eitskin.datasets.State` from reconstructed maps.

    The paper does not say how maps are scaled. Here the maps are divided by their standard
    deviation over the training frames, or compressed: a touch may be three times the noise and a
    bend a hundred times, so the input is then asinh of the maps in units of their noise, linear
    for small values and logarithmic for large ones.

    Attributes:
        weights: trained weights and batch statistics of the network, by name.
        embedding: linear map from dV to scaled maps, (maps, pixels, measurements).
        shape: rows and columns of a map.
        compress: whether asinh is taken of the maps.
        history: losses in training.
        states: states that were trained for; the others have no probability.
    """

    weights: Annotated[Arrays, StoredField("layers")]
    embedding: Array
    shape: Annotated[tuple[int, int], GIVEN_FIELD]
    compress: bool
    history: LearningCurve = field(default_factory=LearningCurve)
    states: tuple[State, ...] = tuple(State)

    @cached_property
    def network(self) -> Network:
        """Network with these weights."""
        return Network.from_arrays(state_layers(self.shape, len(self.embedding)), self.weights)

    @classmethod
    def fit(
        cls,
        difference: ArrayLike,
        state: ArrayLike,
        embedding: ArrayLike,
        shape: tuple[int, int],
        settings: NetworkSettings,
        noise: ArrayLike = 0.0,
        seed: int = 0,
        progress: Progress = silent,
        validation: tuple[ArrayLike, ArrayLike] | None = None,
        *,
        compress: bool = True,
    ) -> "Classifier":
        """Training with cross-entropy and Adam; further arguments as for `networks.train_layers`.

        Args:
            difference: dV from the static reference (n, measurements), dimensionless.
            state: `State` values (n,).
            embedding: linear map from dV to maps (maps, pixels, measurements) in any units; not
                trained.
            shape, settings, noise, seed, progress, compress: see there.
            validation: dV and states of other frames.
        """
        require("torch", "training")
        import torch

        from eitskin.training.paper.networks import train_layers

        states = np.asarray(state, dtype=np.int64)
        scaled = _scale_maps(
            np.asarray(embedding, dtype=float),
            np.asarray(difference),
            states == State.IDLE if compress else None,
        )
        weights, history = train_layers(
            state_layers(shape, len(scaled)),
            (difference, states),
            scaled,
            shape,
            torch.nn.functional.cross_entropy,
            settings,
            noise,
            seed,
            partial(progress, "state classifier"),
            validation and (validation[0], np.asarray(validation[1], dtype=np.int64)),
            compress=compress,
        )
        present = tuple(state for state in State if np.any(states == state))
        return cls(weights, scaled, shape, compress, history, present)

    def apply(self, difference: ArrayLike) -> Array:
        """Probabilities (n, 3) of idle, touch and bend for dV (n, measurements).

        NaN for a state that was not trained for.
        """
        dV = np.asarray(difference, dtype=float)
        maps = np.stack([dV @ layer.T for layer in self.embedding], axis=1)
        if self.compress:
            maps = np.arcsinh(maps)
        logits = self.network.logits(maps.reshape(len(dV), -1, *self.shape))
        state_logits = logits[:, self.states]
        odds = np.exp(state_logits - state_logits.max(axis=1, keepdims=True))
        probabilities = np.full(logits.shape, np.nan)
        probabilities[:, self.states] = odds / odds.sum(axis=1, keepdims=True)
        return probabilities


@dataclass(frozen=True, eq=False)
class PostProcessor(StoredFields):
    """Convolutional network for the probability of each pixel to lie under an indenter.

    Attributes:
        weights: trained weights and batch statistics of the network, by name.
        scale: divisor of the reconstructions before the network, their standard deviation over
            the training frames.
        history: losses in training.
    """

    weights: Annotated[Arrays, StoredField("layers")]
    scale: float
    history: LearningCurve = field(default_factory=LearningCurve)

    @cached_property
    def network(self) -> Network:
        """Network with these weights."""
        layers = touch_map_layers(len(self.weights["0.weight"]))
        return Network.from_arrays(layers, self.weights)

    @classmethod
    def fit(
        cls,
        difference: ArrayLike,
        touch_map: ArrayLike,
        reconstruction: Reconstruction,
        settings: NetworkSettings,
        noise: ArrayLike = 0.0,
        seed: int = 0,
        progress: Progress = silent,
        validation: tuple[ArrayLike, ArrayLike] | None = None,
        flips: Sequence[tuple[bool, bool]] = ((False, False),),
    ) -> "PostProcessor":
        """Training with binary cross-entropy per pixel and Adam.

        Args:
            difference: dV from the dynamic reference (n, measurements), dimensionless.
            touch_map: true maps (n, rows, columns), 1 under an indenter and 0 elsewhere.
            reconstruction: linear layer before the network; not trained.
            settings, noise, seed, progress, flips: arguments of `networks.train_layers`.
            validation: dV and touch maps of other frames.
        """
        require("torch", "training")
        import torch

        from eitskin.training.paper.networks import train_layers

        scale = float(np.std(reconstruction.apply(difference))) or 1.0
        frames, *unseen = (
            (dV, np.asarray(maps, dtype=np.float32)[:, None])
            for dV, maps in ((difference, touch_map), *([validation] if validation else []))
        )
        weights, history = train_layers(
            touch_map_layers(),
            frames,
            reconstruction.matrix[None] / scale,
            reconstruction.shape,
            torch.nn.functional.binary_cross_entropy_with_logits,
            settings,
            noise,
            seed,
            partial(progress, "touch map"),
            unseen[0] if unseen else None,
            placed=True,
            flips=flips,
        )
        return cls(weights, scale, history)

    def apply(self, maps: ArrayLike) -> NDArray[np.float32]:
        """Touch maps, 0 to 1, from reconstructions, both (n, rows, columns)."""
        pictures = np.asarray(maps, dtype=np.float32)[:, None] / np.float32(self.scale)
        n, _, rows, columns = pictures.shape
        place = np.broadcast_to(coordinates((rows, columns)), (n, 2, rows, columns))
        logits = self.network.logits(np.concatenate([pictures, place], axis=1))[:, 0]
        touch_map: NDArray[np.float32] = (0.5 * (1 + np.tanh(0.5 * logits))).astype(np.float32)
        return touch_map


def _scale_maps(
    embedding: Array, difference: NDArray[np.floating], idle: NDArray[np.bool_] | None
) -> Array:
    """The embedding with each map divided by its standard deviation over the training frames.

    With a mask of `idle` frames, the divisor is twice the standard deviation over the idle frames:
    the noise, and some of its tail.
    """
    scaled = np.empty_like(embedding)
    for i, layer in enumerate(embedding):
        maps = difference @ layer.T
        noise = 0.0 if idle is None or not idle.any() else 2.0 * float(np.std(maps[idle]))
        scaled[i] = layer / (noise or float(np.std(maps)) or 1.0)
    return scaled


def find_touches(
    touch_map: ArrayLike, outline: tuple[float, float], threshold: float = THRESHOLD
) -> Array:
    """Touches (k, 3) of x [m], y [m] and strength in a touch map, strongest first.

    A touch is a connected component (8-neighbourhood) above a threshold. Its position is the
    centroid of the pixels weighted by their values, the paper's equation (3); its strength is its
    largest value.

    Args:
        touch_map: probabilities (rows along y, columns along x).
        outline: length and width that the map covers [m].
        threshold: threshold of the probabilities.
    """
    from scipy import ndimage  # which few commands need

    values = np.asarray(touch_map, dtype=float)
    labels, count = ndimage.label(values > threshold, structure=np.ones((3, 3)))
    numbers = np.arange(1, count + 1)
    numbers = numbers[ndimage.sum(labels > 0, labels, numbers) >= MIN_COMPONENT_PIXELS]
    if not numbers.size:
        return np.zeros((0, 3))
    pixel = np.array(outline[::-1]) / values.shape  # along y and x
    places = (np.array(ndimage.center_of_mass(values, labels, numbers)) + 0.5) * pixel
    touches = np.column_stack([places[:, ::-1], ndimage.maximum(values, labels, numbers)])
    strongest_first: Array = touches[np.argsort(-touches[:, 2], kind="stable")]
    return strongest_first


@dataclass(frozen=True, slots=True, eq=False)
class BendAngle(StoredFields):
    """Linear regression of the bend angle on selected features of dV.

    The features are dV, as in the paper, and optionally its squares, channel by channel: over -20
    to 50 degrees the layer's stretch is visibly curved in the angle.

    Attributes:
        features: indices of the k selected features (k,); those from the number of channels on
            are squares.
        coefficients: coefficients of the features (k,) [deg].
        intercept: [deg].
    """

    features: NDArray[np.int64]
    coefficients: NDArray[np.float64]
    intercept: float

    @classmethod
    def fit(
        cls,
        difference: ArrayLike,
        angle_deg: ArrayLike,
        groups: ArrayLike,
        seed: int = 0,
        *,
        squares: bool = True,
    ) -> "BendAngle":
        """Feature selection and least-squares fit, as in the paper.

        The k features of the largest F-statistic are selected (SelectKBest). The paper does not
        give k: k minimises the mean squared error of five-fold cross-validation. The frames of one
        group stay in one fold, unless there are fewer groups than folds.

        Args:
            difference: dV from the static reference (n, measurements), dimensionless.
            angle_deg: true bend angles (n,) [deg].
            groups: group of each frame (n,), its specimen.
            seed: seed of the folds, where frames are assigned one by one.
            squares: whether squares of dV may be selected too.

        Raises:
            DataError: for fewer than two frames per fold.
        """
        dV, angle, group = (np.asarray(array) for array in (difference, angle_deg, groups))
        if len(dV) < 2 * FOLDS:
            raise DataError(
                f"expected at least {2 * FOLDS} frames with a known bend angle and "
                f"no touch, got {len(dV)}; generate more bend frames"
            )
        features = _features(dV) if squares else dV
        error = np.mean([_errors(features, angle, *fold) for fold in _folds(group, seed)], axis=0)
        chosen = np.sort(_rank_features(features, angle)[: np.argmin(error) + 1])
        coefficients, intercept = _fit_least_squares(features[:, chosen], angle)
        return cls(chosen, coefficients, intercept)

    def apply(self, difference: ArrayLike) -> NDArray[np.float64]:
        """Angles (...) [deg] of dV from the static reference (..., measurements)."""
        dV = np.asarray(difference, dtype=float)
        angle: NDArray[np.float64] = (
            _features(dV)[..., self.features] @ self.coefficients + self.intercept
        )
        return angle

    def times(self, factor: float) -> "BendAngle":
        """The regression with all angles multiplied by `factor`."""
        return BendAngle(self.features, factor * self.coefficients, factor * self.intercept)


def _features(dV: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([dV, dV**2], axis=-1)


def _folds(group: NDArray[np.generic], seed: int) -> Iterator[tuple[Frames, Frames]]:
    """Frames to fit to, and held out; whole groups where there are enough, else drawn ones."""
    selection = require("sklearn.model_selection", "training")
    folds: Iterator[tuple[Frames, Frames]]
    if len(np.unique(group)) < FOLDS:
        folds = selection.KFold(FOLDS, shuffle=True, random_state=seed).split(group)
    else:
        folds = selection.GroupKFold(FOLDS).split(group, groups=group)
    return folds


def _rank_features(features: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of the features by falling F-statistic, that is, squared correlation (features,)."""
    moved, turned = features - features.mean(axis=0), angle - angle.mean()
    variance = np.einsum("nk,nk->k", moved, moved)
    explained = (moved.T @ turned) ** 2 / np.where(variance > 0.0, variance, np.inf)
    return np.argsort(explained, kind="stable")[::-1].astype(np.int64)


def _fit_least_squares(
    features: NDArray[np.float64], angle: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Coefficients (features,) and intercept of the least-squares fit of least norm."""
    middle, mean = features.mean(axis=0), float(angle.mean())
    coefficients = np.linalg.lstsq(features - middle, angle - mean, _CUT)[0]
    return coefficients, mean - float(middle @ coefficients)


def _errors(
    features: NDArray[np.float64], angle: NDArray[np.float64], fitted: Frames, held_out: Frames
) -> NDArray[np.float64]:
    """Mean squared error [deg2] of the held-out frames for 1, 2, ... selected features.

    The ranking uses the fitted frames only and serves all numbers of features. All fits share one
    QR decomposition, and are of least norm.
    """
    ranked = _rank_features(features[fitted], angle[fitted])
    training, others = features[fitted][:, ranked], features[held_out][:, ranked]
    middle, mean = training.mean(axis=0), angle[fitted].mean()
    Q, R = np.linalg.qr(training - middle)
    turned, others = Q.T @ (angle[fitted] - mean), others - middle
    fits = (np.linalg.lstsq(R[:, :k], turned, _CUT)[0] for k in range(1, len(ranked) + 1))
    predictions = np.array([mean + others[:, : len(fit)] @ fit for fit in fits])
    errors: NDArray[np.float64] = np.mean((predictions - angle[held_out]) ** 2, axis=1)
    return errors
