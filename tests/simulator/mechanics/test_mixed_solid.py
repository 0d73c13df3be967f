"""Solids at finite strain against closed forms, convergence rates and what must always hold."""

import numpy as np
import pytest
import skfem

from eitskin.errors import ConfigurationError
from eitskin.simulator.mechanics.load_stepping import Load, SolidError, SparseLU, follow, newton
from eitskin.simulator.mechanics.materials import NeoHookean, Ogden, cofactor
from eitskin.simulator.mechanics.mixed_solid import Solid

from alternatives import traction_forces

UNIT = np.linspace(0.0, 1.0, 3)
MESHES = {
    "quadrilaterals": (skfem.MeshQuad.init_tensor(UNIT, UNIT), "plane strain"),
    "triangles": (skfem.MeshTri.init_tensor(UNIT, UNIT), "plane strain"),
    "ring": (skfem.MeshQuad.init_tensor(UNIT, UNIT), "axisymmetric"),
    "hexahedra": (skfem.MeshHex.init_tensor(UNIT, UNIT, UNIT), "solid"),
    "tetrahedra": (skfem.MeshTet.init_tensor(UNIT, UNIT, UNIT), "solid"),
}
EVERY_MESH = pytest.mark.parametrize("kind", MESHES)
SMALL = 1e-6  # strain at which finite strain theory is linear to rounding of the tests


def distorted(mesh, size=0.12, seed=2):
    inside = np.setdiff1d(np.arange(mesh.p.shape[1]), mesh.boundary_nodes())
    p = mesh.p.copy()
    p[:, inside] += np.random.default_rng(seed).uniform(-size, size, (p.shape[0], len(inside)))
    return type(mesh)(p, mesh.t)


def spread(nodes, dim):
    """Unknowns of all displacement components of `nodes`."""
    return (dim * np.asarray(nodes)[:, None] + np.arange(dim)).ravel()


def prescribe(solid, nodes, displacement):
    """A path along which `nodes` move to X + displacement(t), proportionally by default."""
    fixed = spread(nodes, solid.dim)
    return lambda t: Load(fixed, displacement(t).ravel(), np.zeros(solid.unknowns))


def on_boundary(solid, low=0.0, high=1.0):
    X = solid.nodes
    return np.flatnonzero(np.any((np.abs(X - low) < 1e-9) | (np.abs(X - high) < 1e-9), axis=1))


def state(solid, size=0.02, seed=0):
    return size * np.random.default_rng(seed).uniform(-1, 1, solid.unknowns)


@EVERY_MESH
@pytest.mark.parametrize("law", [NeoHookean(3.0), Ogden(3.0, 3.5)], ids=str)
def test_stiffness_is_the_slope_of_the_forces_and_symmetric(kind, law) -> None:
    mesh, kinematics = MESHES[kind]
    solid = Solid(distorted(mesh), [law], kinematics=kinematics, bulk_ratio=50.0)
    x, direction = state(solid), state(solid, 1.0, seed=1)
    forces, K = solid.linearise(x)
    step = 1e-6 * direction
    slope = (solid.forces(x + step) - solid.forces(x - step)) / 2e-6
    assert K @ direction == pytest.approx(slope, abs=1e-7 * np.abs(slope).max())
    assert forces == pytest.approx(solid.forces(x), abs=1e-14)
    assert abs(K - K.T).max() < 1e-12 * abs(K).max()


@EVERY_MESH
def test_affine_displacements_of_the_boundary_strain_the_inside_alike(kind) -> None:
    """The patch test, on a distorted mesh, at finite strain."""
    mesh, kinematics = MESHES[kind]
    solid = Solid(distorted(mesh), [NeoHookean(2.0)], kinematics=kinematics, bulk_ratio=100.0)
    if kinematics == "axisymmetric":  # the only affine map of rings without shear at the axis
        gradient = np.diag([1.2, 1.2**-2])
    else:
        gradient = np.eye(solid.dim)
        gradient[0, -1], gradient[1, 0], gradient[0, 0] = 0.4, -0.1, 1.05
    u = solid.nodes @ (gradient - np.eye(solid.dim)).T
    nodes = on_boundary(solid)
    path = prescribe(solid, nodes, lambda t: t * u[nodes])
    x = follow([solid], np.zeros(solid.unknowns), path)[0]
    assert solid.displacement(x) == pytest.approx(u, abs=1e-9)
    P = solid.stress(x)
    assert pytest.approx(np.broadcast_to(P[0, 0], P.shape), abs=1e-7) == P


