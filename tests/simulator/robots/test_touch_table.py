"""Contacts of robots as touches, and the table of touches, beside the function it tabulates."""

import math
import types
from itertools import combinations

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Rectangle
from eitskin.simulator import Cylinder, Footprint, Scene, Sphere, Touch
from eitskin.simulator.robots.mujoco_skin import (
    TouchRules,
    TouchTable,
    merge_overlapping,
    touch_of_face,
)

GEL, OUTLINE, RULES = Rectangle(0.15, 0.06), Rectangle(0.1, 0.05), TouchRules()
FLAT = np.array([400.0 + 3.0j, 700.0 - 2.0j, 550.0])


# Rules


def test_touches_merge_where_they_overlap_within_limits_of_force_and_place():
    points = [Touch(0.03, 0.03, 2.0), Touch(0.0451, 0.03, 4.0), Touch(0.1, 0.03, 3.0)]
    assert [each.force for each in RULES.apply(points, GEL)] == [4.0, 3.0, 2.0]
    rng = np.random.default_rng(3)
    points = [
        Touch(0.15 * rng.random(), 0.06 * rng.random(), 0.1 + rng.random()) for _ in range(25)
    ]
    found = merge_overlapping(points)
    assert 1 < len(found) < 25
    for one, other in combinations(found, 2):
        assert math.dist((one.x, one.y), (other.x, other.y)) >= 0.015
    for weigh in (lambda t: t.force, lambda t: t.force * t.x, lambda t: t.force * t.y):
        assert sum(map(weigh, found)) == pytest.approx(sum(map(weigh, points)))
    Scene(touches=tuple(found))
    small, large = Touch(0.05, 0.03, 1.0, Sphere(0.003)), Touch(0.06, 0.03, 2.0, Sphere(0.008))
    (both,) = merge_overlapping([small, large])
    assert both.indenter == Sphere(0.008)
    assert len(merge_overlapping([small, Touch(0.06, 0.03, 2.0, Sphere(0.0065))])) == 2
    rules = TouchRules(least=0.5, most=8.0, margin=0.01)
    weak, strong = Touch(0.1, 0.03, 0.4), Touch(0.002, 0.058, 30.0)
    (touch,) = rules.apply([weak, strong], GEL)
    assert (touch.x, touch.y, touch.force) == (0.01, pytest.approx(0.05), 8.0)
    for wrong in ({"least": 0.0}, {"least": 9.0, "most": 8.0}, {"margin": -1.0}):
        with pytest.raises(ConfigurationError, match="expected"):
            TouchRules(**wrong)


@pytest.mark.parametrize("sides", [(0.04, 0.03), (0.06, 0.01), (0.05, 0.0)])
def test_a_face_is_one_touch_with_its_shape_force_and_moment(sides) -> None:
    turn = np.array([[math.cos(0.4), math.sin(0.4)], [-math.sin(0.4), math.cos(0.4)]])
    rim = 0.5 * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * sides
    forces = np.array([2.0, 1.8, 2.1, 1.9])
    contacts = np.column_stack([rim @ turn + (0.07, 0.03), forces])
    for indenter in (Cylinder(), None):
        touch = touch_of_face(contacts, indenter)
        assert touch.force == pytest.approx(forces.sum())
        pressed = forces @ contacts[:, :2] / forces.sum()
        assert (touch.x, touch.y) == pytest.approx(tuple(pressed), abs=1e-9)
        corners = (touch.indenter.outline + pressed - (0.07, 0.03)) @ turn.T
        # An edge is 2 mm wide; corners are rounded to half a millimetre.
        found = 2.0 * np.abs(corners).max(axis=0)
        assert found == pytest.approx(np.maximum(sides, 2e-3), abs=1.5e-3)
    rim = 0.004 * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    small = np.column_stack([rim, np.ones(4)])
    assert touch_of_face(small, Cylinder()).indenter == Cylinder()
    assert isinstance(touch_of_face(small, None).indenter, Footprint)
    assert touch_of_face(small[:1], None).indenter == Cylinder()


# Table


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))


def changed(touch):
    """Smooth change of the logarithms by one touch, (3,)."""
    u, v, f = touch.x / 0.1, touch.y / 0.05, touch.force / RULES.most
    wave = np.array([np.sin(3 * u + v), np.cos(2 * v) * u, 0.5j * np.cos(u * v)])
    return 0.05 * f * (1.0 + 0.3 * f) * wave


class SmoothSimulator:
    """Simulator of three measurements; counts its scenes."""

    design = mechanics = touch_model = grid = None

    def __init__(self):
        self.solved = 0

    def measure_all(self, scenes, **_):
        self.solved += len(scenes)
        return np.array([FLAT * np.exp(sum(map(changed, each.touches))) for each in scenes])


def test_tables_are_solved_once_for_what_they_depend_on_and_interpolated():
    simulator = SmoothSimulator()

    def solved(indenter=Cylinder(), rules=RULES):  # noqa: B008
        return TouchTable.load_or_solve(simulator, OUTLINE, indenter, rules, spacing=0.005)

    first, scenes = solved(), simulator.solved
    assert scenes == 1 + 19 * 9 * 6
    again = solved()
    assert simulator.solved == scenes + 1  # the untouched one, by which the table is known
    touches = [Touch(0.033, 0.021, 5.0)]
    assert np.array_equal(first.factors(touches), again.factors(touches))
    solved(Cylinder(0.005))
    solved(rules=TouchRules(most=6.0))
    simulator.design = types.SimpleNamespace(thickness=0.004)
    solved()
    assert simulator.solved == 4 * scenes + 1
    table = TouchTable.load_or_solve(SmoothSimulator(), OUTLINE, Cylinder(), RULES, spacing=0.005)
    shares = np.random.default_rng(5).random((20, 3))
    touches = [
        Touch(0.005 + 0.09 * x, 0.005 + 0.04 * y, RULES.most * (0.01 + 0.99 * force))
        for x, y, force in shares
    ]
    expected = [np.exp(changed(each)) for each in touches]
    np.testing.assert_allclose(table.factors(touches), expected, rtol=0, atol=2e-6)
