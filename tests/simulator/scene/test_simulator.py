"""Simulator: scenes to frames, and no work that a scene does not need."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, FrameError
from eitskin.geometry import Bend, Disc, Electrode, Hinge, Rectangle, SensorDesign
from eitskin.geometry.deformation.fixtures import FreeArc, Roll, Twist
from eitskin.geometry.deformation.kinematics import Displaced
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import (
    Frame,
    Instrument,
    Protocol,
    Scene,
    Simulator,
    Sphere,
    Touch,
)

import closed_forms


@pytest.fixture
def flat(sim):
    return sim.measure(Scene()).impedance.real


def test_frame_has_the_protocol_order_and_is_real_without_instrument(sim) -> None:
    frame = sim.measure(Scene())
    assert frame.impedance.shape == (28,)
    assert np.all(frame.impedance.imag == 0)
    assert sim.full_scale == frame.impedance.real.max()
    assert not frame.status.any()
    assert sim.deformation(Scene()) is None


def test_convex_bends_stretch_the_layer_and_concave_ones_shorten_it(sim, flat) -> None:
    out = sim.measure(Scene(bend=Bend(50.0))).impedance.real / flat - 1
    back = sim.measure(Scene(bend=Bend(-20.0))).impedance.real / flat - 1
    assert np.median(out) > 0.01
    assert np.median(back) < -0.005


def test_the_signal_of_a_roll_and_of_a_bend_about_the_middle_is_second_order(flat) -> None:
    """The sign of the angle is lost, and half the angle is a quarter of the signal."""
    neutral = Simulator(SensorDesign.reference(), "fast", fixture=Hinge(offset=0.0))
    for angle, scene_of in (
        (10.0, lambda angle: Scene(bend=Bend(angle))),
        (40.0, lambda angle: Scene(roll=Roll(angle))),
    ):
        one, back, half = (
            neutral.measure(scene_of(a)).impedance.real / flat - 1
            for a in (angle, -angle, angle / 2)
        )
        size = np.linalg.norm(one)
        assert np.linalg.norm(one - back) < 0.1 * size
        assert size == pytest.approx(4 * np.linalg.norm(half), rel=0.1)


@pytest.mark.slow
def test_composing_with_what_does_nothing_changes_nothing(sim) -> None:
    touch = (Touch(0.06, 0.02, 8.0),)
    plain = sim.measure(Scene(Bend(20.0), touch)).impedance
    same = sim.measure(Scene(Bend(20.0), touch, roll=Roll(0.0), twist=Twist(0.0))).impedance
    assert same == pytest.approx(plain, rel=1e-12)
    flat = sim.measure(Scene()).impedance
    assert sim.simulate_deformation(Displaced(np.zeros_like)).impedance == pytest.approx(
        flat, rel=1e-10
    )
    for scene in (Scene(bend=Bend(1e-6)), Scene(touches=(Touch(0.06, 0.02, 1e-6),))):
        assert sim.measure(scene).impedance == pytest.approx(flat, rel=1e-7)


def test_rigid_motions_are_not_felt(sim, flat) -> None:
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    moved = sim.simulate_deformation(Displaced(lambda x: x @ (turn.T - np.eye(3)) + 0.1)).impedance
    assert moved.real == pytest.approx(flat, rel=1e-9)


def test_a_twist_does_not_know_its_sense_but_by_the_electrodes(sim, flat) -> None:
    """Twisting back mirrors the sensor: electrodes 0, 1, 2 take the places of 6, 5, 4."""
    there, back = (
        sim.measure(Scene(twist=Twist(sign * 60.0))).impedance.real for sign in (1.0, -1.0)
    )
    mirror = [6, 5, 4, 3, 2, 1, 0, 7]
    labels = list(Protocol.pairwise(8).table)
    pairs = [tuple(sorted((mirror[a], mirror[b]))) for a, b, _, _ in labels]
    order = [labels.index((a, b, a, b)) for a, b in pairs]
    assert there[order] == pytest.approx(back, rel=1e-9)
    assert np.abs(there / flat - 1).max() > 1e-3


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


def test_touch_signal_is_below_one_percent_and_grows_with_force(sim, flat) -> None:
    signals = [
        np.abs(sim.measure(Scene(touches=(Touch(0.06, 0.02, force),))).impedance.real / flat - 1)
        for force in (2.0, 5.0, 10.0)
    ]
    assert signals[0].max() < signals[1].max() < signals[2].max() < 0.01
    assert signals[2].max() > 0.001


def test_mirrored_touches_give_mirrored_frames(sim) -> None:
    protocol = sim.protocol
    mirror = [2, 1, 0, 7, 6, 5, 4, 3]
    names = [tuple(sorted((mirror[a], mirror[b]))) for a, b, _, _ in protocol.table]
    order = [next(i for i, r in enumerate(protocol.table) if r[:2] == n) for n in names]
    left = sim.measure(Scene(bend=Bend(20.0), touches=(Touch(0.040, 0.021),)))
    right = sim.measure(Scene(bend=Bend(20.0), touches=(Touch(0.110, 0.021),)))
    assert right.impedance[order] == pytest.approx(left.impedance, rel=1e-8)


def test_the_same_scene_costs_no_new_factorisation(sim) -> None:
    scene = Scene(bend=Bend(12.5))
    sim.measure(scene)
    assert sim.full_scale > 0.0  # of the flat sensor, which noise goes by, found once
    before = sim.model.factorisations
    sim.measure(scene, Instrument(), np.random.default_rng(0))
    assert sim.model.factorisations == before
    sim.measure(Scene(bend=Bend(12.6)))
    assert sim.model.factorisations == before + 1


def test_noise_goes_by_the_full_scale_and_follows_its_seed(sim) -> None:
    clean, rng = sim.measure(Scene()).impedance, np.random.default_rng(4)
    noisy = [sim.measure(Scene(), Instrument(75.0), rng).impedance for _ in range(400)]
    deviation = sim.full_scale * 10 ** (-75 / 20)
    assert np.std((noisy - clean).real) == pytest.approx(deviation, rel=0.03)
    one, two = (sim.measure(Scene(), Instrument(), np.random.default_rng(9)) for _ in range(2))
    assert np.array_equal(one.impedance, two.impedance)
    with pytest.raises(ConfigurationError, match="default_rng"):
        sim.measure(Scene(), Instrument())


def test_impossible_scenes_are_refused(sim) -> None:
    for scene, message in (
        (Scene(touches=(Touch(50.0, 20.0),)), "metres"),
        (Scene(bend=Bend(-90.0)), "from -40 to 90 deg"),
        (Scene(touches=(Touch(0.05, 0.02, 100.0),)), "pressed to"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            sim.measure(scene)
    # In the bounding box and off the outline.
    disc = Disc(0.04)
    round_sensor = Simulator(SensorDesign(disc, 0.005, uniform(disc, 4)), resolution="fast")
    with pytest.raises(ConfigurationError, match=r"0.08 x 0.08 m.*\(0.005,"):
        round_sensor.measure(Scene(touches=(Touch(0.005, 0.005),)))


def test_a_bend_that_no_clamp_can_do_is_refused_before_its_presses_are_solved() -> None:
    disc = Disc(0.04)
    round_sensor = Simulator(SensorDesign(disc, 0.005, uniform(disc, 4)), resolution="fast")
    scene = Scene(Bend(10.0), (Touch(0.04, 0.04, 6.0, indenter=Sphere(0.0061)),))
    with pytest.raises(ConfigurationError, match=r"rectangular outline, got Disc.*FreeArc"):
        round_sensor.check_scene(scene)
    round_sensor.check_scene(dataclasses.replace(scene, bend=Bend(0.0)))
    hinge = Simulator(round_sensor.design, resolution="fast", fixture=Hinge())
    hinge.check_scene(scene)


def test_frames_own_their_values_and_check_their_shape() -> None:
    protocol, values = Protocol.pairwise(3), np.ones(3, complex)
    frame = Frame(values, protocol)
    values[0] = 5.0
    assert frame.impedance[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        frame.impedance[0] = 2.0
    with pytest.raises(FrameError, match="3 measurements"):
        Frame(np.ones(4), protocol)
