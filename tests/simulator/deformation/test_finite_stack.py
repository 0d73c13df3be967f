"""Presses solved in finite stacks, their plans and the grids of sensors."""

import dataclasses
import math

import elastic_forms
import numpy as np
import pytest

from eitskin.config import to_toml
from eitskin.datasets import Recipe
from eitskin.errors import ConfigurationError
from eitskin.geometry import (
    Clamp,
    Disc,
    Free,
    Plates,
    Polygon,
    Rectangle,
    Rigid,
    SensorDesign,
    Substrate,
    Support,
)
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import Cylinder, Mechanics, SensorGrid, Sphere, Touch
from eitskin.simulator.deformation import finite_stack
from eitskin.simulator.deformation.contact import DentField
from eitskin.simulator.deformation.finite_stack import FiniteStack
from eitskin.simulator.deformation.pressed_sensor import solved_presses
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, StackGrid, read_fixed
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.fitted_plan import Contact, fit_plan, unfit
from eitskin.simulator.mechanics.layer_stack import Sheet, Stack
from eitskin.simulator.mechanics.materials import NeoHookean
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


def test_boxes_follow_the_sides_and_what_is_held_the_support():
    """Gel and margin have the volumes of the L shape and of its surroundings."""
    end, leg, margin = 0.06, 0.035, MECHANICS.margin
    outline = Polygon(((0, 0), (end, 0), (end, leg), (leg, leg), (leg, end), (0, end)))
    assert _faces(outline) == [[(leg, 1.0)], [(leg, 1.0)]]
    contacts = [Contact(0.02, 0.02, PUNCH.radius)]
    coarse = Fineness(ends=0.0, sides=0.0, layers=1)
    body = stack_mesh(outline, STACK, MECHANICS, Rigid(), contacts, coarse)
    corners = body.mesh.p[:, body.mesh.t]
    volumes = np.prod(corners.max(axis=1) - corners.min(axis=1), axis=0)
    plan = end**2 - (end - leg) ** 2
    assert volumes[body.gel_cells].sum() == pytest.approx(0.005 * plan, rel=1e-9)
    around = (end + 2.0 * margin) ** 2 - (end - leg) ** 2
    assert volumes.sum() == pytest.approx(TOP * around, rel=0.01)  # corners of the margin are round
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


def test_lines_go_through_rims_and_sides_and_grow_with_the_distance_from_rims():
    margin, finest = MECHANICS.margin, 0.2 * PUNCH.radius
    lines = meshed(rims=0.2).lines
    for along, at, extent in zip(lines, (X, Y), (LENGTH, WIDTH), strict=False):
        rims = np.array([at - PUNCH.radius, at + PUNCH.radius])
        for place in (*rims, 0.0, extent, -margin, extent + margin):
            assert np.abs(along - place).min() < 1e-9
        middles = 0.5 * (along[1:] + along[:-1])
        away = np.abs(middles[:, None] - rims).min(axis=1)
        wanted = np.minimum(TOP, finest + 0.5 * away)
        shares = np.diff(along) / wanted
        assert 0.4 < shares.min() < shares.max() < 0.95  # cells are a whole number


@pytest.mark.slow
def test_contacts_sink_alone_and_neither_tilt_nor_grow_at_cut_cells(pressed, dents):
    radii = np.array([0.0, 0.4, 0.7]) * PUNCH.radius  # springs end a part of a cell inside
    under = np.array([[X + r, Y, TOP] for r in radii] + [[X, Y - r, TOP] for r in radii])
    moved = pressed.displacement(under)
    assert 0.0 < pressed.sunk[0] < 0.1 * DEPTH
    assert moved[:, 2] == pytest.approx(np.full(6, -pressed.sunk[0]), rel=0.03)
    assert np.abs(moved[:, :2]).max() < 0.1 * pressed.sunk[0]
    beyond = pressed.displacement(np.array([[0.040, 0.030, TOP]]))
    assert np.linalg.norm(beyond) > 0.1 * pressed.sunk[0]
    finer = FiniteStack(meshed(rims=0.25)).correction([DentField(X, Y, PUNCH, dents[DEPTH])])
    beside = np.random.default_rng(0).uniform((0.003, 0, 0.004), (0.035, 0.0045, 0.008), (400, 3))
    found, expected = (each.displacement.derivative(beside) for each in (pressed, finer))
    # Held up to the rim, they take 1.4 % from the strain beside the contact.
    assert np.vdot(found, expected) / np.vdot(expected, expected) == pytest.approx(1.0, abs=0.005)
    assert pressed.sunk == pytest.approx(finer.sunk, rel=0.012)


@pytest.mark.slow
def test_contacts_take_back_the_dents_of_others_also_smaller_than_a_cell(dents):
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
    ball = Sphere(0.0075)
    dent = AxisymmetricPress(STACK, ball, ball.radius / 10).to_depth(2e-4)
    body = meshed()
    assert 2.0 * dent.contact_radius < np.diff(body.lines[0]).min()
    found = FiniteStack(body).correction([DentField(X, Y, ball, dent)])
    under = found.displacement(np.array([[X, Y, TOP]]))[0, 2]
    assert under == pytest.approx(-found.sunk[0], rel=1.5e-3)


