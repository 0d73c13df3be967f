"""Finite stack under presses: equilibrium, symmetry, limits, supports and refusals."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Free, Plates, Polygon, Rectangle, Rigid, SensorDesign, Support
from eitskin.simulator import Cylinder, Mechanics, Sphere
from eitskin.simulator.deformation import finite_stack
from eitskin.simulator.deformation.contact import DentField
from eitskin.simulator.deformation.finite_stack import FiniteStack
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.fitted_plan import Contact
from eitskin.simulator.mechanics.stack_mesh import Fineness, StackMesh, _faces, stack_mesh

MECHANICS, PUNCH = Mechanics(), Cylinder()
STACK = MECHANICS.stack(SensorDesign.reference())
LENGTH, WIDTH, X, Y = 0.050, 0.040, 0.018, 0.013
TOP = 0.012
DEPTH, SMALL = 8e-4, 1e-5


@pytest.fixture(scope="module")
def dents():
    """Axisymmetric presses on a coarse mesh, by depth [m]."""
    press = AxisymmetricPress(STACK, PUNCH, PUNCH.radius / 6)
    return {depth: press.to_depth(depth) for depth in (SMALL, DEPTH)}


def meshed(x=X, y=Y, support: Support | None = None, size=(LENGTH, WIDTH), rims=0.5) -> StackMesh:
    contacts = [Contact(x, y, PUNCH.radius)]
    fineness = Fineness(ends=0.0, sides=0.0, layers=1, rims=rims)
    outline = Rectangle(*size)
    return stack_mesh(outline, STACK, MECHANICS, support or Rigid(), contacts, fineness)


@pytest.fixture(scope="module")
def stack() -> FiniteStack:
    return FiniteStack(meshed())


@pytest.fixture(scope="module")
def pressed(stack, dents):
    return stack.correction([DentField(X, Y, PUNCH, dents[DEPTH])])


def test_boxes_follow_the_sides_of_an_outline_along_x_and_y() -> None:
    """Gel and margin have the volumes of the L shape and of its surroundings."""
    end, leg, margin = 0.06, 0.035, MECHANICS.margin
    outline = Polygon(((0, 0), (end, 0), (end, leg), (leg, leg), (leg, end), (0, end)))
    assert _faces(outline) == [[(leg, 1.0)], [(leg, 1.0)]]
    contacts = [Contact(0.02, 0.02, PUNCH.radius)]
    coarse = Fineness(ends=0.0, sides=0.0, layers=1)
    body = stack_mesh(outline, STACK, MECHANICS, Rigid(), contacts, coarse)
    corners = body.mesh.p[:, body.mesh.t]
    volumes = np.prod(corners.max(axis=1) - corners.min(axis=1), axis=0)
    area = end**2 - (end - leg) ** 2
    assert volumes[body.gel_cells].sum() == pytest.approx(0.005 * area, rel=1e-9)
    around = (end + 2.0 * margin) ** 2 - (end - leg) ** 2
    assert volumes.sum() == pytest.approx(TOP * around, rel=0.01)  # corners of the margin are round


@pytest.mark.slow
def test_the_contact_sinks_and_neither_tilts_nor_slides(pressed) -> None:
    radii = np.array([0.0, 0.4, 0.7]) * PUNCH.radius  # springs end a part of a cell inside
    under = np.array([[X + r, Y, TOP] for r in radii] + [[X, Y - r, TOP] for r in radii])
    moved = pressed.displacement(under)
    assert 0.0 < pressed.sunk[0] < 0.1 * DEPTH
    assert moved[:, 2] == pytest.approx(np.full(6, -pressed.sunk[0]), rel=0.03)
    assert np.abs(moved[:, :2]).max() < 0.1 * pressed.sunk[0]
    beyond = pressed.displacement(np.array([[0.040, 0.030, TOP]]))
    assert np.linalg.norm(beyond) > 0.1 * pressed.sunk[0]


@pytest.mark.slow
def test_a_contact_takes_back_the_dent_of_another(dents) -> None:
    places = (0.015, 0.034)
    contacts = [Contact(x, Y, PUNCH.radius) for x in places]
    outline, coarse = Rectangle(LENGTH, WIDTH), Fineness(ends=0.0, sides=0.0, layers=1)
    both = FiniteStack(stack_mesh(outline, STACK, MECHANICS, Rigid(), contacts, coarse), 2)
    first, second = (DentField(x, Y, PUNCH, dents[DEPTH]) for x in places)
    found = both.correction([first, second])
    under = np.array([[places[0] + r, Y, TOP] for r in (-0.003, 0.0, 0.003)])
    beside = second.evaluate(under).displacement
    assert np.ptp(beside[:, 2]) > 0.01 * DEPTH  # the other dent alone would tilt the contact
    moved = beside + found.displacement(under)
    assert moved[:, 2] == pytest.approx(np.full(3, -found.sunk[0]), abs=2e-3 * DEPTH)
    assert np.abs(moved[:, :2]).max() < 0.15 * np.abs(beside).max()


@pytest.mark.slow
def test_cells_that_the_rim_of_a_contact_cuts_do_not_make_it_larger(pressed, dents) -> None:
    finer = FiniteStack(meshed(rims=0.25)).correction([DentField(X, Y, PUNCH, dents[DEPTH])])
    beside = np.random.default_rng(0).uniform((0.003, 0, 0.004), (0.035, 0.0045, 0.008), (400, 3))
    found, expected = (each.displacement.derivative(beside) for each in (pressed, finer))
    # Held up to the rim, they take 1.4 % from the strain beside the contact.
    assert np.vdot(found, expected) / np.vdot(expected, expected) == pytest.approx(1.0, abs=0.005)
    assert pressed.sunk == pytest.approx(finer.sunk, rel=0.012)


@pytest.mark.slow
def test_a_contact_smaller_than_a_cell_is_held() -> None:
    ball = Sphere(0.0075)
    dent = AxisymmetricPress(STACK, ball, ball.radius / 10).to_depth(2e-4)
    body = meshed()
    assert 2.0 * dent.contact_radius < np.diff(body.lines[0]).min()
    found = FiniteStack(body).correction([DentField(X, Y, ball, dent)])
    under = found.displacement(np.array([[X, Y, TOP]]))[0, 2]
    assert under == pytest.approx(-found.sunk[0], rel=0.1)


def test_a_dent_is_smooth_across_its_axis(dents) -> None:
    field = DentField(X, Y, PUNCH, dents[DEPTH])
    on, beside = (field.evaluate(np.array([[X + away, Y, 0.006]]))[1][0] for away in (0.0, 1e-6))
    assert on == pytest.approx(beside, abs=1e-4)
    assert on[0, 0] == pytest.approx(on[1, 1], rel=1e-3)
    assert np.linalg.det(np.eye(3) + on) == pytest.approx(1.0, abs=0.01)


def test_a_stack_that_needs_too_much_memory_is_refused(monkeypatch) -> None:
    monkeypatch.setattr(finite_stack, "_MAX_UNKNOWNS", 5_000)
    with pytest.raises(ConfigurationError, match=r"needs \d+ unknowns, of which 5000"):
        FiniteStack(meshed())


# Supports


@pytest.mark.slow
@pytest.mark.parametrize(
    "support", [Rigid(), Plates(0.020), Free()], ids=["base", "plates", "free"]
)
def test_what_holds_the_stack_carries_the_force_of_the_indenter(dents, support) -> None:
    """Dents and correction together; 3 % is the quadrature of the dent on coarse cells."""
    stack = FiniteStack(meshed(x=LENGTH / 2, y=WIDTH / 2, support=support))
    found = stack.correction([DentField(LENGTH / 2, WIDTH / 2, PUNCH, dents[SMALL])])
    count = len(stack.solid.nodes)
    forces = stack.solid.forces(found.unknowns)[: 3 * count].reshape(count, 3)
    held, base = np.zeros(count, dtype=bool), stack.solid.nodes[:, 2] < 1e-9
    held[stack.solid.facet_nodes(stack.body.facets("held"))] = True
    assert stack.reaction(found)[2] == pytest.approx(dents[SMALL].force, rel=0.03)
    assert forces.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-9)
    # The last step of Newton's method leaves its square.
    assert np.abs(forces[base & ~held]).max(initial=0.0) < 1e-3 * np.abs(forces[held]).max()


def area(body: StackMesh, face: str) -> float:
    """Area of a face [m2]."""
    corners = body.mesh.p[:, body.mesh.facets[:, body.facets(face)]]
    return float(np.sort(np.ptp(corners, axis=1), axis=0)[1:].prod(axis=0).sum())


def test_what_is_held_and_what_is_free_follows_the_support() -> None:
    margin = MECHANICS.margin
    length, width = LENGTH + 2 * margin, WIDTH + 2 * margin
    sides = 2 * (length + width) * TOP
    for support, held in (
        (Rigid(), length * width),
        (Plates(0.020), (length - 0.020) * width),
        (Free(), sides),
    ):
        body = meshed(support=support)
        areas = [area(body, face) for face in ("held", "sides", "top")]
        assert areas == pytest.approx([held, sides, length * width], abs=1e-9)
    gel = np.array([body.laws[k] == MECHANICS.gel for k in body.law_of_cell])
    middles = body.mesh.p[:, body.mesh.t].mean(axis=1)
    away = np.abs(middles - np.array([[LENGTH / 2], [WIDTH / 2], [TOP / 2]]))
    assert np.array_equal(gel, (away.T < (LENGTH / 2, WIDTH / 2, 0.0025)).all(axis=1))
    assert np.array_equal(np.flatnonzero(gel), np.sort(body.gel_cells))
