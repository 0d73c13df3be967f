"""Relaxation and creep functions, their duality, and mixtures of materials."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from eitskin.errors import ConfigurationError
from eitskin.simulator.mechanics.viscoelasticity import (
    ECOFLEX,
    GEL,
    Prony,
    elastic_force,
    elastic_force_at_depth,
    mixture,
)

steady = settings(max_examples=60, derandomize=True, deadline=None, database=None)
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


def test_the_gel_relaxes_from_one_to_three_quarters():
    assert GEL.relaxation(0.0) == 1.0
    assert GEL.relaxation(np.inf) == pytest.approx(0.75, rel=1e-15)
    assert GEL.relaxation(0.5) == pytest.approx(
        1 - 0.1 * (1 - np.exp(-1)) - 0.1 * (1 - np.exp(-0.05)) - 0.05 * (1 - np.exp(-0.0025))
    )
    assert ECOFLEX.relaxation(np.array([[1e9]])) == pytest.approx(np.array([[0.9]]))


@pytest.mark.parametrize("g", [1e-12, 0.05, 0.5, 0.999, 1 - 1e-12])
def test_one_term_creeps_as_the_standard_linear_solid(g):
    tau = 7.0
    expected = 1 + g / (1 - g) * -np.expm1(-T * (1 - g) / tau)
    assert np.allclose(Prony((g,), (tau,)).creep(T), expected, rtol=2e-15, atol=0)
    (amplitude,), _ = Prony((g,), (tau,)).dual
    assert amplitude == pytest.approx(g / (1 - g), rel=1e-14)


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


def test_nothing_relaxes_without_terms():
    for prony in (Prony(), Prony((0.0,), (1.0,))):
        assert np.all(prony.creep(T) == 1.0)
        assert elastic_force(prony, 4.0, 10.0) == 4.0
        assert elastic_force(prony, 4.0, 10.0, released=1e-3) == 0.0


def test_a_held_press_creeps_and_a_released_one_lingers():
    assert elastic_force(GEL, 10.0, 0.0) == 10.0
    assert elastic_force(GEL, 10.0, 30.0) == pytest.approx(10.0 * float(GEL.creep(30.0)), rel=1e-15)
    left = np.array([elastic_force(GEL, 10.0, 30.0, released=t) for t in T])
    assert np.allclose(left, 10 * (GEL.creep(T + 30.0) - GEL.creep(T)), rtol=1e-12, atol=1e-14)
    assert np.all(np.diff(left) < 0)
    assert left[-1] < 1e-100
    assert left[np.searchsorted(T, 200.0)] > 0.01


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


def test_layers_side_by_side_mix_exactly():
    share = 0.43
    both = mixture([GEL, ECOFLEX], [share, 1 - share])
    assert np.allclose(
        both.relaxation(T), share * GEL.relaxation(T) + (1 - share) * ECOFLEX.relaxation(T)
    )
    merged = mixture([Prony((0.2, 0.1), (5.0, 1.0)), Prony((0.4,), (5.0,))], [share, 1 - share])
    assert merged.times == (1.0, 5.0)
    assert merged.amplitudes == pytest.approx((0.1 * share, 0.4 - 0.2 * share))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Prony((0.1,), ()), "per amplitude"),
        (lambda: Prony((0.6, 0.4), (1.0, 2.0)), "less than 1"),
        (lambda: Prony((-0.1,), (1.0,)), "not be negative"),
        (lambda: Prony((0.1,), (0.0,)), "positive and finite"),
        (lambda: GEL.relaxation(-1.0), "0 s or more"),
        (lambda: GEL.creep(float("nan")), "0 s or more"),
        (lambda: mixture([GEL, ECOFLEX], [0.5, 0.6]), "add up to 1"),
        (lambda: mixture([GEL, ECOFLEX], [1.5, -0.5]), "none negative"),
        (lambda: mixture([GEL, ECOFLEX], [1.0]), "as many shares"),
        (lambda: elastic_force(GEL, -1.0, 1.0), "force"),
        (lambda: elastic_force_at_depth(GEL, 1.0, -1.0), "seconds"),
        (lambda: elastic_force(GEL, 1.0, 1.0, released=float("nan")), "released"),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(ConfigurationError, match=message):
        make()
