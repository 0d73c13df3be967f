"""Bend angle from dV: selected features and a linear regression."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from eitskin.errors import DataError
from eitskin.extras import require

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

        The k features of the largest F-statistic and a linear regression, as in the paper, which
        does not give k: it has the smallest squared error in five-fold cross-validation. Frames of
        one group (n,), a specimen, stay in one fold, unless there are fewer groups than folds.

        Args:
            difference: dV.
            angle_deg: the truth.
            groups: of the frames.
            seed: of the folds, where frames are dealt out one by one.
            squares: whether squares of dV may be selected too.
        """
        require("sklearn", "training")
        from sklearn.linear_model import LinearRegression
        from sklearn.model_selection import GroupKFold, KFold

        dV, angle, group = (np.asarray(array) for array in (difference, angle_deg, groups))
        if len(dV) < 2 * FOLDS:
            raise DataError(
                f"fitting the bend angle needs at least {2 * FOLDS} frames with a known angle and "
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


def _ranked(features: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.int64]:
    """Numbers of the features, the one that goes best with the angle first."""
    from sklearn.feature_selection import f_regression

    statistic, _ = f_regression(features, angle)
    return np.argsort(statistic, kind="stable")[::-1].astype(np.int64)


def _errors(
    features: NDArray[np.float64],
    angle: NDArray[np.float64],
    lessons: NDArray[np.int64],
    held_out: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Squared error of the frames held out by the number of features, from one on.

    The ranking is that of the lessons alone, and one for all numbers of features; scikit-learn's
    GridSearchCV finds the same, but makes it anew for each.
    """
    from sklearn.linear_model import LinearRegression

    ranked = _ranked(features[lessons], angle[lessons])
    errors = []
    for k in range(1, len(ranked) + 1):
        chosen = features[:, np.sort(ranked[:k])]
        regression = LinearRegression().fit(chosen[lessons], angle[lessons])
        errors.append(np.mean((regression.predict(chosen[held_out]) - angle[held_out]) ** 2))
    return np.array(errors)
