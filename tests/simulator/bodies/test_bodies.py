"""Bodies from surface files, bent and pressed on tetrahedra: balances, boxes, and refusals."""

import dataclasses

import numpy as np
import pytest
import skfem

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Electrode, Rectangle, SensorDesign, Surface
from eitskin.geometry.deformation.fixtures import Clamp, FreeArc
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import ForwardModel, Mechanics, Scene, Simulator
from eitskin.simulator.bends.bend_3d import ClampedStack
from eitskin.simulator.bodies import pressed_body
from eitskin.simulator.bodies.body_deformation import ClampedBody, _sections
from eitskin.simulator.bodies.pressed_body import BodyPress, heights
from eitskin.simulator.bodies.tetrahedral_solid import TetrahedralField
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.scene.indenters import Sphere
from eitskin.simulator.scene.scene import Touch

from on_demand import OnDemand

pytestmark = pytest.mark.slow

trimesh = OnDemand("trimesh")
OnDemand("pytetwild")

SIZE = np.array([0.040, 0.020, 0.010])
RUBBER = NeoHookean(20e3)
BARE = Mechanics(RUBBER, RUBBER, margin=0.0)
COARSE = Grading(finest=6e-3, coarsest=8e-3, growth=1.0)


def box(folder, shift=(0.0, 0.0, 0.0)):
    """A box from a file, and the same as a rectangle without encapsulation."""
    solid = trimesh.creation.box(SIZE)
    solid.apply_translation(0.5 * SIZE + shift)
    solid.export(folder / "box.stl")
    places = [(0.010, 0.0), (0.030, 0.0), (0.010, 0.020), (0.030, 0.020)]
    body = SensorDesign(
        Surface(folder / "box.stl"),
        SIZE[2],
        tuple(
            Electrode(x + shift[0], y + shift[1], on="surface", z=0.005 + shift[2], width=0.004)
            for x, y in places
        ),
        encapsulated_thickness=SIZE[2],
    )
    side = tuple(Electrode(x, y, z=0.005, width=0.004, height=0.004) for x, y in places)
    flat = SensorDesign(Rectangle(*SIZE[:2]), SIZE[2], side, encapsulated_thickness=SIZE[2])
    return body, flat


@pytest.fixture(scope="module")
def design(tmp_path_factory):
    return box(tmp_path_factory.mktemp("box"))[0]


@pytest.fixture(scope="module")
def flat(tmp_path_factory):
    return box(tmp_path_factory.mktemp("flat"))[1]


def inside(n, low=(0.0, 0.0, 0.0), high=SIZE):
    return np.random.default_rng(4).uniform(low, high, (n, 3))


# Tetrahedra


def test_fields_meet_quadratic_displacements_and_heights_the_highest_face():
    mesh = skfem.MeshTet.init_tensor(*[np.array([0.0, 0.4, 1.0])] * 3)
    corners = mesh.p.T[mesh.t.T]
    edges = (0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)
    middles = np.stack([0.5 * (corners[:, a] + corners[:, b]) for a, b in edges], axis=1)

    def moved(X):
        x, y, z = np.moveaxis(X, -1, 0)
        return np.stack([x * y, z**2 - x, 0.1 + y * z], axis=-1)

    values = moved(np.concatenate([corners, middles], axis=1))
    stress = mesh.p.T @ [1.0, 2.0, 3.0]
    field = TetrahedralField(mesh.p.T, mesh.t.T.astype(np.int64), values, stress)
    X = inside(300, -0.1, 1.1).reshape(100, 3, 3)
    x, F = field.map_points(X)
    assert x == pytest.approx(X + moved(X), abs=1e-12)
    a, b, c = np.moveaxis(X, -1, 0)
    zero = np.zeros_like(a)
    rows = [[1 + b, a, zero], [zero - 1, zero + 1, 2 * c], [zero, c, 1 + b]]
    expected = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    assert pytest.approx(expected, abs=1e-12) == F
    assert field.mean_stress(X) == pytest.approx(X @ [1.0, 2.0, 3.0], abs=1e-12)
    roof = np.array([[[0.0, 0.0, 1.0], [2.0, 0.0, 2.0], [0.0, 1.0, 4.0]]])
    x, y = places = np.array([[0.2, 1.5, 0.3, 0.0], [0.3, 0.1, 0.6, 1.0]])
    for faces in (roof, np.concatenate([roof - [0, 0, 5], roof, roof - [0, 0, 1]])):
        assert heights(faces, places.T) == pytest.approx(1.0 + 0.5 * x + 3.0 * y)
        assert np.isnan(heights(faces, np.array([[1.5, 0.5], [-0.1, 0.5]]))).all()


