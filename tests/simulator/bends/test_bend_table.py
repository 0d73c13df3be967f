"""Bends between solved angles and solved sensors, and the store of solved bends."""

import math

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Clamp, Disc, FreeArc, Hinge, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import Mechanics, Scene, Simulator
from eitskin.simulator.bends import bend_3d, bend_table
from eitskin.simulator.bends.bend_3d import ClampedStack
from eitskin.simulator.bends.bend_table import BendTable, bend_problems, tabulate_bends
from eitskin.simulator.deformation.sensor_grid import SensorGrid
from eitskin.simulator.deformation.solution_store import missing, prepare
from eitskin.simulator.mechanics.materials import NeoHookean

COARSE = Grading(finest=4e-3, coarsest=8e-3, growth=0.5)
INSIDE = np.random.default_rng(1).uniform([0.0, 0.0, 0.0], [0.060, 0.012, 0.006], (500, 3))
CLAMP = Clamp(0.020, 0.004)
ALL_ANGLES = bend_table.ANGLES_DEG
ANGLES = (-20.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0)
# Relative changes of the 28 resistances of the reference sensor at 20 degrees by an independent
# finite-strain solution of the whole stack and the fine forward model; own error 0.3 %.
INDEPENDENT = [
    0.0108746, 0.0193516, 0.0185758, 0.0190825, 0.0087031, 0.0000690, -0.0001901, 0.0108858,
    0.0092472, 0.0087117, -0.0012589, 0.0087031, 0.0092382, -0.0001900, 0.0000696, 0.0087117,
    0.0190825, 0.0185761, -0.0001900, 0.0092472, 0.0185758, 0.0179727, 0.0108858, 0.0193516,
    0.0185761, 0.0108746, 0.0092382, -0.0001901,
]  # fmt: skip


def short(length=0.060, thickness=0.006, modulus=20e3):
    """A small sensor without encapsulation, and its material."""
    outline = Rectangle(length, 0.012)
    contacts = uniform(outline, 4)
    design = SensorDesign(outline, thickness, contacts, encapsulated_thickness=thickness)
    rubber = NeoHookean(modulus)
    return design, Mechanics(rubber, rubber, margin=0.0)


def solved(table):
    """The one solution of a table."""
    ((solution, _),) = table.tables
    return solution


def nodes(table):
    """Nodes of a quarter of the gel (nx, ny, nz, 3)."""
    sizes = solved(table).sizes
    axes = (sizes[name] for name in "xyz")
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) + sizes["centre"]


def displacements(table, angle=8.0):
    """Displacements of the nodes at an angle [m]."""
    return solved(table).evaluate(angle=angle)[0][0]


@pytest.fixture(scope="module")
def stack():
    design, materials = short()
    return ClampedStack(design, CLAMP, materials, COARSE)


@pytest.fixture(scope="module")
def table(stack):
    return BendTable(((tabulate_bends(stack, ANGLES), 1.0),))


@pytest.fixture
def few_angles(monkeypatch, tmp_path):
    """An empty store, of few angles."""
    monkeypatch.setattr(bend_table, "ANGLES_DEG", (-5.0, 0.0, 5.0, 10.0))
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    bend_table.bend_table.cache_clear()
    return tmp_path


@pytest.mark.parametrize("angle", [-15.0, 5.0, 25.0])
def test_bends_between_the_solved_ones(stack, table, angle) -> None:
    (direct,) = stack.equilibria([angle])
    between = table.bent_layer(angle)
    X = nodes(table)
    assert between.positions(X) == pytest.approx(direct.positions(X), abs=5e-6)
    assert between.energy == pytest.approx(direct.energy, rel=5e-3)
    assert between.moment == pytest.approx(direct.moment, rel=2e-2)


def test_nodes_and_the_flat_bend_are_met(stack, table) -> None:
    X = nodes(table)
    for direct in stack.equilibria(ANGLES):
        layer = table.bent_layer(direct.angle_deg)
        assert layer.positions(X) == pytest.approx(direct.positions(X), abs=1e-9)
        assert (layer.energy, layer.moment) == pytest.approx((direct.energy, direct.moment))
    assert table.bent_layer(0.0).positions(INSIDE) == pytest.approx(INSIDE, abs=1e-12)


def test_gradient_is_the_continuous_derivative_of_positions_beyond_the_gel_too(table) -> None:
    layer, steps = table.bent_layer(33.0), 1e-7 * np.eye(3)
    X = INSIDE * np.array([1.02, 1.02, 1.0]) - np.array([0.0006, 0.00012, 0.0])
    ends = [layer.positions(X + e) - layer.positions(X - e) for e in steps]
    sizes = solved(table).sizes
    inside = np.all(np.abs(X - sizes["centre"]) < [sizes[name][-1] for name in "xyz"], axis=-1)
    difference = np.stack(ends, axis=-1) / 2e-7
    assert layer.gradient(X)[inside] == pytest.approx(difference[inside], abs=1e-6)
    for axis, line in enumerate((sizes["x"], sizes["y"])):
        for place in (*line[1:-1], 0.0):
            at = INSIDE.copy()
            at[:, axis] = sizes["centre"][axis] + place
            jump = layer.gradient(at + 1e-9 * steps[axis] / 1e-7) - layer.gradient(at)
            assert np.abs(jump).max() < 1e-4


