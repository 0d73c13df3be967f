"""Presses into layers against Hayes, Hertz, energy and symmetry."""

from functools import cache

import numpy as np
import pytest

from eitskin.benchmarks.stability.closed_forms import punched_layer
from eitskin.geometry import SensorDesign
from eitskin.simulator import Cylinder, Mechanics, Profile, Sphere
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Sheet, Stack
from eitskin.simulator.mechanics.load_stepping import SolidError
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.scene.indenters import penetration

MU = 20e3
REFERENCE = Mechanics().stack(SensorDesign.reference())


def layer(thickness, law=None) -> Stack:
    return Stack((Sheet(thickness, law or NeoHookean(MU)),), 1e5)


# Against closed forms


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ratio", "published"),
    [(0.2, 1.281), (1.0, 3.619), (2.0, 9.15)],
)
def test_a_flat_punch_on_a_bonded_layer_is_hayess(ratio, published) -> None:
    half_space = 8.0 * ratio
    assert punched_layer(ratio, 1.0, 0.5) == pytest.approx(published * half_space, rel=3e-4)
    h = 0.01
    punch = Cylinder(ratio * h, edge=0.02, rough=False)
    found = AxisymmetricPress(layer(h), punch, finest=punch.radius / 100).to_depth(
        1e-4 * min(1.0, ratio) * h
    )
    # The rim is round, so the punch is as wide as what it touches. The contact's spring gives a
    # little, most where the layer is stiffest.
    a = found.contact_radius
    assert found.force / (MU * found.depth) == pytest.approx(punched_layer(a, h, 0.5), rel=6e-3)


@pytest.mark.slow
def test_small_presses_are_hertzs_and_those_through_the_base_say_how_far():
    R = 0.01
    press = AxisymmetricPress(
        layer(0.1), Sphere(R, rough=False), finest=R / 200, band=(0.0, 0.08 * R), reach=0.1
    )
    found = press.to_depth(1.12e-5)
    modulus = 3 * MU / (1 - 0.5**2)
    assert found.force == pytest.approx(4 / 3 * modulus * R**0.5 * found.depth**1.5, rel=5e-3)
    assert found.contact_radius == pytest.approx(np.sqrt(R * found.depth), rel=0.03)
    peak = 1.5 * found.force / (np.pi * R * found.depth)
    assert found.pressure.max() == pytest.approx(peak, rel=0.03)
    press = AxisymmetricPress(layer(0.002), Cylinder(0.004), finest=2e-3)
    with pytest.raises(SolidError, match="m deep of") as error:
        press.to_depth(0.00208)
    assert 0.0 < error.value.reached < 1.0


# Invariants

INDENTERS = {
    "rough cylinder": Cylinder(),
    "rough sphere": Sphere(0.0075),
    "profile": Profile((0.0, 0.002, 0.004, 0.006), (0.0, 0.0002, 0.001, 0.003), rough=False),
}


@pytest.mark.slow
def test_a_dent_fades_before_its_wall_as_it_does_without_one():
    """A wall at eight thicknesses cuts it where the ends of thin sensors are."""
    H = REFERENCE.levels[-1]
    distance = H * np.arange(6.0, 11.0)
    near, far = (
        AxisymmetricPress(REFERENCE, Cylinder(), finest=0.003, reach=reach).to_depth(0.001)
        for reach in (None, 24.0 * H)
    )
    moved, expected = (
        np.abs([np.interp(distance, one.r, u, right=0.0) for u in one.displacement[..., 0].T])
        for one in (near, far)
    )
    np.testing.assert_allclose(moved.max(axis=0), expected.max(axis=0), rtol=0.02)


@cache
def deeper_and_deeper(name):
    """The reference under an indenter at 2 mm, and what was found on the way there."""
    press = AxisymmetricPress(REFERENCE, INDENTERS[name], finest=1.2e-3)
    return press, [press.to_depth(d) for d in np.linspace(4e-4, 2e-3, 5)]


@pytest.mark.slow
@pytest.mark.parametrize("name", INDENTERS)
def test_volume_force_and_work_are_balanced_and_stiffness_is_the_slope_of_forces(name) -> None:
    press, found = deeper_and_deeper(name)
    last, x, solid, contact = found[-1], press.unknowns, press.solid, press.contact
    assert last.volume_ratios == pytest.approx([1.0, 1.0, 1.0], abs=1e-5)
    assert 0.02 < last.thinning(1) < 0.5
    r, p = last.radii, last.pressure
    assert np.all(p >= 0.0)
    inside = r < last.contact_radius
    carried = np.trapezoid(2 * np.pi * r[inside] * p[inside], r[inside])
    # By the pressures at nodes, of which few lie under the rim: up to 9.4 % are apart.
    assert carried == pytest.approx(last.force, rel=0.10)
    base = np.flatnonzero(solid.nodes[:, 1] < 1e-12)
    reaction = solid.displacement(solid.forces(x))[base, 1].sum()
    assert reaction == pytest.approx(last.force, rel=1e-6)
    work = np.trapezoid([0.0, *(one.force for one in found)], [0.0, *(one.depth for one in found)])
    assert solid.energy(x) + contact.energy(x) == pytest.approx(work, rel=0.02)
    forces, K = contact.linearise(x)
    assert forces == pytest.approx(contact.forces(x))
    assert abs(K - K.T).max() <= 1e-9 * abs(K).max()
    v = np.random.default_rng(0).normal(size=len(x))
    step = 1e-12 * v / np.abs(v).max()  # small next to what is pressed in, far from the rim
    slope = (contact.forces(x + step) - contact.forces(x - step)) / 2
    assert K @ step == pytest.approx(slope, abs=2e-3 * np.abs(slope).max())


# Shapes of indenters


@pytest.mark.parametrize("name", INDENTERS)
def test_entry_is_a_distance_with_these_derivatives(name) -> None:
    indenter = INDENTERS[name]
    rng = np.random.default_rng(1)
    r, depth = rng.uniform(1e-4, 0.0068, 200), rng.uniform(1e-5, 5e-4, 200)
    height = indenter.profile(r)[0] + depth
    g, (radial, upward), _ = penetration(indenter, r, height)
    assert np.all((g > 0) & (g <= depth * (1 + 1e-9)))
    assert np.hypot(radial, upward) == pytest.approx(np.ones(200))
    step = 1e-8
    for along, across, slope in ((step, 0.0, radial), (0.0, step, upward)):
        ahead, *_ = penetration(indenter, r + along, height + across)
        behind, *_ = penetration(indenter, r - along, height - across)
        assert (ahead - behind) / (2 * step) == pytest.approx(slope, abs=2e-4)


def test_a_sphere_is_round() -> None:
    r, height = np.array([0.001, 0.003]), np.array([0.004, 0.006])
    g, _, _ = penetration(Sphere(0.0075), r, height)
    assert g == pytest.approx(0.0075 - np.hypot(r, 0.0075 - height))