def squeezed(solid, height):
    """Load that brings a cylinder of unit height between rough plates to `height`."""
    z = solid.nodes[:, 1]
    plates = np.flatnonzero((z < 1e-9) | (z > 1 - 1e-9))
    axis = np.setdiff1d(np.flatnonzero(solid.nodes[:, 0] < 1e-9), plates)
    fixed = np.concatenate([spread(plates, 2), 2 * axis])
    moved = np.stack([0 * plates, (height - 1) * z[plates]], axis=1).ravel()
    return Load(fixed, np.concatenate([moved, 0.0 * axis]), np.zeros(solid.unknowns))


@pytest.mark.slow
def test_work_is_the_energy_stored_also_with_earlier_factors_and_a_scale():
    """A cylinder squeezed between rough plates, by Simpson's rule over the stroke."""
    mesh = skfem.MeshQuad.init_tensor(np.linspace(0, 1, 5), np.linspace(0, 1, 5))
    solid = Solid(mesh, [Ogden(2.0, 2.35)], kinematics="axisymmetric", bulk_ratio=1e3)
    x, forces = np.zeros(solid.unknowns), [0.0]
    strokes = np.linspace(0, 0.3, 9)
    for stroke in strokes[1:]:
        load = squeezed(solid, 1.0 - stroke)
        x = newton([solid], x, load)
        forces.append(solid.forces(x)[load.fixed] @ load.values / stroke)
    simpson = np.array([1, 4, 2, 4, 2, 4, 2, 4, 1]) / 3 * strokes[1]
    assert solid.energy(x) == pytest.approx(simpson @ forces, rel=1e-5)
    solid = Solid(MESHES["ring"][0], [NeoHookean(1.0)], kinematics="axisymmetric")
    none, load, factorised = np.zeros(solid.unknowns), squeezed(solid, 0.95), []

    def counted(matrix):
        factorised.append(len(factorised))
        return SparseLU(matrix)

    exact = newton([solid], none, load, tolerance=1e-10)
    solid.elimination = lambda *_: counted
    counts = []
    for chords in (False, True):
        found = newton([solid], none, load, 1e-2, chords=chords)
        assert np.abs(found - exact).max() < 1e-4 * np.abs(exact).max()
        counts.append(len(factorised))
    assert counts[1] - counts[0] < counts[0]
    solid = Solid(MESHES["ring"][0], [NeoHookean(1.0)], kinematics="axisymmetric")
    # Rounding leaves residuals that no correction makes smaller than themselves.
    load = squeezed(solid, 1.0)
    tiny = 1e-20 * np.random.default_rng(0).normal(size=solid.unknowns)
    held = Load(load.fixed, load.values, solid.forces(tiny))
    with pytest.raises(SolidError, match="does not converge"):
        newton([solid], np.zeros(solid.unknowns), held, tolerance=1e-2)
    with pytest.raises(SolidError, match="do not contract"):
        newton([solid], np.zeros(solid.unknowns), held, tolerance=1e-2, contraction=1.0)
    found = newton([solid], np.zeros(solid.unknowns), held, tolerance=1e-2, scale=1e-6)
    assert np.abs(found).max() < 1e-9


def test_thick_cylinder_under_pressure() -> None:
    """Lame: u = q a^2 / (2 mu (b^2 - a^2)) ((1 - 2 nu) r + b^2 / r) in plane strain."""
    mesh = skfem.MeshQuad.init_tensor(np.linspace(2, 4, 17), np.linspace(0, 1, 3))
    for bulk_ratio in (1e7, 3.0):
        solid = Solid(mesh, [NeoHookean(1.0)], kinematics="axisymmetric", bulk_ratio=bulk_ratio)
        r, z = solid.nodes.T
        inner = mesh.facets_satisfying(lambda p: np.isclose(p[0], 2.0), boundaries_only=True)
        forces = traction_forces(
            solid, inner, lambda p: SMALL * np.stack([np.ones_like(p[0]), 0 * p[0]])
        )
        ends = 2 * np.flatnonzero((z < 1e-9) | (z > 1 - 1e-9)) + 1
        x = newton([solid], np.zeros(solid.unknowns), Load(ends, np.zeros(len(ends)), forces))
        nu = (3 * bulk_ratio - 2) / (6 * bulk_ratio + 2)
        expected = SMALL / 6 * ((1 - 2 * nu) * r + 16 / r)
        assert solid.displacement(x)[:, 0] == pytest.approx(expected, rel=2e-5)


