"""Solids of NGSolve under indenters, by closed forms."""

import numpy as np
import pytest

from eitskin.benchmarks.reference_solid import (
    MixedSolid,
    Numerics,
    RoughContact,
    extrude,
    triangulate_box,
)
from eitskin.simulator import Cylinder, Sphere

pytest.importorskip("ngsolve", reason="needs the extra `reference` (NGSolve)")

MODULUS = 20.0  # kPa


def block(size, heights, fixed, indenter, reach, stiffness, bulk_ratio=1e4, numerics=None):
    """Quarter of a block with its lower face at z = 0, an indenter at its upper far corner."""
    numerics, corner, top = numerics or Numerics(far=2.0), np.full(2, size), heights[-1]
    circles = [] if reach > size else [corner]
    plan = triangulate_box((0.0, size, 0.0, size), [], circles, reach, numerics)

    def boundary(centre):
        for axis, end in enumerate((size, size, top)):
            if abs(centre[axis]) < 1e-9:
                return f"low {axis}"
            if abs(centre[axis] - end) < 1e-9:
                is_near = axis < 2 or np.linalg.norm(centre[:2] - corner) < reach
                return f"high {axis}" if is_near else "free"
        raise AssertionError(centre)

    mesh = extrude(*plan, heights, lambda _: "gel", boundary)
    place = np.array([*corner, top])
    contact = RoughContact(mesh, "high 2", indenter, stiffness, place)
    fixed = {"low 2": "xyz", "high 0": "x", "high 1": "y"} | fixed
    return MixedSolid(mesh, {"gel": MODULUS}, 3, fixed, [contact], bulk_ratio)


def test_a_compressed_block_has_its_law():
    walls, flat = {"low 0": "x", "low 1": "y"}, Cylinder(radius=0.1)
    solid = block(3.0, (0.0, 1.0, 2.0), walls, flat, 9.0, 1e7, bulk_ratio=10.0)
    (contact,), J = solid.contacts, 0.8
    P = MODULUS * J ** (-2 / 3) * (J - (2.0 + J**2) / (3.0 * J)) + 10.0 * MODULUS * (J - 1.0)
    contact.force = -P * 3.0**2
    solid.press()
    assert contact.step.Get() == pytest.approx((1.0 - J) * 2.0, rel=2e-5)
    assert contact.reaction(solid.displacement)[0] == pytest.approx(contact.force, rel=1e-9)


@pytest.mark.slow
def test_a_ball_on_an_incompressible_layer_sinks_as_in_closed_form():
    """Dimitriadis et al. 2002, for a layer that is bonded to its base; small strains."""
    radius, height, depth = 40.0, 20.0, 0.4
    chi = np.sqrt(radius * depth) / height
    thin = 1.0 + 1.133 * chi + 1.283 * chi**2 + 0.769 * chi**3 + 0.0975 * chi**4
    force = 16.0 / 3.0 * MODULUS * np.sqrt(radius) * depth**1.5 * thin
    sizes = Numerics(rim=3.0, inside=3.0, far=16.0)
    solid = block(28.0, (0.0, 15.0, height), {}, Sphere(1e-3 * radius), 6.0, 1e4, numerics=sizes)
    (contact,) = solid.contacts
    contact.force = 0.25 * force
    solid.press()
    assert contact.step.Get() == pytest.approx(depth, rel=0.03)