# Bends


def test_edges_of_plates_cross_triangles_from_side_to_side():
    corners = np.array([[[0.0, 5.0, 0.0], [2.0, 5.0, 0.0], [0.0, 5.0, 2.0]]])
    found = _sections(corners, [1.0], 0.5)
    assert found == pytest.approx(np.linspace([1.0, 5.0, 0.0], [1.0, 5.0, 1.0], 4))


def test_a_box_bends_as_the_clamped_stack_does(design, flat) -> None:
    clamped = ClampedBody(design, 0.020, 0.004, BARE, COARSE)
    bent = clamped.solve_angle(20.0)
    # By Simpson's rule: the moment at no angle is none.
    work = 4.0 * clamped.plates.moment(10.0) + clamped.plates.moment(20.0)
    energy = clamped.plates.energy(20.0)
    assert energy == pytest.approx(work * np.radians(20.0) / 6.0, rel=0.01)
    grading = Grading(finest=2e-3, coarsest=4e-3, growth=0.5)
    (stack,) = ClampedStack(flat, Clamp(0.020, 0.004), BARE, grading).equilibria([20.0])
    X = inside(2000)
    moved = stack.positions(X) - X
    difference = bent.positions(X) - stack.positions(X)
    assert np.sqrt(np.mean(difference**2) / np.mean(moved**2)) < 0.05
    # Between meshes as coarse as these two the energies are 7 % apart.
    assert energy == pytest.approx(stack.energy, rel=0.12)
    assert np.linalg.det(bent.gradient(X)).mean() == pytest.approx(1.0, abs=2e-3)


# Presses


@pytest.fixture
def few_cells(monkeypatch):
    """Pressed boxes are 576 tetrahedra, fewer than fTetWild makes, small in the middle of the top.

    Boxes of one mesh also take the same number of Newton iterations each time.
    """
    lines = (
        1e-3 * np.array([0.0, 8.0, 14.0, 17.0, 20.0, 23.0, 26.0, 32.0, 40.0]),
        1e-3 * np.array([0.0, 4.0, 7.0, 10.0, 13.0, 16.0, 20.0]),
        1e-3 * np.array([0.0, 5.5, 10.0]),
    )
    monkeypatch.setattr(pressed_body, "mesh_body", lambda *_: skfem.MeshTet.init_tensor(*lines))


@pytest.mark.usefixtures("few_cells")
@pytest.mark.parametrize("slope", [(0.0, 0.0), (-0.2, 0.3), (0.3, -0.1)])
def test_a_ball_first_meets_a_slope_beside_its_axis_with_fine_cells_below(
    tmp_path, monkeypatch, slope
) -> None:
    near, few = [], pressed_body.mesh_body
    monkeypatch.setattr(pressed_body, "mesh_body", lambda *given: near.append(given[2]) or few())
    ball, axis = Sphere(0.004), np.array([0.022, 0.011])
    corners = np.array([[x, y, z] for z in (0, 0.010) for x in (0, 0.04) for y in (0, 0.02)])
    corners[4:, 2] += (corners[4:, :2] - axis) @ slope
    trimesh.convex.convex_hull(corners).export(tmp_path / "wedge.stl")
    surface = Surface(tmp_path / "wedge.stl")
    pads = tuple(Electrode(x, 0.01, 0.004, on="surface", z=0.0) for x in (0.01, 0.03))
    wedge = SensorDesign(surface, surface.height, pads, encapsulated_thickness=surface.height)
    press = BodyPress(wedge, [Touch(*axis, depth=1e-4, indenter=ball)], BARE, COARSE)
    rise = 0.004 * (np.linalg.norm([1.0, *slope]) - 1.0)
    assert press._lowest == pytest.approx([0.010 + rise], abs=1e-5)
    (below,) = near
    apart = np.linalg.norm(below[:, :2] - axis, axis=1)
    assert apart.max() == pytest.approx(ball.rims[1])
    assert below[:, 2] == pytest.approx(0.010 + (below[:, :2] - axis) @ slope, abs=1e-6)


