"""Touches of a scene: forces, depths, time, files, and what is said of them."""

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import (
    Bend,
    Clamp,
    Disc,
    Free,
    Hinge,
    Plates,
    Rigid,
    Roll,
    SensorDesign,
    Twist,
)
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import (
    Cylinder,
    Footprint,
    Mechanics,
    Profile,
    Scene,
    Simulator,
    Sphere,
    Touch,
)
from eitskin.simulator.deformation import touches as presses
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.deformation.touches import pressed_touches
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity
from eitskin.simulator.mechanics.viscoelasticity import Prony
from eitskin.simulator.scene.indenters import ScannedIndenter

DESIGN = SensorDesign.reference()
X, Y = 0.060, 0.030


def one(touch, mechanics=None):
    (found,) = pressed_touches(
        (touch,), PressedSensor(DESIGN, mechanics or Mechanics(), "tabulated")
    )
    return found


def test_a_press_tells_depth_contact_and_pressure() -> None:
    found = one(Touch(X, Y, 10.0))
    assert found.force == pytest.approx(10.0)
    assert 2e-3 < found.depth < 4e-3
    assert found.contact_radius == pytest.approx(0.0075, rel=0.05)
    assert found.mean_pressure == pytest.approx(10.0 / found.contact_area)
    assert found.peak_pressure > found.mean_pressure
    assert found.edge_distance == pytest.approx(0.030)
    assert math.isinf(found.neighbour_distance)
    assert found.caution == ""


def test_a_press_to_the_depth_of_a_force_is_that_press(sim) -> None:
    found = one(Touch(X, Y, 6.0))
    to_depth = Touch(X, Y, depth=found.depth)
    assert one(to_depth).force == pytest.approx(6.0, rel=3e-3)  # steps of sinking end at 1e-3
    frames = [sim.measure(Scene(touches=(t,))).impedance for t in (Touch(X, Y, 6.0), to_depth)]
    assert frames[0] == pytest.approx(frames[1], rel=2e-5)


def giving_way(monkeypatch, sunk):
    """A touch to a depth between plates, where the stack sinks by a function of a dent's depth."""

    def solved(*given):
        return SimpleNamespace(sunk=np.array([sunk(press.depth) for press in given[2]]))

    monkeypatch.setattr(presses, "solved_presses", solved)
    design = dataclasses.replace(DESIGN, support=Plates())

    def press(touch):
        (found,) = pressed_touches((touch,), PressedSensor(design, Mechanics()))
        return found

    return press


def test_an_indenter_that_sinks_with_its_stack_reaches_its_depth(monkeypatch) -> None:
    press = giving_way(monkeypatch, lambda depth: 9.0 * depth * (1.0 - 80.0 * depth))
    by_force = press(Touch(0.075, Y, 6.0))
    assert by_force.depth > 0.012  # as deep as the stack is thick
    assert by_force.signal_error is None
    assert "mm deep, where nothing was compared" in by_force.caution
    assert press(Touch(0.075, Y, 2.0)).signal_error == 0.10
    found = press(Touch(0.075, Y, depth=by_force.depth))
    assert found.depth == pytest.approx(by_force.depth, rel=1e-3)
    assert found.force == pytest.approx(6.0, rel=5e-3)


def test_a_released_indenter_had_sunk_with_its_stack(monkeypatch) -> None:
    touch = Touch(0.075, Y, depth=0.0056, held=10.0, released=5.0)
    fading = giving_way(monkeypatch, lambda depth: 6.0 * depth)(touch)
    unmoved = giving_way(monkeypatch, lambda _: 0.0)(dataclasses.replace(touch, depth=0.0008))
    assert fading.depth == pytest.approx(7.0 * unmoved.depth, rel=3e-3)


def test_depths_that_no_dent_reaches_are_refused(monkeypatch) -> None:
    press = giving_way(monkeypatch, lambda _: 0.010)
    with pytest.raises(ConfigurationError, match="prescribe forces"):
        press(Touch(0.075, Y, depth=0.002))


