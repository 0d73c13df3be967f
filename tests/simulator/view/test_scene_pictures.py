"""Pictures of scenes: their fields against closed forms, and that they are drawn."""

import math
import sys

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Hinge, SensorDesign
from eitskin.geometry.deformation.fixtures import Roll, Twist
from eitskin.geometry.deformation.kinematics import Displaced, largest_strain
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import Cylinder, ForwardModel, Protocol, Scene, Simulator, Sphere, Touch
from eitskin.simulator.view import scene_pictures as view
from eitskin.simulator.view import shapes
from eitskin.simulator.view.scene_pictures import (
    conductance_change,
    deformed_current_density,
    draw_scenes,
    indenter_surfaces,
    most_sensitive_pair,
    round_number,
)

from alternatives import pulled_back
from pictured_bar import THICKNESS, WIDTH, bar_between_electrodes, colours

BAR = bar_between_electrodes()
FEW = ((2, 1), Grading(2e-3, 2e-3, 1.0, 2))  # functions and cells, where currents are not looked at


# Fields


def test_conductance_falls_under_a_press_and_where_the_layer_is_stretched(sim) -> None:
    points = np.array([[0.05, 0.02, 0.0025], [0.02, 0.05, 0.0025]])
    scene = Scene(touches=(Touch(0.05, 0.02),))
    pressed = conductance_change(sim, scene, points)
    # On the axis the stretches are lambda in x and y and lambda^-2 in z: sigma_xx is lambda^-2.
    deformed = sim.deformation(scene).gradient(points[:1])[0]
    assert pressed[0] == pytest.approx(deformed[2, 2] / np.linalg.det(deformed) ** 2 - 1, rel=0.02)
    assert pressed[0] < -0.2
    assert abs(pressed[1]) < 0.02
    middle = np.array([[0.075, 0.03, 0.004]])
    assert conductance_change(sim, Scene(bend=Bend(40.0)), middle)[0] < -0.1
    assert conductance_change(sim, Scene(), middle)[0] == 0.0


def test_strain_is_that_of_a_stretch_and_of_a_shear() -> None:
    points = np.array([[0.01, 0.02, 0.003], [0.03, 0.01, 0.001]])
    stretched = Displaced(lambda x: x * [0.3, 1.0 / 1.3 - 1.0, 0.0])
    assert largest_strain(stretched, points) == pytest.approx(math.log(1.3), rel=1e-6)
    sheared = Displaced(lambda x: 0.8 * x[..., [2, 0, 0]] * [1.0, 0.0, 0.0])
    # The stretches of a simple shear g are g/2 +- sqrt(1 + g^2/4).
    assert largest_strain(sheared, points) == pytest.approx(math.asinh(0.4), rel=1e-6)
    assert not largest_strain(None, points).any()


def test_the_current_in_a_stretched_and_turned_block_is_uniform() -> None:
    c, s = math.cos(0.5), math.sin(0.5)
    F = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]) @ np.diag([1.5, 0.9, 0.7])
    affine = Displaced(lambda x: x @ (F - np.eye(3)).T)
    model = ForwardModel(BAR, ((1, 1), Grading(2e-3, 2e-3, 1.0, 2)))
    tensor = np.broadcast_to(pulled_back(F), (len(model.mesh.cells), 3, 3))
    found = deformed_current_density(model, affine, (0, 1), tensor)
    area = 0.9 * WIDTH * 0.7 * THICKNESS
    assert found == pytest.approx(np.tile([c / area, 0.0, s / area], (len(found), 1)), abs=1e-3)


def test_the_pair_that_changes_most_is_found(sim) -> None:
    scene = Scene(touches=(Touch(0.13, 0.03),))
    change = np.abs(sim.measure(scene).impedance / sim.measure(Scene()).impedance - 1.0)
    best = sim.protocol.table[int(np.argmax(change))]
    assert most_sensitive_pair(sim, scene) == best[:2]
    assert set(best) <= {2, 3, 4}  # at the end that is pressed
    flat = sim.measure(Scene()).impedance.real
    assert most_sensitive_pair(sim, Scene()) == sim.protocol.table[int(np.argmax(flat))][:2]
    # Values that are zero by symmetry are not those that change most.
    symmetric = Protocol(((1, 5, 3, 7), (0, 4, 0, 4)), 8)
    other = Simulator(SensorDesign.reference(), "coarse", protocol=symmetric)
    assert most_sensitive_pair(other, Scene(touches=(Touch(0.05, 0.02),))) == (0, 4)


# Drawing


@pytest.mark.parametrize("indenter", [Cylinder(), Sphere(0.006)])
def test_an_indenter_has_its_shape_and_stands_upright_on_what_it_presses(indenter) -> None:
    turned = Roll(90.0).deformation(SensorDesign.reference())
    tip = np.array([0.05, 0.02, 0.01])
    left, _, right = np.linalg.svd(turned.gradient(tip))
    body = shapes.indenter_surface(indenter, tip, left @ right)
    offsets = (body.points - tip) @ (left @ right)
    r = np.hypot(offsets[:, 0], offsets[:, 1])
    assert r.max() == pytest.approx(indenter.rims[1], rel=1e-6)
    under = r < 0.999 * indenter.rims[1]
    assert offsets[under, 2] == pytest.approx(indenter.profile(r[under])[0], abs=1e-8)


