"""The 3D bend against theory, symmetry, conserved volume and rigid limits, and its table."""

import itertools
import math

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Clamp, Disc, Hinge, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import Mechanics
from eitskin.simulator.bends.bend_3d import ClampedStack
from eitskin.simulator.mechanics.box_fields import QuadraticField
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.mechanics.materials import NeoHookean

COARSE = Grading(finest=4e-3, coarsest=8e-3, growth=0.5)


def plain(length, width, thickness):
    """A sensor without encapsulation and its material, so that theory has one modulus."""
    outline = Rectangle(length, width)
    design = SensorDesign(outline, thickness, uniform(outline, 4), encapsulated_thickness=thickness)
    rubber = NeoHookean(20e3)
    return design, Mechanics(rubber, rubber, margin=0.0)


@pytest.fixture(scope="module")
def bent():
    """The reference sensor at 20 degrees."""
    stack = ClampedStack(SensorDesign.reference(), grading=COARSE)
    (found,) = stack.equilibria([20.0])
    return found


def points(n, low=(0.035, 0.0, 0.0), high=(0.115, 0.060, 0.005)):
    return np.random.default_rng(3).uniform(low, high, (*np.atleast_1d(n), 3))


def test_a_quadratic_is_its_own_interpolant() -> None:
    lines = (np.array([0.0, 0.3, 1.0]), np.array([-1.0, 0.5]), np.array([0.0, 0.2, 0.3]))

    def value(x, y, z):
        return np.stack([x**2 * y**2 * z**2, 1.0 + x * y - z**2], axis=-1)

    def slope(x, y, z):
        first = [2 * x * (y * z) ** 2, 2 * y * (x * z) ** 2, 2 * z * (x * y) ** 2]
        return np.stack([np.stack(first, axis=-1), np.stack([y, x, -2 * z], axis=-1)], axis=-2)

    halved = [np.interp(np.arange(2 * len(x) - 1) / 2, np.arange(len(x)), x) for x in lines]
    field = QuadraticField(lines, value(*np.meshgrid(*halved, indexing="ij")))
    X = points((4, 50), (0.0, -1.0, 0.0), (1.0, 0.5, 0.3))
    assert field(X) == pytest.approx(value(*np.moveaxis(X, -1, 0)), abs=1e-12)
    assert field.derivative(X) == pytest.approx(slope(*np.moveaxis(X, -1, 0)), abs=1e-12)


@pytest.mark.slow
def test_gradient_is_the_derivative_of_positions_and_keeps_volume(bent) -> None:
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


def test_plates_turn_what_they_hold_by_half_the_angle_about_the_axis(bent) -> None:
    half = math.radians(10.0)
    X = np.array([[0.096, 0.0, z] for z in (-0.0035, 0.0085)] + [[0.15, 0.06, 0.0085]])
    x, z = X[:, 0] - 0.075, X[:, 2] - 0.0025 + 0.008
    turned = bent.positions(X) - np.array([0.075, 0.0, 0.0025 - 0.008])
    assert turned[:, 0] == pytest.approx(x * math.cos(half) + z * math.sin(half), abs=1e-12)
    assert turned[:, 2] == pytest.approx(z * math.cos(half) - x * math.sin(half), abs=1e-12)
    assert turned[:, 1] == pytest.approx(X[:, 1], abs=1e-12)


def layered(length):
    """A slender sensor whose encapsulation is stiffer, with its E A and E I."""
    outline = Rectangle(length, 0.006)
    design = SensorDesign(outline, 0.006, uniform(outline, 4), encapsulated_thickness=0.010)
    gel, around = 3 * 20e3, 3 * 60e3
    EA = around * (1e-4 - 36e-6) + gel * 36e-6
    EI = (around * (1e-8 - 0.006**4) + gel * 0.006**4) / 12
    return design, Mechanics(NeoHookean(gel / 3), NeoHookean(around / 3), margin=0.002), EA, EI


@pytest.mark.slow
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


def test_what_cannot_be_bent_is_refused(bent) -> None:
    reference, disc = SensorDesign.reference(), Disc(0.050)
    for make, message in (
        (lambda: bent.positions(np.array([0.075, 0.030, 0.010])), "outside"),
        (lambda: ClampedStack(reference, Clamp(span=0.155)), "span"),
        (lambda: Mechanics(margin=-1e-3), "margin"),
        (lambda: ClampedStack(SensorDesign(disc, 0.005, uniform(disc, 4))), "rectangular"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            make()


@pytest.mark.slow
def test_a_bend_too_far_says_how_far_it_got() -> None:
    design, stack = plain(0.060, 0.010, 0.010)
    clamped = ClampedStack(design, Clamp(0.012, 0.0), stack, Grading(6e-3, 0.012, 0.5))
    with pytest.raises(SolidError, match=r"\d+\.\d deg of 300 deg") as refusal:
        list(clamped.equilibria([20.0, 300.0]))
    assert 0.0 < refusal.value.reached < 1.0


@pytest.fixture(scope="module")
def short():
    return plain(0.060, 0.012, 0.006)


def test_faces_above_are_free_where_only_those_below_are_held(short) -> None:
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


def test_a_bond_that_gives_takes_moment_away_and_a_stiff_bond_is_rigid(short) -> None:
    design, materials = short
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


def test_the_moment_of_a_soft_bond_is_the_slope_of_the_energy(short) -> None:
    design, materials = short
    stack = ClampedStack(design, Clamp(0.020, 0.004, 1e-7, "bottom"), materials, COARSE)
    low, middle, high = stack.equilibria([9.9, 10.0, 10.1])
    slope = (high.energy - low.energy) / math.radians(0.2)
    assert middle.moment == pytest.approx(slope, rel=1e-4)
