"""Touches of a scene: forces, depths, time, files, and what is said of them."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import (
    Bend,
    Disc,
    Free,
    Hinge,
    Plates,
    Rectangle,
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
    Scene,
    Simulator,
    Sphere,
    Touch,
)
from eitskin.simulator.deformation import pressed_sensor
from eitskin.simulator.deformation.compared_presses import uncompared_properties
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.deformation.touches import pressed_touches, require_model
from eitskin.simulator.mechanics import stack_mesh
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.scene.indenters import ScannedIndenter

DESIGN = SensorDesign.reference()
X, Y = 0.060, 0.030


def one(touch, mechanics=None):
    (found,) = pressed_touches(
        (touch,), PressedSensor(DESIGN, mechanics or Mechanics(), "tabulated")
    )
    return found


@pytest.mark.slow
def test_a_press_tells_depth_contact_and_pressure_and_to_a_depth_is_that_of_its_force(sim):
    found = one(Touch(X, Y, 10.0))
    assert found.force == pytest.approx(10.0)
    assert 2e-3 < found.depth < 4e-3
    assert found.contact_radius == pytest.approx(0.0075, rel=0.012)
    assert found.mean_pressure == pytest.approx(10.0 / found.contact_area)
    assert found.peak_pressure > found.mean_pressure
    assert found.edge_distance == pytest.approx(0.030)
    assert math.isinf(found.neighbour_distance)
    assert found.caution == ""
    found = one(Touch(X, Y, 6.0))
    to_depth = Touch(X, Y, depth=found.depth)
    assert one(to_depth).force == pytest.approx(6.0, rel=3e-3)  # steps of sinking end at 1e-3
    frames = [sim.measure(Scene(touches=(t,))).impedance for t in (Touch(X, Y, 6.0), to_depth)]
    assert frames[0] == pytest.approx(frames[1], rel=2e-5)


def unmoved(sunk):
    """Correction of presses that only sink."""
    return SimpleNamespace(sunk=sunk, holding=np.zeros((len(sunk), 3)))


@pytest.fixture
def giving_way(monkeypatch):
    """A touch between plates, where the stack sinks by a function of a dent's depth."""
    design = dataclasses.replace(DESIGN, support=Plates())

    def press(sunk, **terms):
        def solve(_, pressed):
            return unmoved(np.array([sunk(press.depth) for press in pressed]))

        monkeypatch.setattr(PressedSensor, "solve", solve)
        touches = (Touch(0.075, Y, **terms),)
        (found,) = pressed_touches(touches, PressedSensor(design, Mechanics()))
        return found

    return press


def test_an_indenter_that_sinks_with_its_stack_reaches_its_depth(giving_way) -> None:
    def soft(depth):
        return 9.0 * depth * (1.0 - 80.0 * depth)

    by_force = giving_way(soft, force=6.0)
    assert by_force.depth > 0.012  # as deep as the stack is thick
    assert by_force.signal_error is None
    assert "than was measured" in by_force.caution
    assert giving_way(soft, force=2.0).signal_error == 0.10
    found = giving_way(soft, depth=by_force.depth)
    assert (found.depth, found.force) == pytest.approx((by_force.depth, 6.0), rel=5e-3)
    time = {"held": 10.0, "released": 5.0}
    fading = giving_way(lambda depth: 6.0 * depth, depth=0.0056, **time)
    level = giving_way(lambda _: 0.0, depth=0.0008, **time)
    assert fading.depth == pytest.approx(7.0 * level.depth, rel=3e-3)
    with pytest.raises(ConfigurationError, match="prescribe forces"):
        giving_way(lambda _: 0.010, depth=0.002)


@pytest.mark.parametrize(
    ("length", "places", "error", "words"),
    [
        (0.15, [(X, 0.0036)], 0.08, ""),
        (0.15, [(X, 0.0050)], 0.04, ""),
        (0.15, [(0.0055, 0.0055)], 0.08, ""),
        (0.15, [(X, Y), (X + 0.018, Y)], None, "18.0 mm from another"),
        (0.15, [(X, Y), (X + 0.021, Y)], 0.04, ""),
        (0.25, [(X, Y)], 0.04, ""),
    ],
)
def test_errors_of_the_signal_are_those_found_at_such_distances(
    length, places, error, words
) -> None:
    outline = Rectangle(length, 0.06)
    design = dataclasses.replace(DESIGN, outline=outline, electrodes=uniform(outline, 8))
    touches = tuple(Touch(*place, 5.0) for place in places)
    for found in pressed_touches(touches, PressedSensor(design, Mechanics())):
        assert found.signal_error == error
        assert words in found.caution
        apart = math.dist(*places) if len(places) > 1 else math.inf
        assert found.neighbour_distance == pytest.approx(apart)


