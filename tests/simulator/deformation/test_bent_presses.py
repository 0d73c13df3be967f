"""Presses on a bent stack: invariance under rotations, frames, and the deformed layer."""

import dataclasses
import math
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eitskin.geometry import Bend, Clamp, ConfigurationError, Plates, Rectangle, Rigid, SensorDesign
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.simulator import Cylinder, Mechanics, Scene, Simulator, Touch
from eitskin.simulator.bends import bend_table, pressed_plates
from eitskin.simulator.bends.bend_3d import BentStack, ClampedStack
from eitskin.simulator.deformation.contact import ContactFrame, DentField
from eitskin.simulator.deformation.finite_stack import DentedSolid, FiniteStack
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.deformation.sensor_grid import OWN_GRID
from eitskin.simulator.deformation.solution_store import load_or_solve
from eitskin.simulator.deformation.solution_table import Axis
from eitskin.simulator.deformation.solved_correction import Correction
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.fitted_plan import Contact
from eitskin.simulator.mechanics.stack_mesh import Fineness, StackMesh, stack_mesh

MECHANICS, PUNCH = Mechanics(), Cylinder()
DESIGN = SensorDesign.reference()
STACK = MECHANICS.stack(DESIGN)
X, Y, TOP = 0.018, 0.013, 0.0085
TURN = Rotation.from_euler("yxz", [35.0, -8.0, 5.0], degrees=True).as_matrix()