@pytest.mark.slow
def test_dents_are_smooth_and_stacks_beyond_the_memory_refused(dents, monkeypatch):
    field = DentField(X, Y, PUNCH, dents[DEPTH])
    on, beside = (field.evaluate(np.array([[X + away, Y, 0.006]]))[1][0] for away in (0.0, 1e-6))
    assert on == pytest.approx(beside, abs=1e-4)
    assert on[0, 0] == pytest.approx(on[1, 1], rel=1e-3)
    assert np.linalg.det(np.eye(3) + on) == pytest.approx(1.0, abs=0.01)
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


# Grids of sensors and substrates


GRID = SensorGrid(0.005, 1.4, 0.04, 0.008)


def test_designs_and_recipes_of_version_02_are_read_with_their_grid(tmp_path):
    fixture, mechanics = tmp_path / "fixture.toml", tmp_path / "mechanics.toml"
    fixture.write_text("span = 0.041\nsolved_span = 0.04\nsolved_offset = 0.008\n")
    mechanics.write_text("margin = 0.004\nsolved_thickness = 0.005\nsolved_ratio = 1.4\n")
    assert read_fixed(fixture, mechanics) == (Clamp(0.041), Mechanics(margin=0.004), GRID)
    assert read_fixed(None, None) == (Clamp(), Mechanics(), SensorGrid())
    mechanics.write_text(f"{to_toml(Mechanics())}\n[grid]\n{to_toml(GRID)}")
    assert read_fixed(None, mechanics) == (Clamp(), Mechanics(), GRID)
    mechanics.write_text("[grid]\nratio = 0.0\n")
    with pytest.raises(ConfigurationError, match="ratio"):
        read_fixed(None, mechanics)
    path = tmp_path / "old.toml"
    path.write_text(
        'name = "old"\nscenes = [{ state = "idle", count = 1 }]\n'
        "[fixture]\nspan = 0.041\nsolved_span = 0.04\n[mechanics]\nsolved_thickness = 0.005\n"
    )
    recipe = Recipe.from_toml(path)
    assert recipe.grid == SensorGrid(thickness=0.005, span=0.04)
    made = recipe.nominal(0)
    assert (made.fixture, made.grid) == (Clamp(0.041), GRID)
    path.write_text(recipe.to_toml())
    assert Recipe.from_toml(path) == recipe
    for old in (lambda: Mechanics(solved_thickness=0.005), lambda: Clamp(solved_span=0.04)):
        with pytest.warns(DeprecationWarning, match="SensorGrid"):
            assert old() in (Mechanics(), Clamp())


DESIGN = SensorDesign.reference()
SOFT = Substrate(0.010, 5e3)


def on(support: Support) -> Stack:
    return Mechanics().stack(dataclasses.replace(DESIGN, support=support))


