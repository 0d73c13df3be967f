"""Material laws: energies, stresses, tangents, and how they relax."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from eitskin.simulator.mechanics.materials import NeoHookean, Ogden, cofactor
from eitskin.simulator.mechanics.viscoelasticity import (
    ECOFLEX,
    GEL,
    Prony,
    elastic_force,
    elastic_force_at_depth,
    mixture,
)

LAWS = [NeoHookean(28e3), Ogden(14.5e3, 2.35), Ogden(20e3, -3.0), Ogden(20e3, 6.0)]


def gradients(seed=0, count=5, size=0.4):
    return np.eye(3) + size * np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3, 3))


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
    Q, F = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0], gradients()
    Q *= np.sign(np.linalg.det(Q))
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


# Viscoelasticity


steady = settings(max_examples=60, derandomize=True, database=None)
T = np.geomspace(1e-3, 1e5, 60)


@st.composite
def spectra(draw, most=12):
    count = draw(st.integers(1, most))
    logs = draw(st.lists(st.floats(-6, 6), min_size=count, max_size=count))
    parts = draw(st.lists(st.floats(0, 1), min_size=count, max_size=count))
    total = draw(st.floats(1e-3, 0.999))
    g = np.array(parts) * total / max(sum(parts), 1e-3)
    return Prony(tuple(g.tolist()), tuple((10.0 ** np.array(logs)).tolist()))


def transformed(prony, s):
    """s times the Laplace transforms of G and of J."""
    (g, tau), (j, times) = (prony.amplitudes, prony.times), prony.dual
    relaxing = 1 - sum(a / (1 + s * b) for a, b in zip(g, tau, strict=True))
    creeping = 1 + sum(a / (1 + s * b) for a, b in zip(j, times, strict=True))
    return relaxing, creeping


def test_the_gel_relaxes_presses_creep_and_layers_mix_exactly():
    assert GEL.relaxation(0.0) == 1.0
    assert GEL.relaxation(np.inf) == pytest.approx(0.75, rel=1e-15)
    assert GEL.relaxation(0.5) == pytest.approx(
        1 - 0.1 * (1 - np.exp(-1)) - 0.1 * (1 - np.exp(-0.05)) - 0.05 * (1 - np.exp(-0.0025))
    )
    assert ECOFLEX.relaxation(np.array([[1e9]])) == pytest.approx(np.array([[0.9]]))
    for prony in (Prony(), Prony((0.0,), (1.0,))):
        assert np.all(prony.creep(T) == 1.0)
        assert elastic_force(prony, 4.0, 10.0) == 4.0
        assert elastic_force(prony, 4.0, 10.0, released=1e-3) == 0.0
    assert elastic_force(GEL, 10.0, 0.0) == 10.0
    assert elastic_force(GEL, 10.0, 30.0) == pytest.approx(10.0 * float(GEL.creep(30.0)), rel=1e-15)
    left = np.array([elastic_force(GEL, 10.0, 30.0, released=t) for t in T])
    assert np.allclose(left, 10 * (GEL.creep(T + 30.0) - GEL.creep(T)), rtol=1e-12, atol=1e-14)
    assert np.all(np.diff(left) < 0)
    assert left[-1] < 1e-100
    assert left[np.searchsorted(T, 200.0)] > 0.01
    share = 0.43
    both = mixture([GEL, ECOFLEX], [share, 1 - share])
    assert np.allclose(
        both.relaxation(T), share * GEL.relaxation(T) + (1 - share) * ECOFLEX.relaxation(T)
    )
    merged = mixture([Prony((0.2, 0.1), (5.0, 1.0)), Prony((0.4,), (5.0,))], [share, 1 - share])
    assert merged.times == (1.0, 5.0)
    assert merged.amplitudes == pytest.approx((0.1 * share, 0.4 - 0.2 * share))


@pytest.mark.parametrize("g", [1e-12, 0.05, 0.5, 0.999, 1 - 1e-12])
def test_one_term_creeps_as_the_standard_linear_solid(g):
    tau = 7.0
    expected = 1 + g / (1 - g) * -np.expm1(-T * (1 - g) / tau)
    assert np.allclose(Prony((g,), (tau,)).creep(T), expected, rtol=2e-15, atol=0)
    (amplitude,), _ = Prony((g,), (tau,)).dual
    assert amplitude == pytest.approx(g / (1 - g), rel=1e-14)


@pytest.mark.slow
@steady
@given(spectra())
def test_any_dual_is_one(prony):
    relaxing, creeping = transformed(prony, np.geomspace(1e-8, 1e8, 50))
    assert np.allclose(relaxing * creeping, 1.0, rtol=1e-11, atol=0)
    assert prony.creep(np.inf) == pytest.approx(1.0 / (1.0 - sum(prony.amplitudes)), rel=1e-9)
    j, times = prony.dual
    assert all(a > 0 for a in j)
    assert list(times) == sorted(times)
    assert np.all(np.diff(prony.creep(np.geomspace(1e-8, 1e8, 50))) > -1e-12)


@pytest.mark.parametrize(
    "prony", [GEL, Prony((0.2, 0.3, 0.4), (1e-6, 1.0, 1e6)), Prony((0.3,) * 3, (2.0,) * 3)]
)
def test_a_held_depth_lingers_by_the_force_that_held_it(prony):
    """int J(t - s) dF(s) with F = F_e G until the release, by quadrature."""
    hold, g, tau = 30.0, np.array(prony.amplitudes), np.array(prony.times)
    assert elastic_force_at_depth(prony, 10.0, hold) == 10.0
    for released in (1e-3, 1.0, 50.0, 1e4):
        now = hold + released
        left = float(prony.creep(now) - prony.relaxation(hold) * prony.creep(released))
        for a, time in zip(g, tau, strict=True):
            integral, _ = quad(
                lambda x, time=time, now=now: np.exp(-x) * float(prony.creep(now - time * x)),
                *(0.0, min(hold / time, 60.0)),
                epsabs=1e-12,
                limit=400,
            )
            left -= a * integral
        assert elastic_force_at_depth(prony, 10.0, hold, released) == pytest.approx(
            10 * left, abs=2e-9
        )