class Homogeneous(Deformation):
    """Homogeneous deformation of a stack at a mean stress."""

    def __init__(self, F: np.ndarray, mean_stress: float = 0.0) -> None:
        self.F, self.stress = F, mean_stress

    def map_points(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved = points @ self.F.T + np.array([0.01, 0.02, -0.03])
        return moved, np.broadcast_to(self.F, (*points.shape[:-1], 3, 3))

    def mean_stress(self, points: np.ndarray) -> np.ndarray:
        return np.full(points.shape[:-1], self.stress)


@pytest.fixture(scope="module")
def dent():
    return AxisymmetricPress(STACK, PUNCH, PUNCH.radius / 6).to_depth(8e-4)


def meshed(stretches=(1.0, 1.0), support=None) -> StackMesh:
    contacts = [Contact(X, Y, PUNCH.radius, stretches)]
    fineness = Fineness(ends=0.0, sides=0.0, layers=1, rims=0.5)
    outline = Rectangle(0.050, 0.040)
    return stack_mesh(outline, STACK, MECHANICS, support or Rigid(), contacts, fineness)


def pressed(dent, bent) -> Correction:
    frame = None if bent is None else ContactFrame.from_bent_top(bent, X, Y, STACK)
    stretches = (1.0, 1.0) if frame is None else tuple(frame.stretches.tolist())
    stack = FiniteStack(meshed(stretches), bend=bent)
    return stack.correction([DentField(X, Y, PUNCH, dent, frame)])


@pytest.mark.slow
def test_presses_turn_with_their_sensor_and_stretched_stacks_carry_the_force(dent):
    """Its base is held where the stretch left it; 3 % is the quadrature of the dent."""
    level, turned = pressed(dent, None), pressed(dent, Homogeneous(TURN))
    places = np.random.default_rng(0).uniform((0.0, 0.0, 0.0), (0.050, 0.040, 0.012), (300, 3))
    moved = level.displacement(places)
    size = np.abs(moved).max()
    assert turned.displacement(places) == pytest.approx(moved @ TURN.T, abs=1e-4 * size)
    assert turned.sunk == pytest.approx(level.sunk, rel=1e-4)
    stretched = Homogeneous(TURN @ np.diag([1.15, 1.0, 1.0 / 1.15]))
    frame = ContactFrame.from_bent_top(stretched, X, Y, STACK)
    assert frame.stretches == pytest.approx([1.15, 1.0])
    stack = FiniteStack(meshed((1.15, 1.0)), bend=stretched)
    found = stack.correction([DentField(X, Y, PUNCH, dent, frame)])
    upwards = dent.force * TURN[:, 2]
    assert stack.reaction(found) == pytest.approx(upwards, abs=0.03 * dent.force)


@pytest.fixture(scope="module")
def bent_sensor() -> tuple[Simulator, Scene]:
    design = dataclasses.replace(DESIGN, support=Plates())
    return Simulator(design, "fast", touch_model="solved"), Scene(
        Bend(5.0), (Touch(0.075, 0.030, 2.0),)
    )


class Nothing:
    """Correction that is zero everywhere."""

    sunk, holding = np.zeros(1), np.zeros((1, 3))

    def displacement_and_gradient(self, columns: np.ndarray) -> np.ndarray:
        return np.zeros((12, columns.shape[1], len(columns)))

    def values(self, columns: np.ndarray) -> np.ndarray:
        return np.zeros((4, columns.shape[1], len(columns)))


@pytest.fixture
def unsolved(monkeypatch) -> list[BentStack | None]:
    """Bent states that solved presses were asked for; their corrections are left out."""
    asked: list[BentStack | None] = []

    def solve(sensor: PressedSensor, _: object) -> Nothing:
        asked.append(sensor.state)
        return Nothing()

    monkeypatch.setattr(PressedSensor, "solve", solve)
    return asked


@pytest.mark.slow
@pytest.mark.usefixtures("unsolved")
def test_the_bent_layer_is_the_bend_away_from_touches_with_gradients_of_its_positions(bent_sensor):
    sim, scene = bent_sensor
    both, alone = sim.deformation(scene), sim.deformation(Scene(scene.bend))
    away = np.array([[0.005, 0.030, 0.001], [0.145, 0.010, 0.004]])
    assert both.positions(away) == pytest.approx(alone.positions(away), abs=2e-6)
    under = np.array([0.075, 0.030, 0.005])
    sunk = both.positions(under) - alone.positions(under)
    assert sunk[2] < -4e-4
    assert math.hypot(*sunk[:2]) < 1e-6
    layer, h = sim.deformation(scene), 1e-6
    points = np.random.default_rng(2).uniform((0.062, 0.02, 0.0), (0.088, 0.04, 0.005), (40, 3))
    slopes = [
        (layer.positions(points + step) - layer.positions(points - step)) / (2.0 * h)
        for step in h * np.eye(3)
    ]
    assert layer.gradient(points) == pytest.approx(np.stack(slopes, axis=-1), abs=2e-4)


@pytest.mark.slow
def test_bends_are_in_equilibrium():
    """Its gradient and pressure leave no force on the free nodes of its own mesh."""
    design = dataclasses.replace(DESIGN, support=Plates())
    bent = bend_table.equilibrium(design, Clamp(), MECHANICS, Bend(5.0))
    mesh = ClampedStack(design, Clamp(faces="bottom"), MECHANICS).solid.mesh
    middles = mesh.p[:, mesh.t].mean(axis=1).T
    gel = np.all(np.abs(middles) < 0.5 * np.array([0.150, 0.060, 0.005]), axis=1)
    laws = (MECHANICS.encapsulation, MECHANICS.gel)
    solid = DentedSolid(mesh, laws, gel.astype(np.int64), MECHANICS.bulk_ratio)
    points = solid.points + np.array(bent.centre)
    forces = solid.state_residual(bent.gradient(points) - np.eye(3), bent.mean_stress(points), gel)
    nodal = solid.displacement(forces)
    x, y, z = solid.nodes.T
    on_plate = (z < -0.0059) & (x > 0.0199)
    free = ~on_plate & (x > 1e-9) & (y > 1e-9)
    assert np.abs(nodal[free]).max() < 1e-4 * np.abs(nodal[on_plate]).max()


def test_frames_turn_stresses_with_their_forces():
    F = TURN @ np.diag([1.2, 0.9, 0.8])
    frame = ContactFrame.from_bent_top(Homogeneous(F), X, Y, STACK)
    assert frame.rotation == pytest.approx(TURN, abs=1e-12)
    stress = np.random.default_rng(1).normal(size=(3, 3))
    # On flat faces of unit area across x, y and z lie 0.9, 1.2 and 1.2 x 0.9 of the bent top.
    assert frame.nominal(stress) == pytest.approx(TURN @ stress * [0.9, 1.2, 1.08])
    points = np.array([[X, Y, TOP], [X + 0.001, Y, TOP], [X, Y + 0.002, TOP]])
    assert frame.flatten_points(points) == pytest.approx(
        Homogeneous(F).positions(points), abs=1e-12
    )


def test_over_the_gap_a_solved_angle_follows_from_the_others():
    """In the shipped table, by the spline that lies between its angles."""
    design = dataclasses.replace(SensorDesign.reference(), support=Plates())
    held = dataclasses.replace(Clamp(), span=Plates().span)
    case = pressed_plates.nominal_case(design, held, MECHANICS, Cylinder(), OWN_GRID)
    problem = case.problem()
    assert problem.is_shipped
    table = load_or_solve(problem, pressed_plates._table)
    start, _ = Plates().gap(design.outline)
    angles, over = table.nodes("angle"), table.nodes("x") > start + 1e-3
    (weights,) = Axis("angle", "spline", angles[[0, 1, 3]]).weights(angles[2:3])[0]
    fields = (table.modes * table.scales)[..., :3].reshape(len(table.modes), -1)
    solved = table.amplitudes[over] @ np.linalg.cholesky(fields @ fields.T)
    missing = np.einsum("xyapr,a->xypr", solved[:, :, [0, 1, 3]], weights) - solved[:, :, 2]
    sizes = np.linalg.norm(solved[:, :, 2], axis=-1)
    assert (np.linalg.norm(missing, axis=-1) < 0.06 * sizes).all()


@pytest.mark.slow
@pytest.mark.parametrize(("angle", "x"), [(0.0, 0.075), (50.0, 0.068)])
def test_presses_over_a_gap_are_refused_from_the_force_that_the_refusal_names(unsolved, angle, x):
    """Unsolved, since that takes minutes; 6 N sink 12.2 mm at 50 degrees by the solution in 3D."""
    sensor = Simulator(dataclasses.replace(DESIGN, support=Plates()), "fast")

    def press(**to: float) -> None:
        sensor.presses(Scene(Bend(angle), (Touch(x, 0.030, **to),)))

    with pytest.raises(ConfigurationError, match="more than its thickness") as refusal:
        press(force=12.0)
    most = float(re.search(r"at most (\S+) N", str(refusal.value))[1])
    assert not unsolved
    assert 4.0 < most < 11.0
    press(force=most)
    assert len(unsolved) > 0
    with pytest.raises(ConfigurationError, match="sink"):
        press(force=most + 0.2)
    with pytest.raises(ConfigurationError, match="13 mm"):
        press(depth=0.013)
