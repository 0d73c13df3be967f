"""Reference solutions of presses, by NGSolve."""

import pytest

from eitskin.benchmarks.pressed_reference import (
    HeldContact,
    MixedSolid,
    Numerics,
    ReferenceStack,
    extrude,
    triangulate_box,
)
from eitskin.benchmarks.world import cases

ngsolve = pytest.importorskip("ngsolve", reason="needs the extra `reference` (NGSolve)")

LENGTH, WIDTH, HEIGHT = 4.0, 3.0, 2.0
AREA = LENGTH * WIDTH


def block(fixed, moduli, bulk_ratio=1e4, order=3):
    """Block of two layers, with its lower face at z = 0."""
    box = (0.0, LENGTH, 0.0, WIDTH)
    points, triangles = triangulate_box(box, [], [], 1.0, Numerics(far=2.0))

    def boundary(centre):
        for axis, end in enumerate((LENGTH, WIDTH, HEIGHT)):
            if abs(centre[axis]) < 1e-9:
                return f"low {axis}"
            if abs(centre[axis] - end) < 1e-9:
                return f"high {axis}"
        raise AssertionError(centre)

    heights = (0.0, 0.5 * HEIGHT, HEIGHT)
    material = lambda c: "lower" if c[2] < 0.5 * HEIGHT else "upper"  # noqa: E731
    mesh = extrude(points, triangles, heights, material, boundary)
    return MixedSolid(mesh, moduli, order, fixed, bulk_ratio)


def test_compressed_and_sheared_blocks_have_their_laws():
    walls = {f"{end} {axis}": "xy"[axis] for end in ("low", "high") for axis in (0, 1)}
    solid = block({**walls, "low 2": "xyz"}, {"lower": 20.0, "upper": 20.0}, bulk_ratio=10.0)
    J = 0.8
    P = 20.0 * J ** (-2 / 3) * (J - (2.0 + J**2) / (3.0 * J)) + 200.0 * (J - 1.0)
    solid.settle([HeldContact("high 2", ngsolve.CF((0, 0, 0)), -P * AREA)])
    assert solid.steps[0] == pytest.approx((1.0 - J) * HEIGHT, rel=1e-6)
    walls = {f"{end} {axis}": "yz" for end in ("low", "high") for axis in (0, 1)}
    solid = block({**walls, "low 2": "xyz"}, {"lower": 20.0, "upper": 50.0}, 1e7)
    traction = 16.0
    solid.settle([HeldContact("high 2", ngsolve.CF((0, 0, 0)), traction * AREA, (1.0, 0.0, 0.0))])
    slide = 0.5 * HEIGHT * (traction / 20.0 + traction / 50.0)
    assert solid.steps[0] == pytest.approx(slide, rel=1e-6)


@pytest.mark.slow
def test_coarse_presses_are_as_deep_as_published():
    (case,) = (each for each in cases() if each.name == "75_30_2N")
    stack = ReferenceStack(case, Numerics(order=2, rim=5.0, inside=6.0, far=16.0))
    stack.solve()
    assert stack.depths[0] == pytest.approx(1e3 * case.depth[0], rel=0.1)
