"""The bend angle: which channels it is learned from, how many, and from whom."""

import numpy as np
import pytest

from eitskin.errors import DataError
from eitskin.training.paper.bend_angle import BendAngle


def bends(count=200, seed=0):
    """Two of six channels follow the angle; the others are noise."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-20, 50, count)
    dV = rng.normal(size=(count, 6)) * 1e-4
    dV[:, 1] += 1e-3 * angle
    dV[:, 4] -= 2e-3 * angle
    return dV, angle


def test_bend_angle_follows_a_curved_signal():
    """Two degrees of curvature over the range; the paper's lines miss by one."""
    angle = np.linspace(-20.0, 50.0, 100)
    dV = np.outer(angle - 0.002 * angle**2, [1e-3, 2e-3])
    stage = BendAngle.fit(dV, angle, np.zeros(100))
    assert np.abs(stage.apply(dV) - angle).max() < 0.4
    stage = BendAngle.fit(dV, angle, np.zeros(100), squares=False)
    assert set(stage.features) <= {0, 1}
    line = np.polynomial.Polynomial.fit(dV[:, 0], angle, 1)
    np.testing.assert_allclose(stage.apply(dV), line(dV[:, 0]), atol=1e-9)


def test_number_of_channels_is_chosen_on_specimens_left_out():
    """Channels that tell specimens apart, not angles, help only on specimens seen before."""
    rng = np.random.default_rng(2)
    specimen = np.repeat(np.arange(10), 20)
    angle = np.repeat(rng.uniform(-20, 50, 10), 20) + rng.normal(size=200)
    telling = np.eye(10)[specimen]
    dV = np.column_stack([angle + rng.normal(size=200) * 4, telling])
    grouped = BendAngle.fit(dV, angle, specimen)
    assert set(grouped.features) <= {0, 11}  # the first channel and its square
    assert len(BendAngle.fit(dV, angle, np.zeros(200)).features) > 5


@pytest.mark.parametrize(("specimens", "count"), [(1, 200), (7, 200), (9, 53), (1, 11), (6, 13)])
def test_bend_angle_is_what_a_search_over_a_grid_finds(specimens, count):
    """scikit-learn's own search, also where there are more features than frames of a fold."""
    from sklearn.feature_selection import SelectKBest, f_regression
    from sklearn.linear_model import LinearRegression
    from sklearn.model_selection import GridSearchCV, GroupKFold, KFold
    from sklearn.pipeline import make_pipeline

    dV, angle = bends(count, seed=5)
    dV = np.concatenate([dV, 0.5 * dV[::-1]], axis=1) if count < 20 else dV
    specimen = (np.arange(count) ** 2 // 5 if specimens == 9 else np.arange(count)) % specimens
    stage = BendAngle.fit(dV, angle, specimen, seed=3, squares=False)
    folds = KFold(5, shuffle=True, random_state=3) if specimens == 1 else GroupKFold(5)
    search = GridSearchCV(
        make_pipeline(SelectKBest(f_regression), LinearRegression()),
        {"selectkbest__k": range(1, dV.shape[1] + 1)},
        scoring="neg_mean_squared_error",
        cv=folds,
    ).fit(dV, angle, groups=None if specimens == 1 else specimen)
    selection, regression = (step for _, step in search.best_estimator_.steps)
    np.testing.assert_array_equal(stage.features, np.flatnonzero(selection.get_support()))
    np.testing.assert_allclose(stage.coefficients, regression.coef_, rtol=1e-9)
    assert stage.intercept == pytest.approx(regression.intercept_, rel=1e-9)


def test_bend_angle_survives_its_arrays_and_refuses_too_few():
    dV, angle = bends()
    stage = BendAngle.fit(dV, angle, np.zeros(len(angle)))
    again = BendAngle.from_arrays(stage.arrays())
    np.testing.assert_array_equal(again.apply(dV), stage.apply(dV))
    assert again.apply(dV[0]).shape == ()
    with pytest.raises(DataError, match="at least 10 frames"):
        BendAngle.fit(dV[:5], angle[:5], np.zeros(5))
