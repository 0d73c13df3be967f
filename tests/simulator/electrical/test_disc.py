"""Discs and true annular sectors, on prisms: closed forms and an integral equation."""

import numpy as np
import pytest

from eitskin.benchmarks.stability.closed_forms import shunt_resistance
from eitskin.geometry import Disc, Electrode, Polygon, SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import ForwardModel, Protocol

import closed_forms

RADIUS, THICKNESS = 0.1, 0.01


def disc(angles, widths, z) -> SensorDesign:
    """Electrodes `widths` rad wide; z in units of the radius, as sigma = 1 S/m."""
    angles, widths, z = np.broadcast_arrays(angles, widths, z)
    electrodes = tuple(
        Electrode(*(RADIUS * (1 + np.array([np.cos(a), np.sin(a)]))), w * RADIUS, one * RADIUS)
        for a, w, one in zip(angles, widths, z.tolist(), strict=True)
    )
    return SensorDesign(Disc(RADIUS), THICKNESS, electrodes)


def grading(coarsest, finest=1e-5, growth=0.7) -> Grading:
    return Grading(finest, coarsest, growth, layers=1)


def opposite(Z) -> complex:
    return Protocol.pairwise(2).measure(Z)[0]


# Two opposite electrodes, 1 rad wide


def test_integral_equation_meets_the_shunt_limit() -> None:
    """z -> 0 is K(1-m) / K(m) too: the disc is a half-plane, m the cross-ratio of four chords."""
    m = np.sin(0.5) ** 2
    exact = shunt_resistance(m, 1 - m)
    Z = closed_forms.disc_impedance([0, np.pi], 1.0, 1e-14)
    assert opposite(Z) == pytest.approx(exact, rel=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("z", "exact"), [(1e-4, 1.310523), (1e-2, 1.341904)])
def test_two_opposite_electrodes_on_a_disc(z, exact) -> None:
    """The verification table says 1.310589 and 1.341943: 5e-5 and 3e-5 more."""
    R = opposite(closed_forms.disc_impedance([0, np.pi], 1.0, z, points=100))
    assert R == pytest.approx(exact, abs=1.5e-6)
    model = ForwardModel(disc([0, np.pi], 1.0, z), ((3,), grading(1e-2)))
    assert opposite(model.impedance()) * THICKNESS == pytest.approx(exact, rel=1e-4)


@pytest.mark.slow
def test_any_electrodes_on_a_disc() -> None:
    """All transfer impedances of seven unequal electrodes with unequal contacts."""
    rng = np.random.default_rng(4)
    angles = np.arange(7) * 2 * np.pi / 7 + rng.uniform(0, 0.3, 7)
    widths, z = rng.uniform(0.05, 0.5, 7), 10 ** rng.uniform(-6, 0, 7)
    exact = closed_forms.disc_impedance(angles, widths, z, points=32)
    Z = ForwardModel(disc(angles, widths, z), ((3,), grading(1e-2))).impedance()
    centring = np.eye(7) - 1 / 7
    contacts = centring @ np.diag(z / widths) @ centring
    body = exact - contacts
    assert pytest.approx(body, abs=3e-4 * np.abs(body).max()) == Z * THICKNESS - contacts


# Currents cos(n phi) on 16 contacts so bad that they leave evenly

COUNT, SHARE = 16, 0.2
ANGLES = np.arange(COUNT) * 2 * np.pi / COUNT


def eigenvalue(Z, n) -> float:
    pattern = np.cos(n * ANGLES)
    return pattern @ Z @ pattern / (pattern @ pattern) * THICKNESS


def exact_eigenvalue(n, ratio, radius) -> float:
    return closed_forms.ring_of_gap_electrodes(
        n, COUNT, SHARE, lambda m: closed_forms.concentric_disc(m, ratio, radius)
    )


@pytest.mark.slow
def test_contacts_on_an_arc_have_their_true_area() -> None:
    """z / A, two thousand times what the body adds, can be taken off."""
    z = 1e3
    Z = ForwardModel(disc(ANGLES, SHARE, z), ((3,), grading(1e-2, 1e-3))).impedance()
    for n in (1, 2, 3):
        body = eigenvalue(Z, n) - z / SHARE
        assert body == pytest.approx(exact_eigenvalue(n, 1.0, 0.5), rel=1e-3)


@pytest.mark.parametrize(("ratio", "close"), [(0.2, 0.02), (5.0, 0.05)])
def test_concentric_disc(ratio, close) -> None:
    """Change of R by the inner disc.

    The mesh does not know the inner circle; `test_closed_forms` has it on a mesh that does.
    """
    radius = 0.6
    model = ForwardModel(disc(ANGLES, SHARE, 1e3), ((3,), grading(1e-2, 1e-2)))

    def conductivity(x):
        inside = np.hypot(x[..., 0] - RADIUS, x[..., 1] - RADIUS) < radius * RADIUS
        return np.where(inside, ratio, 1.0)

    Z = model.impedance(conductivity) - model.impedance()
    for n in (1, 2, 3):
        added = exact_eigenvalue(n, ratio, radius) - exact_eigenvalue(n, 1.0, radius)
        assert eigenvalue(Z, n) == pytest.approx(added, rel=close)


# An annular sector as it is


def sector(angle, inner, outer, sides):
    """Corners (k, 2) of an annular sector, its arcs cut into `sides`; the outer arc first."""
    turn = np.linspace(0, angle, sides + 1)
    arc = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    points = np.concatenate([outer * arc, inner * arc[::-1]])
    return points - points.min(axis=0)


def test_annular_sector_between_its_straight_ends() -> None:
    """Polygons with more and more sides: errors fall at least like their sagitta, h^2."""
    angle, inner, outer, z = 2.0, 0.02, 0.05, 1e-9
    exact = closed_forms.sector_between_ends(angle, inner, outer)
    errors = []
    for sides in (10, 20):
        points = sector(angle, inner, outer, sides)
        ends = (points[[0, -1]].mean(axis=0), points[sides : sides + 2].mean(axis=0))
        electrodes = tuple(Electrode(*end.tolist(), outer - inner, z) for end in ends)
        design = SensorDesign(Polygon(tuple(map(tuple, points.tolist()))), THICKNESS, electrodes)
        R = opposite(ForwardModel(design, ((3,), grading(5e-3, 5e-3))).impedance())
        errors.append(abs(R * THICKNESS / exact - 1))
    assert errors[1] < 3e-5
    assert errors[0] > 4 * errors[1]
