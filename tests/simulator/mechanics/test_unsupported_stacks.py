"""Layered stacks without a base: deflections of strips and membranes against closed forms."""

import elastic_forms
import numpy as np
import pytest
import skfem

from eitskin.simulator.mechanics.load_stepping import Load, newton
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.mechanics.mixed_solid import Solid

from alternatives import traction_forces

SILICONE, GEL, SOFT_GEL = 28e3, 20e3, 2e3
REFERENCE = ((0.0035, SILICONE), (0.005, GEL), (0.0035, SILICONE))


def heights(sheets, cells):
    """Heights of cell faces, `cells` in each sheet."""
    tops = np.cumsum([thickness for thickness, _ in sheets])
    parts = [
        np.linspace(top - t, top, cells + 1)[1:] for top, (t, _) in zip(tops, sheets, strict=True)
    ]
    return np.concatenate([[0.0], *parts])


def towards(half, cells):
    """Coordinates from the middle to a held end, finer towards the end."""
    return half * (1.0 - (1.0 - np.linspace(0.0, 1.0, cells + 1)) ** 1.6)


def layered(mesh, sheets, kinematics, bulk_ratio=1e5):
    middles = mesh.p[-1, mesh.t].mean(axis=0)
    tops = np.cumsum([thickness for thickness, _ in sheets])
    laws = [NeoHookean(mu) for _, mu in sheets]
    return Solid(mesh, laws, np.searchsorted(tops, middles), kinematics, bulk_ratio)


def pressed_down(solid, load):
    """Nodal forces of a uniform pressure on the upper face."""
    top = solid.mesh.p[-1].max()
    face = solid.mesh.facets_satisfying(lambda p: np.isclose(p[-1], top), boundaries_only=True)
    none = np.zeros(solid.dim - 1)
    return traction_forces(
        solid, face, lambda p: np.append(none, -load).reshape(-1, *[1] * (p.ndim - 1)) + 0.0 * p
    )


def numbers(solid, nodes, axes):
    return np.concatenate([solid.dim * np.flatnonzero(nodes) + axis for axis in axes])


def fall(solid, x, height):
    """Downward displacement on the axis at a height [m]."""
    position = np.append(np.zeros(solid.dim - 1), height)
    node = np.abs(solid.nodes - position).sum(axis=1).argmin()
    return -float(solid.displacement(x)[node, -1])


@pytest.mark.parametrize(
    ("sheets", "length", "shear"),
    [
        (REFERENCE, 0.24, 0.059),
        (((0.0035, SILICONE), (0.005, SOFT_GEL), (0.0035, SILICONE)), 0.24, 0.41),
        (((0.0035, SILICONE), (0.005, SOFT_GEL), (0.0035, SILICONE)), 0.40, 0.147),
        (((0.006, 10e3), (0.002, 40e3)), 0.24, 0.032),
    ],
)
def test_a_layered_strip_between_clamps_bends_and_shears(sheets, length, shear) -> None:
    """Clamps hold whole cross-sections, so the strip is stiffer by the order of h / L."""
    solid = layered(
        skfem.MeshQuad.init_tensor(towards(length / 2, 24), heights(sheets, 2)),
        sheets,
        "plane strain",
    )
    X = solid.nodes
    held = numbers(solid, X[:, 0] > length / 2 - 1e-9, (0, 1))
    fixed = np.union1d(held, numbers(solid, X[:, 0] < 1e-9, (0,)))
    thickness = sum(h for h, _ in sheets)
    load = 1e-6 * thickness / elastic_forms.clamped_strip_deflection(sheets, length, 1.0)
    x = newton(
        [solid], np.zeros(solid.unknowns), Load(fixed, 0.0 * fixed, pressed_down(solid, load))
    )
    rigidity, stiffness = elastic_forms.plate_stiffnesses(sheets)
    assert 48.0 * rigidity / (stiffness * length**2) == pytest.approx(shear, rel=0.02)
    short = 1.0 - fall(solid, x, thickness / 2) / (1e-6 * thickness)
    assert 0.2 * thickness / length < short < 0.8 * thickness / length


def held_sheet(sheets, length, width, bulk_ratio=1e4):
    """Quarter of a rectangular sheet, and the numbers of its held unknowns and of its rim."""
    lines = (towards(length / 2, 8), towards(width / 2, 6), heights(sheets, 1))
    solid = layered(skfem.MeshHex.init_tensor(*lines), sheets, "solid", bulk_ratio)
    X = solid.nodes
    rim = (X[:, 0] > length / 2 - 1e-9) | (X[:, 1] > width / 2 - 1e-9)
    mirrored = [numbers(solid, X[:, axis] < 1e-9, (axis,)) for axis in (0, 1)]
    return solid, rim, np.unique(np.concatenate([numbers(solid, rim, range(3)), *mirrored]))


def test_a_sheet_held_at_its_rim_is_a_clamped_plate() -> None:
    """With the deflection by shear added; the mesh and held faces at the rim leave 3 %."""
    sheets, length, width = ((0.0006, SILICONE), (0.0008, GEL), (0.0006, SILICONE)), 0.16, 0.07
    solid, _, fixed = held_sheet(sheets, length, width)
    rigidity, shear = elastic_forms.plate_stiffnesses(sheets)
    expected = elastic_forms.clamped_plate_deflection(length, width, rigidity, 1.0)
    expected += elastic_forms.membrane_deflection(length, width, shear, 1.0)
    load = 3e-6 / expected
    x = newton(
        [solid], np.zeros(solid.unknowns), Load(fixed, 0.0 * fixed, pressed_down(solid, load))
    )
    assert fall(solid, x, 0.001) == pytest.approx(3e-6, rel=0.04)


def test_a_stretched_sheet_held_at_its_rim_is_a_membrane() -> None:
    sheets, length, width, stretch = ((0.0005, GEL),), 0.16, 0.07, 1.1
    solid, rim, fixed = held_sheet(sheets, length, width)
    moved = np.zeros_like(solid.nodes)
    moved[rim] = solid.nodes[rim] * (stretch - 1.0, stretch - 1.0, stretch**-2 - 1.0)
    values, load = moved.ravel()[fixed], 1e-3
    none = np.zeros(solid.unknowns)
    flat = newton([solid], none, Load(fixed, values, none))
    x = newton([solid], flat, Load(fixed, values, pressed_down(solid, load * stretch**2)))
    tension = elastic_forms.equibiaxial_tension(sheets, stretch)
    expected = elastic_forms.membrane_deflection(stretch * length, stretch * width, tension, load)
    found = fall(solid, x, 0.00025) - fall(solid, flat, 0.00025)
    assert found == pytest.approx(expected, rel=0.03)