@pytest.mark.usefixtures("few_cells")
def test_a_box_is_pressed_as_a_stack_of_hexahedra_is(design) -> None:
    """Depth and thinning by quadratic hexahedra of 2 to 5 mm, a rough indenter, 1 N."""
    touch = Touch(0.020, 0.010, force=1.0, indenter=Sphere(0.006))
    found = BodyPress(design, [touch], BARE, COARSE).equilibrium()
    assert found.forces == pytest.approx([1.0], rel=1e-6)
    assert found.depths == pytest.approx([1.957e-3], rel=0.08)
    assert found.thinnings == pytest.approx([0.201], rel=0.10)


# Scenes


@pytest.fixture(scope="module")
def sim(design):
    return Simulator(design, ((2,), COARSE), fixture=FreeArc(0.030))


def test_a_body_has_the_same_bits_every_time_by_its_shape_not_its_file(tmp_path, monkeypatch):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path / "cache"))
    resolution = ((1,), COARSE)
    for name in ("one", "other"):  # which the mesher alone fills with other cells each time
        (tmp_path / name).mkdir()
    body, copy = (box(tmp_path / name)[0] for name in ("one", "other"))
    first, again = ForwardModel(body, resolution), ForwardModel(copy, resolution)
    assert first.mesh.points.tobytes() == again.mesh.points.tobytes()
    assert first.impedance().tobytes() == again.impedance().tobytes()
    moved = dataclasses.replace(body, electrodes=body.electrodes[::-1][:3])
    ForwardModel(moved, resolution)
    assert len(list((tmp_path / "cache").glob("mesh-*.npz"))) == 2


@pytest.mark.usefixtures("few_cells")
def test_a_body_is_bent_pressed_and_both_and_refuses_other_scenes(
    sim, tmp_path, monkeypatch, design
):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    touch = Touch(0.020, 0.010, force=0.5, indenter=Sphere(0.010))
    pressed, bend = Scene(touches=(touch,)), Scene(bend=Bend(10.0))
    flat = sim.measure(Scene()).impedance
    changes = [
        np.abs(sim.measure(scene).impedance / flat - 1.0).max()
        for scene in (pressed, bend, Scene(bend=Bend(10.0), touches=(touch,)))
    ]
    assert min(changes) > 1e-4  # a pure bend changes each resistance little
    assert len(list(tmp_path.glob("body-*.npz"))) == 1
    (found,) = sim.presses(pressed)
    assert found.force == 0.5
    assert found.mean_pressure * found.contact_area == pytest.approx(0.5)
    assert 0.0 < found.thinning < 0.3
    beside = Touch(0.050, 0.010, force=1.0, indenter=Sphere(0.002))
    with pytest.raises(ConfigurationError, match="above the body"):
        sim.measure(Scene(touches=(beside,)))
    five = tuple(Touch(0.004 + 0.008 * k, 0.01, 1.0, Sphere(0.002)) for k in range(5))
    with pytest.raises(ConfigurationError, match="at most 4 touches"):
        sim.measure(Scene(touches=five))
    with pytest.raises(ConfigurationError, match="span"):
        ClampedBody(design, 0.040, 0.0)
