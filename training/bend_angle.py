"""Bend angle from dV: selected features and a linear regression."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.geometry import DataError
from eitskin.geometry.optional import require

FOLDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class BendAngle:
    """Linear regression on the features that go best with the angle.

    The features are dV, as in the paper, and where asked its square, channel by channel: over -20
    to 50 degrees the layer's stretch is visibly curved in the angle.

    Attributes:
        features: indices of the selected features (k,); from the number of channels on, squares.
        coefficients: degrees per unit of the feature (k,).
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
        """Fit to dV from the static reference (n, measurements) and angles (n,) [deg].

        scikit-learn's SelectKBest(f_regression) and LinearRegression, as in the paper, which does
        not give k: it has the smallest squared error in five-fold cross-validation. Frames of one
        group (n,), a specimen, stay in one fold, unless there are fewer groups than folds.

        Args:
            difference: dV.
            angle_deg: the truth.
            groups: of the frames.
            seed: of the folds, where frames are dealt out one by one.
            squares: whether squares of dV may be selected too.
        """
        require("sklearn", "training")
        from sklearn.feature_selection import SelectKBest, f_regression
        from sklearn.linear_model import LinearRegression
        from sklearn.model_selection import GridSearchCV, GroupKFold, KFold
        from sklearn.pipeline import make_pipeline

        dV, angle, group = (np.asarray(array) for array in (difference, angle_deg, groups))
        if len(dV) < 2 * FOLDS:
            raise DataError(
                f"fitting the bend angle needs at least {2 * FOLDS} frames with a known angle and "
                f"no touch, got {len(dV)}; generate more bend frames"
            )
        by_group = len(np.unique(group)) >= FOLDS
        folds = GroupKFold(FOLDS) if by_group else KFold(FOLDS, shuffle=True, random_state=seed)
        features = _features(dV) if squares else dV
        search = GridSearchCV(
            make_pipeline(SelectKBest(f_regression), LinearRegression()),
            {"selectkbest__k": list(range(1, features.shape[1] + 1))},
            scoring="neg_mean_squared_error",
            cv=folds,
        ).fit(features, angle, groups=group if by_group else None)
        selection, regression = (step for _, step in search.best_estimator_.steps)
        return cls(
            np.flatnonzero(selection.get_support()).astype(np.int64),
            regression.coef_.astype(float),
            float(regression.intercept_),
        )

    def apply(self, difference: ArrayLike) -> NDArray[np.float64]:
        """Angles (...) [deg] of dV from the static reference (..., measurements)."""
        dV = np.asarray(difference, dtype=float)
        angle: NDArray[np.float64] = (
            _features(dV)[..., self.features] @ self.coefficients + self.intercept
        )
        return angle

    def times(self, factor: float) -> "BendAngle":
        """The regression whose angles are `factor` times these."""
        return BendAngle(self.features, factor * self.coefficients, factor * self.intercept)

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """What `from_arrays` needs to make this stage again."""
        return {
            "features": self.features,
            "coefficients": self.coefficients,
            "intercept": np.array(self.intercept),
        }

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]]) -> "BendAngle":
        """The stage that `arrays` came from."""
        return cls(
            arrays["features"].astype(np.int64),
            arrays["coefficients"].astype(float),
            float(arrays["intercept"].astype(float)),
        )


def _features(dV: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([dV, dV**2], axis=-1)
