"""Bend angle by univariate feature selection and linear regression."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.geometry import DataError
from eitskin.training.method.stored_fields import StoredFields

FOLDS = 5
_CUT = float(np.finfo(float).eps)  # singular value, over the largest, that counts as zero
_DEPENDENT = 1e-9  # part of a feature, over all of it, that others leave where it depends on them


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
            seed: of the folds, where frames are assigned one by one.
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
        error = np.mean([_errors(features, angle, out) for out in _folds(group, seed)], axis=0)
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


def _folds(group: NDArray[np.generic], seed: int) -> list[NDArray[np.bool_]]:
    """Frames held out in each fold, (n,); whole groups where there are enough, else drawn ones.

    The largest groups are dealt out first, each to the fold that has the fewest frames by then.
    """
    _, number, sizes = np.unique(group, return_inverse=True, return_counts=True)
    if len(sizes) >= FOLDS:
        fold_of, filled = np.empty(len(sizes), np.int64), np.zeros(FOLDS, np.int64)
        for each in np.argsort(sizes)[::-1]:
            fold_of[each] = np.argmin(filled)
            filled[fold_of[each]] += sizes[each]
        fold = fold_of[number]
    else:
        drawn = np.random.RandomState(seed).permutation(len(group))
        fold = np.empty(len(group), np.int64)
        for k, part in enumerate(np.array_split(drawn, FOLDS)):
            fold[part] = k
    return [fold == k for k in range(FOLDS)]


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
    features: NDArray[np.float64], angle: NDArray[np.float64], held_out: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Mean squared error [deg2] of the held-out frames for 1, 2, ... selected features.

    The ranking uses the training frames only and serves all numbers of features. All fits share
    one QR decomposition: with X = Q R, a fit to the first k features adds to that to k - 1 the
    k-th column of X R^-1 times the k-th entry of Q^T y.
    """
    ranked = _rank_features(features[~held_out], angle[~held_out])
    training, others = features[~held_out][:, ranked], features[held_out][:, ranked]
    middle, mean = training.mean(axis=0), angle[~held_out].mean()
    others, targets = others - middle, angle[held_out] - mean
    Q, R = np.linalg.qr(training - middle)
    turned = Q.T @ (angle[~held_out] - mean)
    apart = np.abs(np.diag(R)) > _DEPENDENT * np.linalg.norm(R, axis=0)[: len(R)]
    rank = len(R) if apart.all() else int(np.argmin(apart))
    directions = np.linalg.solve(R[:rank, :rank].T, others[:, :rank].T)
    predictions = list(np.cumsum(directions * turned[:rank, None], axis=0))
    # Dependent features, and more of them than frames, have fits of least norm.
    for k in range(rank + 1, len(ranked) + 1):
        predictions.append(others[:, :k] @ np.linalg.lstsq(R[:, :k], turned, _CUT)[0])
    errors: NDArray[np.float64] = np.mean((np.array(predictions) - targets) ** 2, axis=1)
    return errors
