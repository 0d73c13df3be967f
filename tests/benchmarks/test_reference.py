import math

import numpy as np
import pytest

from eitskin.benchmarks.reference.case import Case

ngsolve = pytest.importorskip("ngsolve", reason="needs the extra `reference` (NGSolve)")

from eitskin.benchmarks.reference.pressed_reference import (  # noqa: E402
    Numerics,
    ReferenceStack,
)
from eitskin.benchmarks.reference.prisms import (  # noqa: E402
    Patch,
    Sizes,
    extruded,
    triangulated,
)
from eitskin.benchmarks.reference.solid import Held, MixedSolid  # noqa: E402

LENGTH, WIDTH, HEIGHT = 4.0, 3.0, 2.0
AREA = LENGTH * WIDTH
COARSE = Numerics(order=2, sizes=Sizes(rim=5.0, inside=6.0, around=8.0, far=16.0))


def block(fixed, moduli, bulk_ratio=1e4, order=3):
    """Block of two layers, with its lower face at z = 0."""
    box = (0.0, LENGTH, 0.0, WIDTH)
    points, triangles = triangulated(box, [], [], Sizes(far=2.0))

    def boundary(centre):
        for axis, end in enumerate((LENGTH, WIDTH, HEIGHT)):
            if abs(centre[axis]) < 1e-9:
                return f"low {axis}"
            if abs(centre[axis] - end) < 1e-9:
                return f"high {axis}"
        raise AssertionError(centre)

    heights = (0.0, 0.5 * HEIGHT, HEIGHT)
    material = lambda c: "lower" if c[2] < 0.5 * HEIGHT else "upper"  # noqa: E731
    mesh = extruded(points, triangles, heights, material, boundary)
    return MixedSolid(mesh, moduli, order, fixed, bulk_ratio)


SAME = {"lower": 20.0, "upper": 20.0}


@pytest.mark.parametrize("stretch", [0.8, 1.3])
def test_uniform_compression_has_the_closed_form_of_an_incompressible_block(stretch):
    solid = block({"low 0": "x", "low 1": "y", "low 2": "z"}, SAME, bulk_ratio=1e7)
    wider = 1.0 / math.sqrt(stretch) - 1.0
    shape = ngsolve.CF((wider * ngsolve.x, wider * ngsolve.y, 0.0))
    force = 20.0 * (stretch - stretch**-2) * AREA
    solid.settle([Held("high 2", shape, -force)])
    assert solid.steps[0] == pytest.approx((1.0 - stretch) * HEIGHT, rel=1e-5)


def test_confined_compression_has_the_law_of_volume_changes():
    walls = {f"{end} {axis}": "xy"[axis] for end in ("low", "high") for axis in (0, 1)}
    solid = block({**walls, "low 2": "xyz"}, SAME, bulk_ratio=10.0)
    J = 0.8
    P = 20.0 * J ** (-2 / 3) * (J - (2.0 + J**2) / (3.0 * J)) + 200.0 * (J - 1.0)
    solid.settle([Held("high 2", ngsolve.CF((0, 0, 0)), -P * AREA)])
    assert solid.steps[0] == pytest.approx((1.0 - J) * HEIGHT, rel=1e-6)


def test_sheared_layers_share_the_traction():
    walls = {f"{end} {axis}": "yz" for end in ("low", "high") for axis in (0, 1)}
    solid = block({**walls, "low 2": "xyz"}, {"lower": 20.0, "upper": 50.0}, 1e7)
    traction = 16.0
    solid.settle([Held("high 2", ngsolve.CF((0, 0, 0)), traction * AREA, (1.0, 0.0, 0.0))])
    slide = 0.5 * HEIGHT * (traction / 20.0 + traction / 50.0)
    assert solid.steps[0] == pytest.approx(slide, rel=1e-6)


def test_a_patch_has_the_area_of_its_ellipse_and_a_symmetric_polygon():
    patch = Patch((10.0, 8.0), (4.0, 2.5))
    points, triangles = triangulated((0.0, 20.0, 0.0, 16.0), [], [patch], Sizes())
    corners = points[triangles]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    inside = patch.contains(corners.mean(axis=1))
    assert areas.min() > 0.0
    assert areas.sum() == pytest.approx(320.0)
    assert areas[inside].sum() == pytest.approx(math.pi * 4.0 * 2.5, rel=1e-9)


@pytest.mark.slow
def test_mirrored_touches_make_mirrored_fields():
    x = 1e-3 * np.array([[40.0, 20.0, 1.0], [52.0, 33.0, 4.0]])
    found = []
    for y in (20.0, 40.0):
        stack = ReferenceStack(Case("side", ((45.0, y),), force=2.0), COARSE)
        stack.solve()
        found.append(
            stack.displacement_and_gradient(x if y == 20.0 else x * (1, -1, 1) + (0, 0.06, 0))
        )
    (u, gradient), (mirrored, slope) = found
    sides = np.array([1.0, -1.0, 1.0])
    assert mirrored == pytest.approx(u * sides, abs=2e-5)
    assert slope == pytest.approx(gradient * sides[:, None] * sides, abs=5e-3)


@pytest.mark.slow
def test_plates_bend_a_sensor_before_the_press():
    stack = ReferenceStack(Case("bent", ((75.0, 30.0),), 1.0, support="plates", angle=10.0), COARSE)
    stack.solve()
    u, _ = stack.displacement_and_gradient(np.array([[0.145, 0.03, 0.0025], [0.005, 0.03, 0.0025]]))
    assert u[0] == pytest.approx(u[1] * (-1, 1, 1), abs=1e-9)
    assert u[0, 2] == pytest.approx(-0.07 * math.sin(math.radians(5.0)), rel=0.05)
