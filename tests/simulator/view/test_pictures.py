"""Pictures of models and scenes: what they are made of, and that they are drawn."""

import math
import sys

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Disc, Electrode, SensorDesign, Twist
from eitskin.geometry.deformation.kinematics import Displaced, largest_strain
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import mesh_design
from eitskin.simulator import ForwardModel, Scene, Touch
from eitskin.simulator.view import drawing
from eitskin.simulator.view import scene_pictures as view
from eitskin.simulator.view.scene_pictures import (
    conductance_change,
    deformed_current_density,
    draw_drive,
    draw_mesh,
    draw_scenes,
    height_inside,
    in_front,
    indenter_surfaces,
    most_sensitive_pair,
)

from alternatives import pulled_back
from pictured_bar import THICKNESS, WIDTH, bar_between_electrodes, colours

FEW = Grading(2e-3, 5e-3, 1.0)
BAR = bar_between_electrodes(contact_impedance=1e-3)  # the current density is 1 / area


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hexahedra", "prisms"])
def test_lines_of_current_in_a_bar_are_straight_and_carry_its_density(kind) -> None:
    model = ForwardModel(BAR, ((1, 1), FEW), cells=kind)
    lines = drawing.lines_of_current(model.mesh, model.current_density((0, 1)), plus=0, count=10)
    assert lines.n_cells == 10
    assert lines["magnitude"] == pytest.approx(1.0 / (0.010 * 0.005), rel=1e-6)
    for number in range(lines.n_cells):
        points = lines.get_cell(number).points
        assert np.ptp(points[:, 1:], axis=0).max() < 1e-6
    x = lines.points[:, 0]
    assert (x.min(), x.max()) == pytest.approx((0.0, 0.040), abs=3e-3)
    # They spread over the electrode they begin on.
    many = drawing.lines_of_current(model.mesh, model.current_density((0, 1)), 0, count=40)
    for axis, extent in ((1, 0.010), (2, 0.005)):
        quarters = np.histogram(many.points[:, axis], bins=4, range=(0.0, extent))[0]
        assert quarters.min() > 0.5 * quarters.mean()


def test_pictures_are_not_mirrored_and_currents_in_stretched_blocks_uniform():
    for direction, right in (((0.0, -1.0, 0.0), (1, 0, 0)), ((1.0, 0.0, 0.0), (0, 1, 0))):
        panel = drawing.Panel("", np.zeros((1, 3)), print, direction=np.array(direction))
        assert np.array_equal(panel.axes, [right, (0, 0, 1)])
    c, s = math.cos(0.5), math.sin(0.5)
    F = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]) @ np.diag([1.5, 0.9, 0.7])
    affine = Displaced(lambda x: x @ (F - np.eye(3)).T)
    model = ForwardModel(bar_between_electrodes(), ((1, 1), Grading(2e-3, 2e-3, 1.0, 2)))
    tensor = np.broadcast_to(pulled_back(F), (len(model.mesh.cells), 3, 3))
    found = deformed_current_density(model, affine, (0, 1), tensor)
    area = 0.9 * WIDTH * 0.7 * THICKNESS
    assert found == pytest.approx(np.tile([c / area, 0.0, s / area], (len(found), 1)), abs=1e-3)


