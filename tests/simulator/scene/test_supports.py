"""Scenes on supports: which are refused, and what stays the same."""

import dataclasses

import numpy as np
import pytest

from eitskin.config import parse_toml, to_toml
from eitskin.errors import ConfigurationError
from eitskin.geometry import (
    Bend,
    Clamp,
    Free,
    Hinge,
    Plates,
    Rigid,
    SensorDesign,
    Substrate,
    Twist,
)
from eitskin.geometry.deformation.fixtures import FreeArc
from eitskin.simulator import Scene, Simulator, Touch

TOUCH = Touch(0.020, 0.030, 8.0)


@pytest.mark.parametrize("support", [None, Rigid(), Plates(0.03), Substrate(0.01, 5e3), Free()])
def test_a_scene_keeps_its_support_in_its_file(support) -> None:
    scene = Scene(Bend(10.0), (TOUCH,), support=support)
    assert parse_toml(Scene, to_toml(scene)) == scene


def test_support_changes_nothing_where_nothing_is_pressed_or_bent(sim) -> None:
    flat = sim.measure(Scene()).impedance
    for support in (Rigid(), Plates(), Substrate(0.01, 5e3), Free()):
        assert np.array_equal(sim.measure(Scene(support=support)).impedance, flat)


def test_plates_bend_by_the_bottom_face(sim) -> None:
    flat, both, below = (
        sim.measure(scene).impedance.real
        for scene in (Scene(), Scene(Bend(20.0)), Scene(Bend(20.0), support=Plates()))
    )
    held = Simulator(sim.design, "fast", Clamp(faces="bottom")).measure(Scene(Bend(20.0)))
    assert np.array_equal(held.impedance.real, below)
    assert 0.05 < np.linalg.norm(below - both) / np.linalg.norm(both - flat) < 0.15


def test_the_support_of_a_scene_takes_the_place_of_the_design() -> None:
    free = dataclasses.replace(SensorDesign.reference(), support=Free())
    on_free = Simulator(free, "fast")
    with pytest.raises(ConfigurationError, match="free membrane"):
        on_free.check_scene(Scene(Bend(5.0)))
    on_free.check_scene(Scene(Bend(5.0), support=Rigid()))
    assert on_free.design_on_support(Scene()) == free
    assert on_free.design_on_support(Scene(support=Rigid())) == SensorDesign.reference()


@pytest.mark.parametrize(
    ("scene", "fixture", "message"),
    [
        (Scene(Bend(5.0), support=Free()), None, "neither bent, rolled nor twisted"),
        (Scene(twist=Twist(5.0), support=Free()), None, "neither bent, rolled nor twisted"),
        (Scene(Bend(5.0), support=Plates(0.03)), None, "0.03 m apart, .* fixture 0.04 m"),
        (Scene(Bend(5.0), support=Plates()), FreeArc(0.1), "needs the clamp of the plates"),
        (Scene(support=Plates(0.2)), None, "length of 0.15 m, got 0.2 m"),
    ],
)
def test_what_a_support_does_not_allow_is_refused(scene, fixture, message) -> None:
    made = Simulator(SensorDesign.reference(), "fast", fixture=fixture)
    with pytest.raises(ConfigurationError, match=message):
        made.measure(scene)


def test_plates_as_far_apart_as_those_of_the_fixture_may_be_bent() -> None:
    made = Simulator(SensorDesign.reference(), "fast", fixture=Hinge(span=0.03))
    made.check_scene(Scene(Bend(5.0), support=Plates(0.03)))


@pytest.mark.parametrize(("angle", "x", "force"), [(55.0, 0.02, 8.0), (5.0, 0.075, 8.0)])
def test_presses_on_plates_beyond_their_tables_are_solved_or_refused(angle, x, force) -> None:
    scene = Scene(Bend(angle), (Touch(x, 0.030, force),), support=Plates())
    assert Simulator(SensorDesign.reference(), "fast").solves_presses(scene)
    tabulated = Simulator(SensorDesign.reference(), "fast", touch_model="tabulated")
    with pytest.raises(ConfigurationError, match="touches on plates are tabulated from -20 to 50"):
        tabulated.presses(scene)


def test_tables_of_presses_are_refused_on_a_membrane() -> None:
    tabulated = Simulator(SensorDesign.reference(), "fast", touch_model="tabulated")
    scene = Scene(touches=(TOUCH,), support=Free())
    with pytest.raises(ConfigurationError, match=r"got a rectangle on Free\(\); leave"):
        tabulated.presses(scene)
    tabulated.check_scene(dataclasses.replace(scene, touches=()))
    tabulated.check_scene(dataclasses.replace(scene, support=None))


def test_presses_on_the_plates_of_the_reference_ship() -> None:
    """Far from the gap they are those on a rigid base; bent they turn with their plate."""
    sim = Simulator(SensorDesign.reference(), "coarse")
    touch = Touch(0.012, 0.030, 6.0)
    scene = Scene(Bend(30.0), (touch,), support=Plates())
    assert not sim.solves_presses(scene)
    (held,), (rigid,) = sim.presses(scene), sim.presses(Scene(touches=(touch,)))
    assert held.depth == pytest.approx(rigid.depth, rel=0.02)
    under = np.array([0.012, 0.030, 0.005])
    both = sim.deformation(scene).positions(under) - sim.deformation(
        Scene(scene.bend, support=Plates())
    ).positions(under)
    flat = sim.deformation(Scene(touches=(touch,))).positions(under) - under
    assert np.linalg.norm(both) == pytest.approx(np.linalg.norm(flat), rel=0.05)
    assert np.degrees(np.arctan2(both[0], -both[2])) == pytest.approx(15.0, abs=2.0)
