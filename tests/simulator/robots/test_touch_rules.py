"""Points of contact as touches: merged where indenters overlap, within the tables' limits."""

import math
from itertools import combinations

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Cylinder, Scene, Simulator, Sphere, Touch
from eitskin.simulator.robots.touch_table import TouchRules, merged

REFERENCE = SensorDesign.reference()
OUTLINE = REFERENCE.outline


def test_points_of_one_body_are_one_touch_at_the_centre_of_force():
    points = [Touch(0.05, 0.02, 1.0), Touch(0.056, 0.02, 3.0), Touch(0.05, 0.026, 2.0)]
    (touch,) = TouchRules().applied(points, OUTLINE)
    assert touch.force == pytest.approx(6.0)
    assert (touch.x, touch.y) == (pytest.approx(0.053), pytest.approx(0.022))


def test_touches_that_do_not_overlap_stay_apart_strongest_first():
    points = [Touch(0.03, 0.03, 2.0), Touch(0.0451, 0.03, 4.0), Touch(0.1, 0.03, 3.0)]
    assert [each.force for each in TouchRules().applied(points, OUTLINE)] == [4.0, 3.0, 2.0]


def test_merging_goes_on_until_no_indenters_overlap_and_keeps_force_and_moment():
    rng = np.random.default_rng(3)
    points = [
        Touch(0.15 * rng.random(), 0.06 * rng.random(), 0.1 + rng.random()) for _ in range(25)
    ]
    found = merged(points)
    assert 1 < len(found) < 25
    for one, other in combinations(found, 2):
        assert math.dist((one.x, one.y), (other.x, other.y)) >= 0.015
    for weigh in (lambda t: t.force, lambda t: t.force * t.x, lambda t: t.force * t.y):
        assert sum(map(weigh, found)) == pytest.approx(sum(map(weigh, points)))
    Scene(touches=tuple(found))


def test_the_strongest_gives_the_indenter_and_radii_decide_what_overlaps():
    small, large = Touch(0.05, 0.03, 1.0, Sphere(0.003)), Touch(0.06, 0.03, 2.0, Sphere(0.008))
    (both,) = merged([small, large])
    assert both.indenter == Sphere(0.008)
    assert len(merged([small, Touch(0.06, 0.03, 2.0, Sphere(0.0065))])) == 2


def test_limits_of_force_and_place():
    rules = TouchRules(least=0.5, most=8.0, margin=0.01)
    weak, strong = Touch(0.1, 0.03, 0.4), Touch(0.002, 0.058, 30.0)
    (touch,) = rules.applied([weak, strong], OUTLINE)
    assert (touch.x, touch.y, touch.force) == (0.01, pytest.approx(0.05), 8.0)
    for wrong in ({"least": 0.0}, {"least": 9.0, "most": 8.0}, {"margin": -1.0}):
        with pytest.raises(ConfigurationError, match="expected"):
            TouchRules(**wrong)


@pytest.mark.slow
def test_whatever_presses_the_reference_sensor_can_be_simulated():
    """The strongest touches, alone and side by side, in corners, at rims and in the middle."""
    rules, simulator = TouchRules(), Simulator(REFERENCE, "coarse")
    corners = [(0.0, 0.0), (0.15, 0.06), (0.075, 0.0), (0.0, 0.03), (0.075, 0.03), (0.003, 0.057)]
    scenes = []
    for x, y in corners:
        beside = max(x, 0.005) + 0.0151 if x < 0.1 else 0.145 - 0.0151
        for points in ([(x, y)], [(x, y), (beside, y)]):
            touches = rules.applied([Touch(*each, 99.0) for each in points], OUTLINE)
            assert len(touches) == len(points)
            scenes.append(Scene(touches=touches))
    signals = simulator.measure_all([Scene(), *scenes])
    assert np.abs(signals[1:] / signals[0] - 1.0).max(axis=1).min() > 1e-4
    assert {touch.indenter for scene in scenes for touch in scene.touches} == {Cylinder()}