@pytest.mark.slow
def test_drive_pairs_and_electrodes_inside_and_below_are_drawn_where_they_are(tmp_path):
    model = ForwardModel(BAR, ((1, 1), FEW))
    for drive in ((0, 2), (1, 1)):
        with pytest.raises(ConfigurationError):
            draw_drive(model, drive, tmp_path / "drive.png")
    assert list(tmp_path.iterdir()) == []
    draw_drive(model, (0, 1), tmp_path / "drive.png")
    pixels = colours(tmp_path / "drive.png")
    middle = pixels[pixels.shape[0] // 3 : 2 * pixels.shape[0] // 3]
    potential = middle[:, : middle.shape[1] // 2]
    red = potential[..., 0] - potential[..., 2] > 60
    blue = potential[..., 2] - potential[..., 0] > 60
    assert red.sum() > 3000
    assert blue.sum() > 3000
    # The current enters on the left, where the potential is high.
    assert np.nonzero(red)[1].mean() < np.nonzero(blue)[1].mean()
    places = ((0.010, "top"), (0.030, "bottom"))
    pads = tuple(Electrode(x, 0.020, 0.008, on=on) for x, on in places)
    sheet = Electrode(0.020, 0.030, 0.008, on="inside", z=0.001)
    design = SensorDesign(Disc(0.020), 0.004, (*pads, sheet))
    mesh = mesh_design(design, Grading(2e-3, 8e-3, 1.0))
    draw_mesh(mesh, tmp_path / "mesh.png")
    pixels = colours(tmp_path / "mesh.png")
    orange = ((pixels >= (160, 90, 20)) & (pixels <= (230, 150, 80))).all(axis=2)
    assert orange.sum() > 2000  # electrodes
    assert (pixels.min(axis=2) < 250).mean() > 0.2
    heights = [height_inside(mesh, electrode) for electrode in range(3)]
    assert heights == [None, None, pytest.approx(0.001)]
    assert [np.sign(in_front(mesh, electrode)[2]) for electrode in range(3)] == [1.0, -1.0, 1.0]


# Fields


def test_drawings_have_conductance_strain_and_the_pair_that_changes_most(sim):
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
    points = np.array([[0.01, 0.02, 0.003], [0.03, 0.01, 0.001]])
    stretched = Displaced(lambda x: x * [0.3, 1.0 / 1.3 - 1.0, 0.0])
    assert largest_strain(stretched, points) == pytest.approx(math.log(1.3), rel=1e-6)
    sheared = Displaced(lambda x: 0.8 * x[..., [2, 0, 0]] * [1.0, 0.0, 0.0])
    # The stretches of a simple shear g are g/2 +- sqrt(1 + g^2/4).
    assert largest_strain(sheared, points) == pytest.approx(math.asinh(0.4), rel=1e-6)
    assert not largest_strain(None, points).any()
    scene = Scene(touches=(Touch(0.13, 0.03),))
    change = np.abs(sim.measure(scene).impedance / sim.measure(Scene()).impedance - 1.0)
    best = sim.protocol.table[int(np.argmax(change))]
    assert most_sensitive_pair(sim, scene) == best[:2]
    assert set(best) <= {2, 3, 4}  # at the end that is pressed
    flat = sim.measure(Scene()).impedance.real
    assert most_sensitive_pair(sim, Scene()) == sim.protocol.table[int(np.argmax(flat))][:2]


# Drawing


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


@pytest.mark.slow
def test_a_press_is_red_where_it_is_and_a_bent_sensor_is_drawn_whole(
    sim, tmp_path, monkeypatch
) -> None:
    monkeypatch.setitem(view.CELLS, "hexahedra", 75)  # drawn sooner
    touch, path = Touch(0.05, 0.02), tmp_path / "scenes.png"
    draw_scenes(sim, [("flat", Scene()), ("pressed", Scene(touches=(touch,)))], path)
    pixels = colours(path)
    red = (pixels[..., 0] > 100) & (pixels[..., 1] < 90) & (pixels[..., 2] < 90)
    red &= pixels[..., 0] - pixels[..., 1] > 80  # electrodes are orange
    upper, lower = red[: len(red) // 2], red[len(red) // 2 : -120]  # without the colour scale
    assert upper.sum() < 50
    assert lower.sum() > 500
    assert np.nonzero(lower)[1].mean() == pytest.approx(418, abs=40)
    bent = Scene(Bend(40.0), (touch, Touch(0.12, 0.055, 5.0)), twist=Twist(15.0))
    for colour in ("strain", "current"):
        draw_scenes(sim, [("bent and pressed", bent)], path, colour)
        pixels = colours(path)
        assert (pixels.min(axis=2) < 250).mean() > 0.15
        rim = np.concatenate([pixels[-3:].reshape(-1, 3), pixels[:, -3:].reshape(-1, 3)])
        assert (rim > 250).all()
        assert (np.ptp(pixels, axis=2) > 60).mean() > 0.02
    assert [p.name for p in tmp_path.iterdir()] == ["scenes.png"]


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
