"""Flat punches: waves on a half-space, the axisymmetric press, and equilibrium of tilted ones."""

import numpy as np
import pytest

from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.flat_punch import LayeredFace
from eitskin.simulator.mechanics.layer_stack import Sheet, Stack
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.scene.indenters import Cylinder, Footprint

LAYERS = Stack(tuple(Sheet(h, NeoHookean(mu)) for h, mu in ((3e-3, 28e3), (5e-3, 20e3))))


def covered(face, footprint):
    """Part of each pixel that a footprint covers."""
    x = face.x[:, None] + face.size * ((np.arange(8) + 0.5) / 8 - 0.5)
    points = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1)
    shape = len(face.x), 8, len(face.x), 8
    return (footprint.depth_inside(points.reshape(*shape, 2)) > 0.0).mean(axis=(1, 3))


def test_a_thick_layer_moves_under_waves_like_a_half_space() -> None:
    mu, half = 15e3, 0.01
    face = LayeredFace(Stack((Sheet(0.06, NeoHookean(mu)),)), half, 2.5e-4)
    k = 2.0 * np.pi * 2 / (2.0 * half)
    waves = np.zeros((3, len(face.x), len(face.x)))
    waves[2] = np.cos(k * face.x)[:, None]
    moved = face.motion(waves)
    np.testing.assert_allclose(moved[2], waves[2] / (2.0 * mu * k), atol=1e-3 / (2.0 * mu * k))
    assert np.abs(moved[:2]).max() < 1e-3 / (2.0 * mu * k)  # incompressible: level waves stay so
    inside = face.motion(waves, 0.06 - 1.0 / k)  # w falls as (1 + k z) exp(-k z), p as exp(-k z)
    np.testing.assert_allclose(inside[2], moved[2] * 2.0 / np.e, atol=2e-3 * np.abs(moved).max())
    np.testing.assert_allclose(inside[3], waves[2] / np.e, atol=2e-3)


@pytest.mark.parametrize("rough", [True, False])
def test_a_round_punch_is_that_of_the_axisymmetric_press(rough) -> None:
    press = AxisymmetricPress(LAYERS, Cylinder(5e-3, edge=0.02, rough=rough), finest=2e-4)
    found = press.to_depth(1e-4)
    face, wide = LayeredFace(LAYERS, 0.03, 8e-4), 2.0 * found.contact_radius
    disc = Footprint(length=wide, width=wide, round=True, rough=rough)
    pressed = face.solve_punch(covered(face, disc), rough)
    assert pressed.compliance == pytest.approx(found.depth / found.force, rel=0.02)


def test_a_punch_that_is_pressed_off_its_middle_tilts_and_pulls_nowhere() -> None:
    face = LayeredFace(LAYERS, 0.03, 1e-3)
    x, y = np.meshgrid(face.x, face.x, indexing="ij")
    central, shifted = (
        Footprint(corners=((a, -4e-3), (a + 0.02, -4e-3), (a + 0.02, 4e-3), (a, 4e-3)))
        for a in (-0.01, -0.003)
    )
    own, tilted = (face.solve_punch(covered(face, each), True) for each in (central, shifted))
    for pressed in (own, tilted):
        pressure = -pressed.tractions[2] * face.size**2
        force, *moments = (float((pressure * arm).sum()) for arm in (1.0, x, y))
        assert force == pytest.approx(1.0, rel=1e-6)
        assert np.abs(moments).max() < 1e-6
        assert pressure.min() > -1e-3
    assert tilted.compliance > 1.1 * own.compliance