def test_presses_near_the_edge_or_each_other_say_so() -> None:
    assert "4.0 mm" in one(Touch(0.004, Y, 5.0)).caution
    near = (Touch(X, Y, 5.0), Touch(X + 0.016, Y, 5.0))
    for found in pressed_touches(near, PressedSensor(DESIGN, Mechanics())):
        assert found.neighbour_distance == pytest.approx(0.016)
        assert "16.0 mm from another" in found.caution


@pytest.mark.parametrize(
    ("y", "error"),
    [(0.0045, None), (0.0050, 0.04), (0.030, 0.04)],
)
def test_errors_of_the_signal_are_those_found_at_such_distances(y, error) -> None:
    assert one(Touch(X, y, 5.0)).signal_error == error
    for apart, compared in ((0.018, False), (0.021, True)):
        pair = (Touch(X, y, 5.0), Touch(X + apart, y, 5.0))
        expected = error if compared else None
        for found in pressed_touches(pair, PressedSensor(DESIGN, Mechanics())):
            assert found.signal_error == expected


@pytest.mark.slow
def test_presses_that_are_bent_afterwards_say_so(monkeypatch) -> None:
    unmoved = SimpleNamespace(sunk=np.zeros(1))
    monkeypatch.setattr(presses, "solved_presses", lambda *_: unmoved)
    touches, bend = (Touch(0.040, Y, 5.0),), Bend(5.0)
    for support, scene, error in (
        (Free(), Scene(touches=touches), 0.04),
        (Plates(), Scene(touches=touches), 0.05),
        (Plates(), Scene(bend, touches), 0.05),
        (Plates(), Scene(bend, (Touch(0.070, Y, 2.0),)), 0.10),
        (Plates(), Scene(bend, touches, twist=Twist(5.0)), None),
        (Plates(), Scene(bend, touches, roll=Roll(5.0)), None),
        (Rigid(), Scene(touches=touches), 0.04),
        (Rigid(), Scene(bend, touches), 0.15),
        (Rigid(), Scene(Bend(60.0), touches), None),
    ):
        sim = Simulator(dataclasses.replace(DESIGN, support=support), "coarse")
        (found,) = sim.presses(scene)
        assert found.signal_error == error
        assert ("bent" in found.caution) == (error is None)


def test_presses_on_outlines_that_were_never_compared_say_so(monkeypatch) -> None:
    unmoved = SimpleNamespace(sunk=np.zeros(1))
    monkeypatch.setattr(presses, "solved_presses", lambda *_: unmoved)
    disc = SensorDesign(Disc(0.04), 0.005, uniform(Disc(0.04), 8, 0.005))
    (found,) = pressed_touches((Touch(0.04, 0.04, 5.0),), PressedSensor(disc, Mechanics()))
    assert found.signal_error is None
    assert "outline" in found.caution


def test_indenters_are_not_inside_each_other() -> None:
    with pytest.raises(ConfigurationError, match=r"0\.01 m .*0\.015"):
        Scene(touches=(Touch(X, Y), Touch(X, Y + 0.010)))
    Scene(touches=(Touch(X, Y, held=1.0, released=1.0), Touch(X, Y + 0.010)))
    Scene(touches=(Touch(X, Y, 1.0, Sphere(0.004)), Touch(X, Y + 0.010, 1.0, Sphere(0.004))))


def test_presses_deeper_than_the_tables_are_refused(sim) -> None:
    near = Scene(touches=tuple(Touch(x, y, 38.0) for x in (0.02, 0.036) for y in (0.02, 0.036)))
    with pytest.raises(ConfigurationError, match=r"tabulated to a depth of 3\.84 mm"):
        sim.measure(near)


# Time


def held(**time):
    return one(Touch(X, Y, 5.0, **time))


def test_a_held_press_creeps_and_a_released_one_lingers() -> None:
    at_once, first = held(), held(held=0.0)
    assert first.depth == pytest.approx(at_once.depth)
    minute = held(held=60.0)
    assert minute.depth > 1.1 * at_once.depth
    assert minute.force == 5.0
    dents = [held(held=60.0, released=t).depth for t in (0.01, 10.0, 300.0)]
    assert minute.depth > 2 * dents[0]
    assert dents[0] > dents[1] > dents[2] > 0.0
    released = held(held=60.0, released=10.0)
    assert (released.force, released.contact_area, released.mean_pressure) == (0.0, 0.0, 0.0)