def test_indenters_are_where_they_press_and_not_where_they_were_taken_off(sim) -> None:
    press, released = Touch(0.05, 0.02, 6.0), Touch(0.12, 0.03, held=10.0, released=1.0)
    scene = Scene(touches=(press, released))
    (body,) = indenter_surfaces(sim, scene)
    lowest = body.points[:, 2].min()
    assert lowest == pytest.approx(0.0085 - sim.presses(scene)[0].depth, rel=1e-5)
    assert body.points[:, :2].mean(axis=0) == pytest.approx([0.05, 0.02], abs=2e-4)
    bent = Scene(Bend(40.0), (press,), twist=Twist(20.0))
    (moved,) = indenter_surfaces(sim, bent)
    tip = np.array([0.05, 0.02, lowest])
    place = sim.deformation(Scene(Bend(40.0), twist=Twist(20.0))).positions(tip)
    # Moved as a rigid body: distances from the tip stay.
    before = np.linalg.norm(body.points - tip, axis=1)
    after = np.linalg.norm(moved.points - place, axis=1)
    assert np.sort(after) == pytest.approx(np.sort(before), abs=1e-7)


@pytest.mark.parametrize(
    ("value", "found"), [(45.7, 50.0), (0.31, 0.32), (1.0, 1.0), (9.1, 10.0), (0.1, 0.1)]
)
def test_colour_scales_end_at_round_numbers(value, found) -> None:
    assert round_number(value) == pytest.approx(found)


@pytest.fixture
def few_cells(monkeypatch) -> None:
    """Coarser pictures, drawn sooner."""
    monkeypatch.setitem(view.CELLS, "hexahedra", 75)


@pytest.mark.slow
@pytest.mark.usefixtures("few_cells")
def test_a_bent_pressed_sensor_is_drawn_whole(sim, tmp_path) -> None:
    path = tmp_path / "scene.png"
    scene = Scene(Bend(40.0), (Touch(0.05, 0.02), Touch(0.12, 0.055, 5.0)), twist=Twist(15.0))
    draw_scenes(sim, [("bent and pressed", scene)], path, "strain")
    pixels = colours(path)
    assert (pixels.min(axis=2) < 250).mean() > 0.15
    rim = np.concatenate([pixels[-3:].reshape(-1, 3), pixels[:, -3:].reshape(-1, 3)])
    assert (rim > 250).all()
    saturated = np.ptp(pixels, axis=2) > 60
    assert saturated.mean() > 0.02
    assert [p.name for p in tmp_path.iterdir()] == ["scene.png"]


@pytest.mark.slow
@pytest.mark.usefixtures("few_cells")
def test_a_press_is_red_where_it_is_and_nowhere_else(sim, tmp_path) -> None:
    scenes = [Scene(), Scene(touches=(Touch(0.05, 0.02),))]
    draw_scenes(sim, [(f"{i}", scene) for i, scene in enumerate(scenes)], tmp_path / "two.png")
    pixels = colours(tmp_path / "two.png")
    red = (pixels[..., 0] > 100) & (pixels[..., 1] < 90) & (pixels[..., 2] < 90)
    red &= pixels[..., 0] - pixels[..., 1] > 80  # electrodes are orange
    upper, lower = red[: len(red) // 2], red[len(red) // 2 : -120]  # without the colour scale
    assert upper.sum() < 50
    assert lower.sum() > 500
    assert np.nonzero(lower)[1].mean() == pytest.approx(418, abs=40)


@pytest.mark.slow
@pytest.mark.usefixtures("few_cells")
def test_a_flat_sensor_is_drawn_in_every_colour(tmp_path) -> None:
    flat = Simulator(BAR, FEW, Hinge(span=0.02))
    for colour in ("conductance", "strain", "current"):
        draw_scenes(flat, [("flat", Scene())], tmp_path / f"{colour}.png", colour)
        assert (colours(tmp_path / f"{colour}.png").min(axis=2) < 250).mean() > 0.05


@pytest.mark.slow
def test_pictures_that_cannot_be_drawn_are_refused(sim, tmp_path, monkeypatch) -> None:
    scenes = [("flat", Scene())]
    for wanted, message in (
        ((tmp_path / "a.png", "red"), "conductance', 'strain', 'current'"),
        ((tmp_path / "a.png", "current", (0, 8)), "0 to 7"),
        ((tmp_path / "a.gif",), r"a\.png"),
        ((tmp_path / "none" / "a.png",), "folder"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            draw_scenes(sim, scenes, *wanted)
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(ImportError, match=r"pip install 'eitskin\[view\]'"):
        draw_scenes(sim, scenes, tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []
