"""Bends of clamped stacks in 3D: theory, symmetry, volume and limits, and their tables."""

import itertools
import math

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Clamp, Disc, FreeArc, Hinge, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import Mechanics, SensorGrid, Simulator
from eitskin.simulator.bends import bend_3d, bend_table
from eitskin.simulator.bends.bend_3d import ClampedStack
from eitskin.simulator.bends.bend_table import BendTable, bend_problems, tabulate_bends
from eitskin.simulator.deformation.solution_store import missing, prepare
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.mechanics.materials import NeoHookean

pytestmark = pytest.mark.slow

COARSE = Grading(finest=4e-3, coarsest=8e-3, growth=0.5)


def plain(length, width, thickness):
    """A sensor without encapsulation and its material, so that theory has one modulus."""
    outline = Rectangle(length, width)
    design = SensorDesign(outline, thickness, uniform(outline, 4), encapsulated_thickness=thickness)
    rubber = NeoHookean(20e3)
    return design, Mechanics(rubber, rubber, margin=0.0)


@pytest.mark.parametrize("faces", ["both", "bottom"])
def test_lines_across_the_stack_are_finest_at_the_faces_that_are_held(faces):
    lines = bend_3d._heights(2e-3, 6e-3, Grading(2e-4, 2e-3, 0.5, layers=4), faces)
    steps = np.diff(lines)
    assert lines[[0, -1]] == pytest.approx([-6e-3, 6e-3])
    assert lines[np.abs(lines) < 2.1e-3] == pytest.approx(np.linspace(-2e-3, 2e-3, 5))
    assert steps[0] == pytest.approx(2e-4, rel=0.3)  # of a whole number of steps
    assert steps[-1] == pytest.approx(steps[0] if faces == "both" else 1e-3)


@pytest.fixture(scope="module")
def bent():
    """The reference sensor at 20 degrees."""
    stack = ClampedStack(SensorDesign.reference(), grading=COARSE)
    (found,) = stack.equilibria([20.0])
    return found


def points(n, low=(0.035, 0.0, 0.0), high=(0.115, 0.060, 0.005)):
    return np.random.default_rng(3).uniform(low, high, (*np.atleast_1d(n), 3))


def test_gradients_are_derivatives_plates_turn_and_bends_too_far_say_so(bent):
    X = points(200)
    steps = 1e-8 * np.eye(3)
    ends = [bent.positions(X + e) - bent.positions(X - e) for e in steps]
    slope = np.stack(ends, axis=-1) / 2e-8
    # Where a difference straddles two cells, it is of neither.
    error = np.abs(bent.gradient(X) - slope).max(axis=(1, 2))
    assert np.quantile(error, 0.98) < 1e-6
    J = np.linalg.det(bent.gradient(points(20_000)))
    assert J.mean() == pytest.approx(1.0, abs=2e-4)
    assert np.sqrt(np.mean((J - 1.0) ** 2)) < 0.005
    half = math.radians(10.0)
    X = np.array([[0.096, 0.0, z] for z in (-0.0035, 0.0085)] + [[0.15, 0.06, 0.0085]])
    x, z = X[:, 0] - 0.075, X[:, 2] - 0.0025 + 0.008
    turned = bent.positions(X) - np.array([0.075, 0.0, 0.0025 - 0.008])
    assert turned[:, 0] == pytest.approx(x * math.cos(half) + z * math.sin(half), abs=1e-12)
    assert turned[:, 2] == pytest.approx(z * math.cos(half) - x * math.sin(half), abs=1e-12)
    assert turned[:, 1] == pytest.approx(X[:, 1], abs=1e-12)
    design, stack = plain(0.060, 0.010, 0.010)
    clamped = ClampedStack(design, Clamp(0.012, 0.0), stack, Grading(6e-3, 0.012, 0.5))
    with pytest.raises(SolidError, match=r"\d+\.\d deg of 300 deg") as refusal:
        list(clamped.equilibria([20.0, 300.0]))
    assert 0.0 < refusal.value.reached < 1.0


def layered(length):
    """A slender sensor whose encapsulation is stiffer, with its E A and E I."""
    outline = Rectangle(length, 0.006)
    design = SensorDesign(outline, 0.006, uniform(outline, 4), encapsulated_thickness=0.010)
    gel, around = 3 * 20e3, 3 * 60e3
    EA = around * (1e-4 - 36e-6) + gel * 36e-6
    EI = (around * (1e-8 - 0.006**4) + gel * 0.006**4) / 12
    return design, Mechanics(NeoHookean(gel / 3), NeoHookean(around / 3), margin=0.002), EA, EI


@pytest.mark.parametrize(("offset", "faces"), [(0.0, "both"), (0.010, "both"), (0.010, "bottom")])
def test_small_bends_of_a_slender_beam_store_what_beam_theory_says(offset, faces) -> None:
    """U = (E I + E A d^2) theta^2 / (2 s); what clamps add to s is the same for every span."""
    design, stack, EA, EI = layered(0.190)
    angle, compliance = 0.05, []
    for span in (0.060, 0.120):
        grading = Grading(finest=3e-3, coarsest=0.010, growth=0.3)
        clamp = Clamp(span, offset, faces=faces)
        (found,) = ClampedStack(design, clamp, stack, grading).equilibria([angle])
        theta = math.radians(angle)
        assert found.moment == pytest.approx(2.0 * found.energy / theta, rel=2e-3)
        compliance.append(theta / found.moment)
    expected = 0.060 / (EI + EA * offset**2)
    # What plates below add depends a little on their length.
    tolerance = 0.01 if faces == "both" else 0.015
    assert compliance[1] - compliance[0] == pytest.approx(expected, rel=tolerance)


def test_a_wide_plate_bends_in_plane_strain_by_rivlins_flexure() -> None:
    """C = diag(lambda^2, 1, lambda^-2), lambda^2 = lambda_0^2 + 2 c Z, far from all edges."""
    design, stack = plain(0.080, 0.120, 0.004)
    theta, span = math.radians(60.0), 0.040
    unstretched = span * (1.0 - 0.5 * theta / math.tan(0.5 * theta)) / theta
    clamp = Clamp(span, unstretched)
    grading = Grading(finest=4e-3, coarsest=0.015, growth=0.4)
    (found,) = ClampedStack(design, clamp, stack, grading).equilibria([60.0])
    X = points(400, (0.036, 0.050, 0.0), (0.044, 0.070, 0.004))
    F = found.gradient(X)
    C = F.swapaxes(1, 2) @ F
    line = np.polynomial.Polynomial.fit(2.0 * (X[:, 2] - 0.002), C[:, 0, 0], 1).convert()
    kinematic = Hinge(span, unstretched, give=0.0, contraction=0.0).flexure(design, Bend(60.0))
    assert line.coef[1] == pytest.approx(kinematic.curvature, rel=0.05)
    assert line.coef[0] == pytest.approx(kinematic.stretch**2, abs=0.007)  # of strains of 0.1
    assert C[:, 1, 1] == pytest.approx(1.0, abs=5e-4)
    assert C[:, 2, 2] * C[:, 0, 0] == pytest.approx(1.0, abs=0.012)


@pytest.fixture(scope="module")
def short():
    return plain(0.060, 0.012, 0.006)


def test_faces_above_are_free_and_bonds_that_give_take_moment_away(short):
    design, materials = short
    point = np.array([0.055, 0.003, 0.006])
    moved = {}
    for faces in ("both", "bottom"):
        clamp = Clamp(0.020, 0.004, faces=faces)
        (found,) = ClampedStack(design, clamp, materials, COARSE).equilibria([20.0])
        below = found.positions(point - [0.0, 0.0, 0.006])
        moved[faces] = np.linalg.norm(found.positions(point) - below)
        assert np.linalg.det(found.gradient(point)) == pytest.approx(1.0, abs=0.02)
    assert moved["both"] == pytest.approx(0.006, abs=1e-12)
    assert abs(moved["bottom"] - 0.006) > 1e-6
    moments, energies = [], []
    for compliance in (0.0, 1e-11, 1e-8, 1e-7):
        clamp = Clamp(0.020, 0.004, compliance)
        (found,) = ClampedStack(design, clamp, materials, COARSE).equilibria([10.0])
        moments.append(found.moment)
        energies.append(found.energy)
    assert moments[1] == pytest.approx(moments[0], rel=1e-3)
    assert energies[1] == pytest.approx(energies[0], rel=1e-3)
    assert all(soft < 0.99 * stiff for stiff, soft in itertools.pairwise(moments[1:]))
    assert all(soft < 0.99 * stiff for stiff, soft in itertools.pairwise(energies[1:]))
    stack = ClampedStack(design, Clamp(0.020, 0.004, 1e-7, "bottom"), materials, COARSE)
    low, middle, high = stack.equilibria([9.9, 10.0, 10.1])
    slope = (high.energy - low.energy) / math.radians(0.2)
    assert middle.moment == pytest.approx(slope, rel=1e-4)


INSIDE = np.random.default_rng(1).uniform([0.0, 0.0, 0.0], [0.060, 0.012, 0.006], (500, 3))
CLAMP = Clamp(0.020, 0.004)
ANGLES = (-20.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0)


def nodes(table):
    """Nodes of a quarter of the gel (nx, ny, nz, 3)."""
    axes = (table.sizes[name] for name in "xyz")
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1) + table.sizes["centre"]


def displacements(table, angle=8.0):
    """Displacements of the nodes at an angle [m]."""
    X = nodes(table)
    return table.bent_layer(angle).positions(X) - X


@pytest.fixture(scope="module")
def stack():
    design, materials = plain(0.060, 0.012, 0.006)
    return ClampedStack(design, CLAMP, materials, COARSE)


@pytest.fixture(scope="module")
def table(stack):
    return BendTable.from_tables([(tabulate_bends(stack, ANGLES), 1.0)])


@pytest.fixture
def few_angles(monkeypatch, tmp_path):
    """An empty store, of few angles."""
    monkeypatch.setattr(bend_table, "ANGLES_DEG", (-5.0, 0.0, 5.0, 10.0))
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    bend_table.bend_table.cache_clear()
    return tmp_path


def test_bends_at_and_between_solved_ones_have_derivatives_and_mirrors(stack, table):
    X = nodes(table)
    for direct in stack.equilibria((-15.0, 10.0, 25.0)):
        between = table.bent_layer(direct.angle_deg)
        close = 1e-9 if direct.angle_deg in ANGLES else 5e-6
        assert between.positions(X) == pytest.approx(direct.positions(X), abs=close)
    assert table.bent_layer(0.0).positions(INSIDE) == pytest.approx(INSIDE, abs=1e-12)
    layer, steps = table.bent_layer(33.0), 1e-7 * np.eye(3)
    X = INSIDE * np.array([1.02, 1.02, 1.0]) - np.array([0.0006, 0.00012, 0.0])
    ends = [layer.positions(X + e) - layer.positions(X - e) for e in steps]
    sizes = table.sizes
    inside = np.all(np.abs(X - sizes["centre"]) < [sizes[name][-1] for name in "xyz"], axis=-1)
    difference = np.stack(ends, axis=-1) / 2e-7
    assert layer.gradient(X)[inside] == pytest.approx(difference[inside], abs=1e-6)
    for axis, line in enumerate((sizes["x"], sizes["y"])):
        for place in (*line[1:-1], 0.0):
            at = INSIDE.copy()
            at[:, axis] = sizes["centre"][axis] + place
            jump = layer.gradient(at + 1e-9 * steps[axis] / 1e-7) - layer.gradient(at)
            assert np.abs(jump).max() < 1e-4
    layer, centre = table.bent_layer(25.0), table.sizes["centre"]
    for signs in (np.array([-1.0, 1.0, 1.0]), np.array([1.0, -1.0, 1.0])):
        X = INSIDE - centre
        there = layer.positions(centre + signs * X) - centre
        here = layer.positions(centre + X) - centre
        assert there == pytest.approx(signs * here, abs=1e-14)


def test_solved_bends_are_stored_and_scale_exactly(few_angles) -> None:
    design, materials = plain(0.060, 0.012, 0.006)
    reports: list[tuple[int, int]] = []
    problems = bend_problems(design, CLAMP, materials)
    prepare(problems, lambda *done: reports.append(done))
    assert reports[-1] == (4, 4)
    assert not missing(problems)
    found = bend_table.bend_table(design, CLAMP, materials)
    direct = tabulate_bends(ClampedStack(design, CLAMP, materials), (-5.0, 0.0, 5.0, 10.0))
    assert displacements(found) == pytest.approx(direct.evaluate(angle=8.0)[0][0], abs=1e-7)
    (file,) = few_angles.glob("*.npz")
    # Twice as large and three times as stiff is the same solution.
    outline = Rectangle(0.120, 0.024)
    large = SensorDesign(outline, 0.012, uniform(outline, 4), encapsulated_thickness=0.012)
    stiff = Mechanics(NeoHookean(60e3), NeoHookean(60e3), margin=0.0)
    twice = bend_table.bend_table(large, Clamp(0.040, 0.008), stiff)
    assert [*few_angles.glob("*.npz")] == [file]
    assert displacements(twice) == pytest.approx(2.0 * displacements(found), abs=1e-12)


@pytest.mark.usefixtures("few_angles")
def test_bends_of_similar_sensors_are_interpolated(monkeypatch) -> None:
    """Direct solutions at the nodes, and close to direct ones between.

    The default mesh has a cell more at the span between, and one cell across this gel, whose error
    would hide that of the interpolation.
    """
    grading = Grading(finest=1.2e-3, coarsest=4.5e-3, growth=0.4)
    monkeypatch.setattr(bend_3d, "bend_grading", lambda _: grading)
    design, materials = plain(0.060, 0.012, 0.006)
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


def test_refusals_say_what_can_be_bent(table) -> None:
    disc = Disc(0.050)
    round_sensor = Simulator(SensorDesign(disc, 0.005, uniform(disc, 4)), "fast")
    for make, message in (
        (lambda: table.bent_layer(40.1), "from -20 to 40 deg, got 40.1"),
        (lambda: table.bent_layer(9.0).positions(INSIDE + 0.1), "kinematic fixture"),
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