def test_a_substrate_is_the_lowest_layer_interpolated_between_solved_moduli():
    """By four of them; the weights add up to one and reproduce a cubic."""
    found, rigid = on(SOFT), on(Rigid())
    assert found.sheets == (Sheet(0.010, NeoHookean(5e3)), *rigid.sheets)
    assert (found.gel, rigid.gel) == (2, 1)
    bare = dataclasses.replace(DESIGN, encapsulated_thickness=0.005)
    assert Mechanics().stack(bare).gel == 0
    assert Mechanics().stack(dataclasses.replace(bare, support=SOFT)).gel == 1
    design = dataclasses.replace(DESIGN, support=Substrate(0.010, 6e3))
    needed = list(StackGrid.from_design(design, Mechanics(), OWN_GRID).full_weights())
    moduli = [stack.sheets[0].law.shear_modulus for stack, _ in needed]
    assert moduli == pytest.approx([20e3 * 2.0 ** (k / 2) for k in (-5, -4, -3, -2)])
    assert all(stack.sheets[1:] == on(Rigid()).sheets for stack, _ in needed)
    for power in range(4):
        found = sum(np.log(mu) ** power * w for mu, (_, w) in zip(moduli, needed, strict=True))
        assert found == pytest.approx(np.log(6e3) ** power, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("support", [SOFT, Substrate(0.005, 1e6)])
def test_small_presses_are_those_of_linear_layers(support) -> None:
    """Smooth punch: its own pressure on the layers by Hankel transform gives its displacements."""
    stack, force = on(support), 1e-3
    found = AxisymmetricPress(stack, Cylinder(rough=False), 0.0075 / 8).to_force(force)
    sheets = [(sheet.thickness, sheet.law.shear_modulus) for sheet in stack.sheets]
    acting = np.trapezoid(2.0 * np.pi * found.radii * found.pressure, found.radii)
    heights = stack.levels[1:3]
    expected = elastic_forms.layered_deflection(
        sheets, heights, 0.0075, found.radii, found.pressure * force / acting
    )
    rows = np.searchsorted(found.z, np.array(heights) - 1e-9)
    assert -found.displacement[0, rows, 1] == pytest.approx(expected, rel=0.01)


# Plans fitted to outlines


MARGIN, CELL = 0.005, 0.0045
TURN = math.radians(30.0)
ROTATION = np.array([[math.cos(TURN), -math.sin(TURN)], [math.sin(TURN), math.cos(TURN)]])


def turned(length, width):
    """A rectangle turned by 30 degrees, and where its first corner is [m]."""
    points = np.array([[0.0, 0.0], [length, 0.0], [length, width], [0.0, width]]) @ ROTATION.T
    first = -points.min(axis=0)
    return Polygon(tuple(map(tuple, (points + first).tolist()))), first


def plan_of(outline, margin=MARGIN):
    lines = [
        np.linspace(-margin, extent + margin, round((extent + 2 * margin) / CELL))
        for extent in (outline.length, outline.width)
    ]
    return fit_plan(outline, tuple(lines), margin, 0.012, [Contact(0.02, 0.02, 0.002)])


def areas(points, quads):
    x, y = points[quads].transpose(2, 0, 1)
    return 0.5 * (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)


SHAPES = {
    "turned": (turned(0.06, 0.04)[0], 0.06 * 0.04, MARGIN * 0.2 + 4 * MARGIN**2),
    "triangle": (Polygon(((0.0, 0.0), (0.06, 0.0), (0.03, 0.05))), 1.5e-3, None),
    "arrow": (Polygon(((0.0, 0.0), (0.04, 0.02), (0.08, 0.0), (0.04, 0.06))), 1.6e-3, None),
    "disc": (Disc(0.03), math.pi * 9e-4, math.pi * (0.035**2 - 9e-4)),
}


@pytest.mark.parametrize(("outline", "gel", "ring"), SHAPES.values(), ids=SHAPES)
def test_cells_of_gel_and_margin_cover_both(outline, gel, ring) -> None:
    plan = plan_of(outline)
    size = areas(plan.points, plan.quads)
    assert size.min() > 0.0
    # Chords of the disc between nodes leave out a little.
    assert size[: plan.gel_quads].sum() == pytest.approx(
        gel, rel=5e-3 if ring and gel > 2.5e-3 else 1e-9
    )
    assert -outline.nearest(plan.points)[1].min() <= 2.0 * MARGIN + 1e-9  # at acute corners
    if ring:
        assert size[plan.gel_quads :].sum() == pytest.approx(ring, rel=1e-2)


def test_grids_find_their_places_and_refuse_parts_narrower_than_cells():
    outline, first = turned(0.06, 0.04)
    plan = plan_of(outline)
    points = np.random.default_rng(0).uniform((0.0, 0.0, 0.0), (0.06, 0.04, 0.01), (500, 3))
    points[:, :2] = points[:, :2] @ ROTATION.T + first
    places, slope = unfit(plan.shift, points)
    assert places[:, :2] + plan.shift(places) == pytest.approx(points[:, :2], abs=1e-9)
    step = np.array([1e-8, 0.0, 0.0])
    change = (unfit(plan.shift, points + step)[0] - unfit(plan.shift, points - step)[0]) / 2e-8
    assert np.median(np.abs(change - slope[..., 0])) < 1e-6  # but for points at edges of cells
    hourglass = Polygon(
        ((0.0, 0.0), (0.06, 0.0), (0.0284, 0.03), (0.06, 0.06), (0.0, 0.06), (0.028, 0.03))
    )
    with pytest.raises(ConfigurationError, match="narrower than the cells"):
        plan_of(hourglass)


@pytest.mark.slow
def test_a_press_does_not_depend_on_how_the_sensor_lies() -> None:
    # Stairs in place of the sides were 30 % off.
    reference = SensorDesign.reference()
    straight, (outline, first) = Rectangle(0.06, 0.04), turned(0.06, 0.04)
    place = np.array([0.025, 0.015])
    fields = []
    for shape, rotation, origin in ((straight, np.eye(2), np.zeros(2)), (outline, ROTATION, first)):
        design = dataclasses.replace(reference, outline=shape, electrodes=uniform(shape, 8))
        x, y = (rotation @ place + origin).tolist()
        correction = solved_presses(design, Mechanics(), (Touch(x, y, depth=0.002),))
        grid = np.stack(
            np.meshgrid([0.001, 0.02, 0.04, 0.059], [0.001, 0.02, 0.039], [0.001, 0.004]), -1
        )
        points = grid.reshape(-1, 3)
        points[:, :2] = points[:, :2] @ rotation.T + origin
        moved = correction.in_gel(points)[:, :3]
        fields.append(np.column_stack([moved[:, :2] @ rotation, moved[:, 2]]))
    error = np.linalg.norm(fields[1] - fields[0]) / np.linalg.norm(fields[0])
    assert error < 0.08