def test_a_press_held_at_a_depth_relaxes_and_keeps_its_dent() -> None:
    at_once = one(Touch(X, Y, depth=0.0015))
    minute = one(Touch(X, Y, depth=0.0015, held=60.0))
    assert minute.depth == pytest.approx(at_once.depth)
    assert 0.7 * at_once.force < minute.force < 0.9 * at_once.force
    released = one(Touch(X, Y, depth=0.0015, held=60.0, released=1.0))
    assert 0.0 < released.depth < 0.4 * at_once.depth


def test_materials_that_do_not_relax_forget_at_once() -> None:
    elastic = Mechanics(gel_relaxation=Prony(), encapsulation_relaxation=Prony())
    assert one(Touch(X, Y, 5.0, held=1e3), elastic).depth == pytest.approx(held().depth)
    gone = Touch(X, Y, 5.0, held=1e3, released=1e-3)
    assert one(gone, elastic).depth == 0.0
    sim = Simulator(DESIGN, resolution="fast", mechanics=elastic)
    flat = sim.measure(Scene()).impedance
    assert sim.measure(Scene(touches=(gone,))).impedance == pytest.approx(flat, rel=1e-9)


# Conductivity beyond geometry


def signal(mechanics, scene, fixture=None):
    sim = Simulator(DESIGN, resolution="fast", fixture=fixture, mechanics=mechanics)
    return sim.measure(scene).impedance.real / sim.measure(Scene()).impedance.real - 1


@pytest.mark.slow
def test_piezoresistivity_adds_to_what_geometry_does() -> None:
    scene = Scene(touches=(Touch(X, Y, 5.0),))
    none, some, twice = (
        signal(Mechanics(piezoresistivity=Piezoresistivity(pressure=k)), scene)
        for k in (0.0, 1e-8, 2e-8)
    )
    # Pressure lifts the conductivity: resistances fall, in proportion where that is little.
    assert np.all(some <= none + 1e-12)
    assert np.all(some[np.abs(none) > 1e-4] < none[np.abs(none) > 1e-4])
    assert twice - none == pytest.approx(2 * (some - none), rel=0.01, abs=1e-8)


def test_volume_changes_count_only_where_there_are_any() -> None:
    scene, soft = Scene(Bend(20.0)), Mechanics(piezoresistivity=Piezoresistivity(volume=2.0))
    for fixture, tolerance in ((Hinge(), 1e-10), (Clamp(), 1e-4)):  # J of a mesh is not quite one
        plain = signal(Mechanics(), scene, fixture)
        assert signal(soft, scene, fixture) == pytest.approx(plain, abs=tolerance)


def test_conductivities_must_stay_positive() -> None:
    mechanics = Mechanics(piezoresistivity=Piezoresistivity(pressure=-1e-3))
    with pytest.raises(ConfigurationError, match="must stay positive"):
        signal(mechanics, Scene(touches=(Touch(X, Y, 10.0),)))


# Footprints


def test_a_footprint_as_large_as_the_cylinder_is_that_cylinder(sim) -> None:
    flat = sim.measure(Scene()).impedance.real

    def change(*touch):
        return sim.measure(Scene(touches=(Touch(*touch),))).impedance.real / flat - 1.0

    disc = Footprint(0.015, 0.015, round=True)
    cylinder, punch = change(0.05, 0.02, 8.0), change(0.05, 0.02, 8.0, disc)
    assert np.linalg.norm(punch - cylinder) < 0.01 * np.linalg.norm(cylinder)
    rectangle = change(0.05, 0.02, 8.0, Footprint(0.016, 0.012, angle_deg=90.0))
    sides = ((-0.006, -0.008), (0.006, -0.008), (0.006, 0.008), (-0.006, 0.008))
    polygon = change(0.05, 0.02, 8.0, Footprint(corners=sides))
    assert np.linalg.norm(polygon - rectangle) < 0.01 * np.linalg.norm(rectangle)
    found = one(Touch(X, Y, 8.0, disc))
    pressed = one(Touch(X, Y, 8.0))
    assert found.depth == pytest.approx(pressed.depth, rel=5e-3)
    deep = one(Touch(X, Y, depth=found.depth, indenter=disc))
    assert deep.force == pytest.approx(8.0, rel=5e-3)