DISC = SensorDesign(Disc(0.04), 0.005, uniform(Disc(0.04), 8, 0.005))


@pytest.mark.slow
def test_presses_that_are_bent_afterwards_say_so(monkeypatch) -> None:
    monkeypatch.setattr(PressedSensor, "solve", lambda *_: unmoved(np.zeros(1)))
    (found,) = pressed_touches((Touch(0.04, 0.04, 5.0),), PressedSensor(DISC, Mechanics()))
    assert found.signal_error is None
    assert "outline" in found.caution
    touches, bend = (Touch(0.040, Y, 5.0),), Bend(5.0)
    for support, scene, error in (
        (Free(), Scene(touches=touches), 0.04),
        (Plates(), Scene(touches=touches), 0.05),
        (Plates(), Scene(bend, touches), 0.05),
        (Plates(), Scene(bend, (Touch(0.070, Y, 2.0),)), 0.10),
        (Plates(), Scene(bend, (Touch(0.040, 0.0045, 2.0),)), 0.08),
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


# Time


def held(**time):
    return one(Touch(X, Y, 5.0, **time))


def test_held_presses_creep_at_a_force_and_relax_at_a_depth():
    at_once, minute = held(), held(held=60.0)
    assert minute.depth > 1.1 * at_once.depth
    assert minute.force == 5.0
    dents = [held(held=60.0, released=t).depth for t in (0.01, 10.0, 300.0)]
    assert minute.depth > 2 * dents[0]
    assert dents[0] > dents[1] > dents[2] > 0.0
    assert held(held=60.0, released=1e5).depth == 0.0
    released = held(held=60.0, released=10.0)
    assert (released.force, released.contact_area, released.mean_pressure) == (0.0, 0.0, 0.0)
    at_once = one(Touch(X, Y, depth=0.0015))
    minute = one(Touch(X, Y, depth=0.0015, held=60.0))
    assert minute.depth == pytest.approx(at_once.depth)
    assert 0.7 * at_once.force < minute.force < 0.9 * at_once.force
    released = one(Touch(X, Y, depth=0.0015, held=60.0, released=1.0))
    assert 0.0 < released.depth < 0.4 * at_once.depth


# Conductivity beyond geometry


def test_changing_a_result_in_place_changes_no_later_one() -> None:
    simulator = Simulator(DESIGN, "coarse")
    first = simulator.impedance_matrix(Scene()).copy()
    matrix = simulator.impedance_matrix(Scene())
    matrix -= first
    assert np.array_equal(simulator.impedance_matrix(Scene()), first)
    assert not simulator.model.flat_impedance.flags.writeable


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
    # No volume changes in a hinge.
    bent, soft = Scene(Bend(20.0)), Mechanics(piezoresistivity=Piezoresistivity(volume=2.0))
    assert signal(soft, bent, Hinge()) == pytest.approx(
        signal(Mechanics(), bent, Hinge()), abs=1e-10
    )


# Footprints


PAD = Rectangle(0.036, 0.030)
ROUND = Footprint(0.015, 0.015, round=True)


@pytest.fixture
def pressed(monkeypatch, tmp_path):
    """Signal and result of one press near the middle of a small sensor, and an empty store."""
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    pressed_sensor.solved_presses.cache_clear()

    def press(indenter, **how):
        sim = Simulator(SensorDesign(PAD, 0.005, uniform(PAD, 8, 0.005)), "coarse")
        scene = Scene(touches=(Touch(0.017, 0.014, indenter=indenter, **how),))
        flat = sim.measure(Scene()).impedance.real
        return sim.measure(scene).impedance.real / flat - 1.0, sim.presses(scene)[0]

    return press


@pytest.mark.slow
def test_a_round_footprint_presses_like_the_cylinder_and_off_its_middle_in_part(
    pressed, monkeypatch
):
    """The cylinder's press is found otherwise: by its axisymmetric dent and contact."""
    sides = 5e-3 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    corners = (sides + np.array([3e-3, 0.0])).tolist()
    square = Footprint(corners=tuple(map(tuple, corners)))
    monkeypatch.setattr(stack_mesh, "_PUNCH_CELLS", 0.7)  # few, and errors of 3 % with those below
    assert pressed(square, force=0.3)[1].contact_radius < 0.5 * square.rims[1]
    monkeypatch.setattr(stack_mesh, "_PUNCH_CELLS", 0.3)
    expected, cylinder = pressed(Cylinder(), force=6.0)
    signal, punch = pressed(ROUND, force=6.0)
    assert np.linalg.norm(signal - expected) < 0.035 * np.linalg.norm(expected)
    assert punch.depth == pytest.approx(cylinder.depth, rel=0.04)
    assert punch.thinning == pytest.approx(cylinder.thinning, rel=0.05)
    assert punch.contact_radius == pytest.approx(0.0075)
    assert (punch.force, punch.signal_error) == (6.0, cylinder.signal_error)
    to_depth = pressed(ROUND, depth=punch.depth, held=60.0)[1]
    assert 0.8 * 6.0 < to_depth.force < 0.9 * 6.0
    pressed_sensor.solved_presses.cache_clear()
    monkeypatch.setattr(pressed_sensor, "FiniteStack", None)  # the store has it
    assert np.array_equal(pressed(ROUND, force=6.0)[0], signal)


@pytest.mark.slow
def test_indenters_keep_apart_by_their_shapes_and_scanned_balls_are_spheres(tmp_path):
    bar, ball = Footprint(0.03, 0.006), Sphere(0.004)
    above = (X, Y + 0.010)
    for allowed in (
        (Touch(X, Y, indenter=bar), Touch(*above, indenter=bar)),
        (Touch(X, Y, held=1.0, released=1.0), Touch(*above)),
        (Touch(X, Y, 1.0, ball), Touch(*above, 1.0, ball)),
    ):
        Scene(touches=allowed)
    for refused in (
        (Touch(X, Y, indenter=bar), Touch(X + 0.02, Y, indenter=bar)),
        (Touch(X, Y), Touch(*above)),
    ):
        with pytest.raises(ConfigurationError, match=r"apart|0\.01 m .*0\.015"):
            Scene(touches=refused)
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(subdivisions=4, radius=7.5).export(tmp_path / "ball.stl")
    path, sphere = tmp_path / "scene.toml", Sphere(0.0075)
    path.write_text(
        "[[touches]]\nx = 0.05\ny = 0.02\nindenter = { file = 'ball.stl', scale = 1e-3 }\n"
    )
    (touch,) = Scene.from_toml(path).touches
    assert touch.indenter == (scanned := ScannedIndenter(tmp_path / "ball.stl", 1e-3))
    r = np.linspace(0.0, 0.0065, 30)
    assert scanned.profile(r)[0] == pytest.approx(sphere.profile(r)[0], abs=4e-5)
    assert scanned.rims[1] == pytest.approx(0.0075, rel=0.01)
    lying = trimesh.creation.capsule(height=30.0, radius=5.0)
    lying.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0]))
    lying.export(tmp_path / "bar.stl")
    with pytest.raises(ConfigurationError, match="upright"):
        ScannedIndenter(tmp_path / "bar.stl", 1e-3)


