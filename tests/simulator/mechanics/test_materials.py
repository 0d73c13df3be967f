"""Hyperelastic laws against finite differences of their energy and against closed forms."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.simulator.mechanics.materials import NeoHookean, Ogden, cofactor

LAWS = [NeoHookean(28e3), Ogden(14.5e3, 2.35), Ogden(20e3, -3.0), Ogden(20e3, 6.0)]


def gradients(seed=0, count=5, size=0.4):
    return np.eye(3) + size * np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3, 3))


def rotation(seed=1):
    Q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return Q * np.sign(np.linalg.det(Q))


def central_difference(function, F, step=1e-5):
    """d function / dF with the two indices of F last."""
    slopes = []
    for k in range(3):
        for L in range(3):
            shift = np.zeros((3, 3))
            shift[k, L] = step
            slopes.append((function(F + shift) - function(F - shift)) / (2 * step))
    out = np.stack(slopes, axis=-1)
    return out.reshape(*out.shape[:-1], 3, 3)


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_stress_is_the_slope_of_the_energy(law) -> None:
    F = gradients()
    expected = central_difference(law.energy, F)
    assert law.stress(F) == pytest.approx(expected, rel=1e-7, abs=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("law", LAWS, ids=str)
@pytest.mark.parametrize("F", [gradients(), np.eye(3)[None]], ids=["deformed", "undeformed"])
def test_tangent_is_the_slope_of_the_stress_and_symmetric(law, F) -> None:
    expected = central_difference(law.stress, F)
    A = law.tangent(F).reshape(expected.shape)
    assert A == pytest.approx(expected, rel=1e-6, abs=1e-7 * np.abs(expected).max())
    assert pytest.approx(A.transpose(0, 3, 4, 1, 2), abs=1e-9 * np.abs(A).max()) == A
    some = [0, 1, 3, 4, 8]
    part = A.reshape(-1, 9, 9)[:, some][:, :, some]
    assert law.tangent(F, some) == pytest.approx(part, abs=1e-12 * np.abs(A).max())


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_tangent_has_its_limit_where_stretches_nearly_agree(law) -> None:
    """Equal and almost equal stretches (1e-9 apart) give the same tangent to that order."""
    F = np.diag([1.3, 1.3, 0.7])
    nearly = np.diag([1.3, 1.3 * (1 + 1e-9), 0.7])
    A, B = law.tangent(F), law.tangent(nearly)
    assert pytest.approx(A, abs=1e-7 * np.abs(A).max()) == B


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_rotations_and_swelling_store_nothing(law) -> None:
    Q, F = rotation(), gradients()
    assert law.stress(Q) == pytest.approx(np.zeros((3, 3)), abs=1e-10 * law.shear_modulus)
    assert law.energy(1.7 * Q) == pytest.approx(0.0, abs=1e-10 * law.shear_modulus)
    assert law.energy(Q @ F) == pytest.approx(law.energy(F), rel=1e-10)
    assert law.stress(Q @ F) == pytest.approx(Q @ law.stress(F), abs=1e-9 * law.shear_modulus)


def traction_with_free_sides(law, F):
    """P_11 once a pressure clears P_33, as in an incompressible sheet with free faces."""
    P, H = law.stress(F), cofactor(F)
    return (P - P[2, 2] / H[2, 2] * H)[0, 0]


@pytest.mark.parametrize("law", LAWS, ids=str)
@pytest.mark.parametrize("stretch", [0.5, 0.9, 1.2, 3.0])
def test_uniaxial_and_equibiaxial_closed_forms(law, stretch) -> None:
    """P = 2 mu/alpha (s^(alpha-1) - s^(-alpha/2-1)) and (s^(alpha-1) - s^(-2 alpha-1))."""
    alpha, s = getattr(law, "alpha", 2.0), stretch
    scale = 2 * law.shear_modulus / alpha
    uniaxial = traction_with_free_sides(law, np.diag([s, s**-0.5, s**-0.5]))
    assert uniaxial == pytest.approx(scale * (s ** (alpha - 1) - s ** (-alpha / 2 - 1)), rel=1e-9)
    biaxial = traction_with_free_sides(law, np.diag([s, s, s**-2]))
    assert biaxial == pytest.approx(scale * (s ** (alpha - 1) - s ** (-2 * alpha - 1)), rel=1e-9)


def test_impossible_materials_are_refused() -> None:
    for modulus in (0.0, -1.0, np.nan, np.inf):
        for law in (NeoHookean, lambda mu: Ogden(mu, 2.0)):
            with pytest.raises(ConfigurationError, match="shear_modulus"):
                law(modulus)
    with pytest.raises(ConfigurationError, match="alpha"):
        Ogden(1.0, 0.0)
