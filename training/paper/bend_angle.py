"""Bend angle by univariate feature selection and linear regression."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.extras import require
from eitskin.geometry import DataError
from eitskin.training.method.stored_fields import StoredFields

FOLDS = 5
_CUT = float(np.finfo(float).eps)  # singular value, over the largest, that counts as zero

Frames = NDArray[np.int64]


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