# Files


@pytest.mark.parametrize(
    ("thickness", "factor", "indenter", "words"),
    [
        (0.0056, 1.4, Cylinder(), "a cover of 0.06"),
        (0.012, 100.0, Cylinder(), "100 times as stiff"),
        (0.012, 0.01, Cylinder(), "0.01 times as stiff"),
        (0.012, 1.4, Sphere(0.001), "1 mm radius"),
        (0.012, 3.0, Sphere(0.003), ""),
    ],
)
def test_no_error_is_stated_for_stacks_and_indenters_beyond_those_compared(
    thickness, factor, indenter, words
):
    design = dataclasses.replace(DESIGN, encapsulated_thickness=thickness)
    around = NeoHookean(factor * Mechanics().gel.shear_modulus)
    found = uncompared_properties(indenter, design, Mechanics(encapsulation=around))
    assert len(found) == bool(words)
    assert words in "".join(found)


def test_a_touch_that_is_like_none_compared_is_refused():
    design = dataclasses.replace(DESIGN, encapsulated_thickness=0.0056)
    stiff, stiffer = (
        PressedSensor(
            design, Mechanics(encapsulation=NeoHookean(k * Mechanics().gel.shear_modulus))
        )
        for k in (10.0, 100.0)
    )
    require_model((Touch(X, Y, 0.2),), stiff)
    with pytest.raises(ConfigurationError, match=r"0\.33 or .*0\.33 to 3 .*3 mm or"):
        require_model((Touch(X, Y, 0.2, Sphere(0.001)),), stiff)
    with pytest.raises(ConfigurationError, match=r"0\.33 or .*0\.33 to 3 was compared\. Bring"):
        require_model((Touch(X, Y, 0.2),), stiffer)