def test_footprints_are_convex_and_keep_apart_by_their_shapes() -> None:
    bar = Footprint(0.03, 0.006)
    Scene(touches=(Touch(X, 0.02, indenter=bar), Touch(X, 0.03, indenter=bar)))
    with pytest.raises(ConfigurationError, match="apart"):
        Scene(touches=(Touch(X, 0.02, indenter=bar), Touch(X + 0.02, 0.02, indenter=bar)))
    dented = ((0.0, 0.0), (0.02, 0.0), (0.005, 0.005), (0.0, 0.02))
    for wrong in ({}, {"length": 0.01}, {"corners": dented}, {"length": 0.01, "corners": dented}):
        with pytest.raises(ConfigurationError, match=r"footprint|radius"):
            Footprint(**wrong)


# Files


def test_scene_files_name_indenters(tmp_path) -> None:
    box = tmp_path / "scene.toml"
    box.write_text(
        "[bend]\nangle_deg = 30\n[[touches]]\nx = 0.05\ny = 0.02\nforce = 3\n"
        "indenter = { shape = 'sphere', radius = 0.01 }\n"
        "[[touches]]\nx = 0.1\ny = 0.02\ndepth = 0.001\nheld = 3.0\nindenter = { radius = 0.005 }\n"
        "[[touches]]\nx = 0.1\ny = 0.04\nindenter = { radii = [0, 0.004], heights = [0, 0.001] }\n"
        "[[touches]]\nx = 0.02\ny = 0.04\nindenter = { length = 0.02, width = 0.01 }\n"
    )
    expected = (
        Touch(0.05, 0.02, 3.0, Sphere(0.01)),
        Touch(0.1, 0.02, depth=0.001, held=3.0, indenter=Cylinder(0.005)),
        Touch(0.1, 0.04, indenter=Profile((0.0, 0.004), (0.0, 0.001))),
        Touch(0.02, 0.04, indenter=Footprint(0.02, 0.01)),
    )
    assert Scene.from_toml(box) == Scene(Bend(30.0), expected)


@pytest.fixture
def ball(tmp_path) -> Path:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(subdivisions=4, radius=7.5).export(path)
    return path


def test_a_scanned_ball_named_by_a_scene_file_is_a_sphere(ball) -> None:
    path, sphere = ball.with_suffix(".toml"), Sphere(0.0075)
    path.write_text(
        "[[touches]]\nx = 0.05\ny = 0.02\nindenter = { file = 'ball.stl', scale = 1e-3 }\n"
    )
    (touch,) = Scene.from_toml(path).touches
    assert touch.indenter == (scanned := ScannedIndenter(ball, 1e-3))
    r = np.linspace(0.0, 0.0065, 30)
    assert scanned.profile(r)[0] == pytest.approx(sphere.profile(r)[0], abs=4e-5)
    assert scanned.rims[1] == pytest.approx(0.0075, rel=0.01)


def test_bodies_that_are_not_round_are_refused(tmp_path) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "bar.stl"
    trimesh.creation.capsule(height=30.0, radius=5.0).apply_transform(
        trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0])
    ).export(path)
    with pytest.raises(ConfigurationError, match="upright"):
        ScannedIndenter(path, 1e-3)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"force": math.nan}, "force must be a positive number of N"),
        ({"depth": -1e-3}, "depth must be a positive number of m"),
        ({"force": 3.0, "depth": 1e-3}, "a force or a depth"),
        ({"held": -1.0}, "held"),
        ({"released": 1.0}, "needs held"),
    ],
)
def test_impossible_touches_are_refused(arguments, says) -> None:
    with pytest.raises(ConfigurationError, match=says):
        Touch(X, Y, **arguments)
    with pytest.raises(ConfigurationError, match=r"touch_model.*tabulated"):
        Simulator(DESIGN, touch_model="guess")
