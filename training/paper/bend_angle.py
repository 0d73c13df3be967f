"""Bend angle by univariate feature selection and linear regression."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError
from eitskin.extras import require

FOLDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class BendAngle:
    """Linear regression of the bend angle on selected features of dV.

    The features are dV, as in the paper, and optionally its squares, channel by channel: over -20
    to 50 degrees the layer's stretch is visibly curved in the angle.

    Attributes:
        features: indices of the k selected features (k,); those from the number of channels on
            are squares.
        coefficients: of the features (k,) [deg].
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
        require("sklearn", "training")
        from sklearn.linear_model import LinearRegression
        from sklearn.model_selection import GroupKFold, KFold

        dV, angle, group = (np.asarray(array) for array in (difference, angle_deg, groups))
        if len(dV) < 2 * FOLDS:
            raise DataError(
                f"expected at least {2 * FOLDS} frames with a known bend angle and "
                f"no touch, got {len(dV)}; generate more bend frames"
            )
        by_group = len(np.unique(group)) >= FOLDS
        folds = GroupKFold(FOLDS) if by_group else KFold(FOLDS, shuffle=True, random_state=seed)
        features = _features(dV) if squares else dV
        splits = folds.split(features, angle, group if by_group else None)
        error = np.mean([_errors(features, angle, *split) for split in splits], axis=0)
        chosen = np.sort(_ranked(features, angle)[: np.argmin(error) + 1])
        regression = LinearRegression().fit(features[:, chosen], angle)
        return cls(chosen, regression.coef_.astype(float), float(regression.intercept_))

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

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Trained arrays of the stage, as `from_arrays` takes them."""
        return {
            "features": self.features,
            "coefficients": self.coefficients,
            "intercept": np.array(self.intercept),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "BendAngle":
        """The stage with the trained `arrays`."""
        return cls(
            arrays["features"].astype(np.int64),
            arrays["coefficients"].astype(float),
            float(arrays["intercept"].astype(float)),
        )


def _features(dV: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([dV, dV**2], axis=-1)


def _ranked(features: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of the features by falling F-statistic (features,)."""
    from sklearn.feature_selection import f_regression

    statistic, _ = f_regression(features, angle)
    return np.argsort(statistic, kind="stable")[::-1].astype(np.int64)


def _errors(
    features: NDArray[np.float64],
    angle: NDArray[np.float64],
    training: NDArray[np.int64],
    held_out: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Mean squared error [deg2] of the held-out frames for 1, 2, ... selected features.

    The ranking uses the training frames only and serves all numbers of features; scikit-learn's
    GridSearchCV gives the same errors, but ranks anew for each number.
    """
    from sklearn.linear_model import LinearRegression

    ranked = _ranked(features[training], angle[training])
    errors = []
    for k in range(1, len(ranked) + 1):
        chosen = features[:, np.sort(ranked[:k])]
        regression = LinearRegression().fit(chosen[training], angle[training])
        errors.append(np.mean((regression.predict(chosen[held_out]) - angle[held_out]) ** 2))
    return np.array(errors)
