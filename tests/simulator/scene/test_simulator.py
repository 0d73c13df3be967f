"""Simulator: limits, symmetries and supports of scenes, and what it refuses."""

import dataclasses

import numpy as np
import pytest

from eitskin.config import parse_toml, to_toml
from eitskin.geometry import (
    Bend,
    Clamp,
    Disc,
    Electrode,
    Free,
    FreeArc,
    Plates,
    Rectangle,
    Rigid,
    Roll,
    SensorDesign,
    Substrate,
    Twist,
)
from eitskin.geometry.deformation.kinematics import Displaced
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import (
    Cylinder,
    Footprint,
    Profile,
    Protocol,
    Scene,
    Simulator,
    Sphere,
    Touch,
)

import closed_forms

REFERENCE, DISC = SensorDesign.reference(), Disc(0.04)
TOUCH = Touch(0.020, 0.030, 8.0)
PAIRS = [row[:2] for row in Protocol.pairwise(8).table]


@pytest.fixture
def flat(sim):
    return sim.measure(Scene()).impedance.real


def mirrored(electrodes) -> list[int]:
    """Rows of the pairs that electrodes have whose places others take, in order."""
    return [PAIRS.index(tuple(sorted((electrodes[a], electrodes[b])))) for a, b in PAIRS]


@pytest.mark.slow
def test_bends_stretch_the_layer_rigid_motions_do_nothing_and_mirrors_mirror(sim, flat):
    """Twisting back mirrors the sensor: electrodes 0, 1, 2 take the places of 6, 5, 4."""
    assert not sim.measure(Scene()).status.any()
    assert sim.deformation(Scene()) is None
    assert sim.full_scale == flat.max()
    out, back = (sim.measure(Scene(Bend(angle))).impedance.real / flat for angle in (50.0, -20.0))
    assert np.median(out) > 1.01
    assert np.median(back) < 0.995
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    for moved in (np.zeros_like, lambda x: x @ (turn.T - np.eye(3)) + 0.1):
        found = sim.simulate_deformation(Displaced(moved)).impedance
        assert found.real == pytest.approx(flat, rel=1e-9)
    there, back = (sim.measure(Scene(twist=Twist(way * 60.0))).impedance.real for way in (1, -1))
    assert there[mirrored([6, 5, 4, 3, 2, 1, 0, 7])] == pytest.approx(back, rel=1e-9)
    assert np.abs(there / flat - 1).max() > 1e-3
    left, right = (
        sim.measure(Scene(Bend(20.0), (Touch(x, 0.021),))).impedance for x in (0.040, 0.110)
    )
    assert right[mirrored([2, 1, 0, 7, 6, 5, 4, 3])] == pytest.approx(left, rel=1e-8)
    both, below = (
        sim.measure(Scene(Bend(20.0), support=each)).impedance.real for each in (None, Plates())
    )
    held = Simulator(sim.design, "fast", Clamp(faces="bottom")).measure(Scene(Bend(20.0)))
    assert np.array_equal(held.impedance.real, below)
    assert 0.05 < np.linalg.norm(below - both) / np.linalg.norm(both - flat) < 0.15


@pytest.mark.slow
def test_what_does_nothing_changes_nothing(sim, flat) -> None:
    plain, touch = Scene(Bend(20.0), (TOUCH,)), Touch(0.06, 0.02, 1e-6)
    same = dataclasses.replace(plain, roll=Roll(0.0), twist=Twist(0.0))
    expected = sim.measure(plain).impedance
    assert sim.measure(same).impedance == pytest.approx(expected, rel=1e-12)
    for scene in (Scene(bend=Bend(1e-6)), Scene(touches=(touch,))):
        assert sim.measure(scene).impedance == pytest.approx(flat, rel=1e-7)
    for support in (Rigid(), Plates(), Substrate(0.01, 5e3), Free()):
        assert np.array_equal(sim.measure(Scene(support=support)).impedance, flat)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [30.0, -300.0])
def test_a_block_on_a_free_arc_is_an_annular_sector(angle) -> None:
    """Between its straight ends; radii as its places tell them."""
    length, width, thickness, z = 0.05, 0.02, 0.004, 1e-9
    ends = (Electrode(0.0, width / 2, width, z), Electrode(length, width / 2, width, z))
    outline = Rectangle(length, width)
    design = SensorDesign(outline, thickness, ends, encapsulated_thickness=thickness)
    sim = Simulator(design, ((4, 4, 4, 4, 4), Grading(0.005, 0.01, 1.0)), FreeArc(length))
    bent = sim.deformation(Scene(Bend(angle)))
    faces = np.array([[length / 2, width / 2, z] for z in (0.0, thickness)])
    # Ends lie at r (sin, cos - 1) of half the angle from the middle, r from the axis.
    apart = bent.positions(np.add(faces, (length / 2, 0.0, 0.0))) - bent.positions(faces)
    inner, outer = np.sort(np.abs(apart[:, 0] / np.sin(np.radians(angle) / 2)))
    exact = closed_forms.sector_between_ends(np.radians(abs(angle)), inner, outer) / width
    assert sim.measure(Scene(Bend(angle))).impedance[0] == pytest.approx(exact, rel=1e-5)


# Supports and files


@pytest.mark.parametrize("support", [None, Rigid(), Plates(0.03), Substrate(0.01, 5e3), Free()])
def test_a_scene_keeps_its_support_and_indenters_in_its_file(support) -> None:
    shapes = Sphere(0.01), Profile((0.0, 0.004), (0.0, 0.001)), Footprint(0.02, 0.01)
    others = (Touch(0.03 * k + 0.05, 0.02, 3.0, shape) for k, shape in enumerate(shapes))
    held = Touch(0.05, 0.05, depth=0.001, held=3.0, indenter=Cylinder(0.005))
    scene = Scene(Bend(10.0), (TOUCH, held, *others), support=support)
    assert parse_toml(Scene, to_toml(scene)) == scene


@pytest.mark.parametrize(
    ("x", "force", "error"), [(0.040, 6.0, 0.05), (0.070, 2.0, 0.10), (0.070, 0.3, 0.20)]
)
def test_errors_on_plates_are_larger_over_the_gap_and_for_light_touches_there(x, force, error):
    scene = Scene(Bend(20.0), (Touch(x, 0.030, force),), support=Plates())
    (pressed,) = Simulator(REFERENCE, "coarse").presses(scene)
    assert pressed.signal_error == error


def test_presses_on_the_plates_of_the_reference_ship():
    """Far from the gap they are those on a rigid base; bent they turn with their plate."""
    sim, touches = Simulator(REFERENCE, "coarse"), (Touch(0.012, 0.030, 6.0),)
    scene, bare = (Scene(Bend(30.0), each, support=Plates()) for each in (touches, ()))
    pressed = Scene(touches=touches)
    assert not sim.solves_presses(scene)
    (held,), (rigid,) = sim.presses(scene), sim.presses(pressed)
    assert held.depth == pytest.approx(rigid.depth, rel=0.02)
    under = np.array([0.012, 0.030, 0.005])
    both = sim.deformation(scene).positions(under) - sim.deformation(bare).positions(under)
    flat = sim.deformation(pressed).positions(under) - under
    assert np.linalg.norm(both) == pytest.approx(np.linalg.norm(flat), rel=2e-3)
    assert np.degrees(np.arctan2(both[0], -both[2])) == pytest.approx(15.0, abs=2.0)
