"""Cubic splines against those of scipy."""

import numpy as np
import pytest
from scipy.interpolate import BSpline, CubicSpline, NdBSpline, make_interp_spline

from eitskin.simulator.deformation.splines import CubicSplines, cubic_spline, sum_splines

X = np.array([0.0, 0.4, 0.7, 1.5, 1.9, 3.0, 3.2])
AT = np.random.default_rng(0).uniform(-0.5, 3.7, 200)
WITHIN = np.concatenate([X, np.clip(AT, 0.0, 3.2)])
ENDS = {
    "not-a-knot": ("not a knot", "not a knot"),
    ("natural", "clamped"): ("straight", "level"),
    ("clamped", "natural"): ("level", "straight"),
}


@pytest.mark.parametrize("count", [3, 4, 7])
@pytest.mark.parametrize("ends", ENDS)
def test_splines_through_values_are_those_of_scipy(count, ends):
    values = np.random.default_rng(1).normal(size=(count, 2, 3))
    theirs, spline = (
        CubicSpline(X[:count], values, bc_type=ends),
        cubic_spline(X[:count], values, ENDS[ends]),
    )
    assert spline(AT) == pytest.approx(theirs(AT), rel=1e-13, abs=1e-13)
    assert spline.slopes(AT) == pytest.approx(theirs(AT, 1), rel=1e-13, abs=1e-13)
    assert spline(0.6) == pytest.approx(theirs(0.6), rel=1e-13)


@pytest.mark.parametrize("rise", [lambda x: x**1.7 + 0.1 * np.sin(x), lambda x: 1.0 + 2.0 * x])
def test_a_rising_spline_has_each_value_once(rise):
    spline = cubic_spline(X, rise(X))
    for value in (*rise(X), *rise(WITHIN)):
        assert spline(spline.solve_rising(value)) == pytest.approx(value, rel=1e-13, abs=1e-15)


def test_b_splines_and_their_sums_are_those_of_scipy():
    along, across = CubicSplines(X), CubicSplines(X[:5])
    assert along.fit == pytest.approx(make_interp_spline(X, np.eye(7)).c, rel=1e-13, abs=1e-14)
    dense = BSpline(along.knots, np.eye(7), 3)(WITHIN)
    assert along.dense(WITHIN) == pytest.approx(dense, rel=1e-13, abs=1e-15)
    assert along.dense(np.array([-1.0, 9.0])) == pytest.approx(np.eye(7)[[0, -1]])
    coefficients = np.random.default_rng(2).normal(size=(7, 5, 2, 3))
    y, orders = np.linspace(0.0, 1.9, len(WITHIN)), ((0, 0), (1, 0), (0, 1))
    theirs = NdBSpline((along.knots, across.knots), coefficients, 3)
    expected = np.stack([theirs(np.stack([WITHIN, y], -1), nu=nu) for nu in orders], axis=1)
    sums = sum_splines((along, across), coefficients, WITHIN, y, orders)
    assert sums == pytest.approx(expected, rel=1e-12, abs=1e-12)