def test_left_mirrors_right_and_front_mirrors_back(table) -> None:
    layer, centre = table.bent_layer(25.0), solved(table).sizes["centre"]
    for signs in (np.array([-1.0, 1.0, 1.0]), np.array([1.0, -1.0, 1.0])):
        X = INSIDE - centre
        there = layer.positions(centre + signs * X) - centre
        here = layer.positions(centre + X) - centre
        assert there == pytest.approx(signs * here, abs=1e-14)


@pytest.mark.slow
def test_the_reference_sensor_bends_as_an_independent_solution_has_it() -> None:
    sim = Simulator(SensorDesign.reference(), "standard")
    flat = sim.protocol.measure(sim.model.impedance()).real
    layer = bend_table.bend(sim.design, Clamp(), sim.mechanics, Bend(20.0))
    change = sim.simulate_deformation(layer).impedance.real / flat - 1.0
    assert np.linalg.norm(change - INDEPENDENT) < 0.005 * np.linalg.norm(INDEPENDENT)


@pytest.mark.slow
def test_solved_bends_are_stored_and_scale_exactly(few_angles) -> None:
    design, materials = short()
    reports: list[tuple[int, int]] = []
    problems = bend_problems(design, CLAMP, materials)
    prepare(problems, lambda *done: reports.append(done))
    assert reports[-1] == (4, 4)
    assert not missing(problems)
    found = bend_table.bend_table(design, CLAMP, materials)
    direct = tabulate_bends(ClampedStack(design, CLAMP, materials), (-5.0, 0.0, 5.0, 10.0))
    assert displacements(found) == pytest.approx(direct.evaluate(angle=8.0)[0][0], abs=1e-7)
    moments = solved(found).numbers["moment"]
    assert moments == pytest.approx(direct.numbers["moment"], rel=1e-6)
    (file,) = few_angles.glob("*.npz")
    # Twice as large and three times as stiff is the same solution.
    outline = Rectangle(0.120, 0.024)
    large = SensorDesign(outline, 0.012, uniform(outline, 4), encapsulated_thickness=0.012)
    stiff = Mechanics(NeoHookean(60e3), NeoHookean(60e3), margin=0.0)
    twice = bend_table.bend_table(large, Clamp(0.040, 0.008), stiff)
    assert [*few_angles.glob("*.npz")] == [file]
    assert displacements(twice) == pytest.approx(2.0 * displacements(found), abs=1e-12)
    assert solved(twice).numbers["moment"] == pytest.approx(24.0 * moments)
    # A damaged file is solved again.
    file.write_bytes(file.read_bytes()[:1000])
    bend_table.bend_table.cache_clear()
    again = bend_table.bend_table(design, CLAMP, materials)
    assert displacements(again) == pytest.approx(displacements(found), abs=1e-12)


@pytest.mark.slow
@pytest.mark.usefixtures("few_angles")
def test_bends_of_similar_sensors_are_interpolated(monkeypatch) -> None:
    """Direct solutions at the nodes, and close to direct ones between.

    The default mesh has a cell more at the span between, and one cell across this gel, whose error
    would hide that of the interpolation.
    """
    grading = Grading(finest=1.2e-3, coarsest=4.5e-3, growth=0.4)
    monkeypatch.setattr(bend_3d, "bend_grading", lambda _: grading)
    design, materials = short()
    grid = SensorGrid(span=0.020, offset=0.004)
    node, between = Clamp(0.0208, 0.004), Clamp(0.0204, 0.0042)
    for shared in ((), (grid,)):
        assert len(bend_problems(design, node, materials, *shared)) == 1
    assert len(bend_problems(design, between, materials, grid)) == 5
    found = bend_table.bend_table(design, between, materials, grid)
    direct = bend_table.bend_table(design, Clamp(0.0204, 0.0042), materials)
    nominal = bend_table.bend_table(design, CLAMP, materials)
    at = (found.bent_layer(8.0), direct.bent_layer(8.0), nominal.bent_layer(8.0))
    mine, true, first = (each.gradient(INSIDE) for each in at)
    assert np.linalg.norm(mine - true) < 0.05 * np.linalg.norm(first - true)
    assert at[0].energy == pytest.approx(at[1].energy, rel=5e-3)


def test_refusals_say_what_can_be_bent(table) -> None:
    disc = Disc(0.050)
    round_sensor = Simulator(SensorDesign(disc, 0.005, uniform(disc, 4)), "fast")
    for make, message in (
        (lambda: table.bent_layer(40.1), "from -20 to 40 deg, got 40.1"),
        (lambda: table.bent_layer(math.nan), "from -20 to 40 deg"),
        (lambda: table.bent_layer(9.0).positions(INSIDE + 0.1), "kinematic fixture"),
        (lambda: Clamp(span=-1.0), "span"),
        (lambda: Clamp(offset=math.inf), "offset"),
        (lambda: Clamp(compliance=-1.0), "compliance"),
        (lambda: Clamp(faces="top"), "'both' or 'bottom'"),
        (lambda: SensorGrid(span=0.0), "span"),
        (lambda: round_sensor.measure(Scene(Bend(10.0))), r"Disc.*choose a kinematic fixture"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            make()
    for fixture in (Hinge(span=0.03), FreeArc(0.03)):
        assert isinstance(
            bend_table.bend(round_sensor.design, fixture, Mechanics(), Bend(10.0)).positions(
                np.zeros((1, 3))
            ),
            np.ndarray,
        )


def test_a_table_needs_four_angles_about_zero(stack) -> None:
    for angles in ([10.0, 20.0, 30.0, 40.0], [-10.0, 0.0, 10.0]):
        with pytest.raises(ConfigurationError, match="four angles"):
            tabulate_bends(stack, angles)