def isochoric(X):
    """Two shears, one after the other, and their deformation gradient (..., 3, 3)."""
    x = X[0] + 0.1 * np.sin(np.pi * X[1])
    y = X[1] + 0.1 * np.sin(np.pi * x)
    F = np.zeros((*X.shape[1:], 3, 3))
    F[..., 0, 0] = F[..., 2, 2] = 1.0
    F[..., 0, 1] = slope = 0.1 * np.pi * np.cos(np.pi * X[1])
    F[..., 1, 0] = turn = 0.1 * np.pi * np.cos(np.pi * x)
    F[..., 1, 1] = 1.0 + turn * slope
    return np.stack([x, y]) - X, F


@pytest.mark.parametrize("cells", [skfem.MeshQuad, skfem.MeshTri])
def test_errors_fall_with_the_third_power_of_the_cell(cells) -> None:
    """A smooth finite deformation, loaded by int P : grad v for its own stress."""
    law, errors = NeoHookean(1.0), []
    for n in (4, 8, 16):
        mesh = cells.init_tensor(*2 * [np.linspace(0, 1, n + 1)])
        solid = Solid(mesh, [law], bulk_ratio=1e7)
        fine = skfem.CellBasis(mesh, solid.basis.elem, intorder=8)
        X = np.asarray(fine.global_coordinates())
        u, F = isochoric(X)
        P = law.stress(F) + np.cos(X[0] + 2 * X[1])[..., None, None] * cofactor(F)
        load = np.zeros((len(solid.nodes), 2))
        for a, (function,) in enumerate(fine.basis):
            parts = np.einsum("cqiJ,Jcq,cq->ci", P[..., :2, :2], function.grad, fine.dx)
            np.add.at(load, fine.element_dofs[a], parts)
        forces = np.concatenate([load.ravel(), np.zeros(solid.multipliers)])
        rim = on_boundary(solid)
        target = isochoric(solid.nodes[rim].T)[0].T.ravel()
        whole = Load(spread(rim, 2), target, forces)
        x, _ = follow(
            [solid],
            np.zeros(solid.unknowns),
            lambda t, w=whole: Load(w.fixed, t * w.values, t * w.forces),
        )
        found = solid.displacement(x)[fine.element_dofs]
        at_points = sum(found[a].T[:, :, None] * np.asarray(f) for a, (f,) in enumerate(fine.basis))
        errors.append(np.sqrt(np.sum((at_points - u) ** 2 * fine.dx)))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert rates[-1] == pytest.approx(3.0, abs=0.1)


def rivlin(X, curvature):
    """A block of unit thickness and unit mu, bent to an annular sector (Rivlin 1949)."""
    middle = (1 + curvature**2) ** 0.25
    turn, radius = curvature * X[:, 0], np.sqrt(middle**2 + 2 * curvature * X[:, 1]) / curvature
    return np.stack([radius * np.sin(turn), radius * np.cos(turn) - middle / curvature], axis=1)


@pytest.mark.slow
def test_blocks_bent_until_they_wrinkle_are_refused() -> None:
    """Biot: a free face is unstable once shortened to 0.544, here where c t = 1.54."""
    mesh = skfem.MeshQuad.init_tensor(np.linspace(-1, 1, 13), np.linspace(-0.5, 0.5, 7))
    solid = Solid(mesh, [NeoHookean(1.0)], bulk_ratio=1e7)
    ends = np.flatnonzero(np.abs(solid.nodes[:, 0]) > 1 - 1e-9)
    X = solid.nodes[ends]
    turned = prescribe(solid, ends, lambda t: rivlin(X, max(t, 1e-9) * 2.0) - X)
    with pytest.raises(SolidError, match="unstable") as error:
        follow([solid], np.zeros(solid.unknowns), turned)
    assert 2.0 * error.value.reached == pytest.approx(1.54, abs=0.15)


@pytest.mark.slow
def test_impossible_solids_and_loads_are_refused() -> None:
    mesh, _ = MESHES["hexahedra"]
    for ratio in (0.0, 1e9, np.nan):
        with pytest.raises(ConfigurationError, match="bulk_ratio"):
            Solid(mesh, [NeoHookean(1.0)], kinematics="solid", bulk_ratio=ratio)
    # A plate that would pass through the one below it.
    solid = Solid(skfem.MeshQuad.init_tensor(UNIT, UNIT), [NeoHookean(1.0)])
    y = solid.nodes[:, 1]
    plates = np.flatnonzero((y < 1e-9) | (y > 1 - 1e-9))
    down = np.stack([0 * y, -1.1 * y], axis=1)[plates]
    with pytest.raises(SolidError, match="the load") as error:
        follow([solid], np.zeros(solid.unknowns), prescribe(solid, plates, lambda t: t * down))
    assert 0.2 < error.value.reached < 1 / 1.1
