"""Discs, on prisms, against an integral equation."""

import numpy as np
import pytest

from eitskin.benchmarks.stability.closed_forms import shunt_resistance
from eitskin.geometry import Disc, Electrode, SensorDesign
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


def opposite(Z) -> complex:
    return Protocol.pairwise(2).measure(Z)[0]


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
    model = ForwardModel(disc([0, np.pi], 1.0, z), ((3,), Grading(1e-5, 1e-2, 0.7)))
    assert opposite(model.impedance()) * THICKNESS == pytest.approx(exact, rel=1e-4)


@pytest.mark.slow
def test_any_electrodes_on_a_disc() -> None:
    """All transfer impedances of seven unequal electrodes with unequal contacts."""
    rng = np.random.default_rng(4)
    angles = np.arange(7) * 2 * np.pi / 7 + rng.uniform(0, 0.3, 7)
    widths, z = rng.uniform(0.05, 0.5, 7), 10 ** rng.uniform(-6, 0, 7)
    exact = closed_forms.disc_impedance(angles, widths, z, points=32)
    Z = ForwardModel(disc(angles, widths, z), ((3,), Grading(1e-5, 1e-2, 0.7))).impedance()
    centring = np.eye(7) - 1 / 7
    contacts = centring @ np.diag(z / widths) @ centring
    body = exact - contacts
    assert pytest.approx(body, abs=3e-4 * np.abs(body).max()) == Z * THICKNESS - contacts
