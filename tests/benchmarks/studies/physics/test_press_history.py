"""Histories of presses against plain convolutions, quadrature, superposition and thermodynamics."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from eitskin.benchmarks.studies.physics.press_history import DepthHistory, ForceHistory, Memory
from eitskin.errors import ConfigurationError
from eitskin.simulator.mechanics.viscoelasticity import ECOFLEX, GEL, Prony

steady = settings(max_examples=60, derandomize=True, deadline=None, database=None)
SPREAD = Prony((0.2, 0.1, 0.3, 0.05), (1e-4, 0.3, 5.0, 1e4))


def plain_elastic_force(history, prony, t):
    """int J(t - s) dF(s) at one t, segment after segment, with int J in closed form."""
    times, forces = np.append(history.times[0], history.times), np.append(0.0, history.forces)
    j, tau = (np.array(part) for part in prony.dual)
    total = 0.0
    for start, end, before, after in zip(times, times[1:], forces, forces[1:], strict=False):
        if start > t:
            continue
        if start == end:
            total += (after - before) * prony.creep(t - start)
            continue
        since, until = t - start, max(t - end, 0.0)
        integral = (since - until) * (1 + j.sum())
        integral += np.sum(j * tau * np.exp(-until / tau) * np.expm1(-(since - until) / tau))
        total += (after - before) / (end - start) * integral
    return total


@st.composite
def histories(draw, closed=False):
    """Forces up to 10 N with jumps, over some tens of seconds."""
    count = draw(st.integers(1, 8))
    gaps = draw(st.lists(st.sampled_from([0.0, 0.1, 1.0, 7.0]), min_size=count, max_size=count))
    forces = draw(st.lists(st.floats(0, 10), min_size=count, max_size=count))
    ends = [0.0] if closed else []
    return ForceHistory(np.cumsum([*gaps, *ends]) + 1.0, np.array([*forces, *ends]))


def random_history(count):
    rng = np.random.default_rng(4)
    gaps = rng.choice([0.0, 1e-3, 0.02, 1.0], count)
    return ForceHistory(np.cumsum(gaps), rng.uniform(0, 10, count))


@pytest.mark.parametrize("prony", [GEL, ECOFLEX, SPREAD])
def test_long_recordings_meet_the_plain_convolution(prony):
    history = random_history(400)
    t = np.concatenate([history.times[::13], np.linspace(-1, 2 * history.times[-1], 41)])
    plain = [plain_elastic_force(history, prony, at) for at in t]
    assert np.allclose(history.elastic_force(prony, t), plain, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("prony", [GEL, SPREAD, Prony()])
def test_frame_by_frame_is_the_whole_history(prony):
    history = random_history(300)
    memory, before, followed = Memory.none(prony), history.times[0], []
    for time, force in zip(history.times.tolist(), history.forces.tolist(), strict=True):
        memory, before = memory.after(time - before, force), time
        followed.append(memory.elastic_force)
    # Where the force jumps, the history tells the value after the last jump.
    last = np.append(np.diff(history.times) > 0, True)
    whole = history.elastic_force(prony, history.times)
    assert np.allclose(np.array(followed)[last], whole[last], rtol=1e-13, atol=1e-13)


def dissipated(history, prony):
    """int F dF_e = -int F_e dF from no force to no force, by jumps and by ramps."""
    times = np.append(history.times[0], history.times)
    forces = np.append(0.0, history.forces)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    work, memory = 0.0, Memory.none(prony)
    for gap, before, after in zip(np.diff(times), forces, forces[1:], strict=False):
        rise = after - before
        along = 0.5 * (nodes + 1)
        elastic = [memory.after(gap * p, before + p * rise).elastic_force for p in along]
        work -= 0.5 * weights @ elastic * rise
        memory = memory.after(gap, after)
    return work


@steady
@given(histories(closed=True), st.sampled_from([GEL, ECOFLEX, Prony((0.3, 0.4), (0.2, 5.0))]))
def test_closed_cycles_dissipate(history, prony):
    assert dissipated(history, prony) >= -1e-12 * np.square(history.forces).sum()


def power(depth):
    return 4e5 * depth**1.5


def test_a_ramp_of_depth_relaxes_while_it_goes():
    history = DepthHistory(np.array([1.0, 3.0]), np.array([0.0, 0.002]))

    def relaxed(t):
        value, _ = quad(
            lambda s: float(GEL.relaxation(t - s)) * 1.5 * 4e5 * ((s - 1) * 1e-3) ** 0.5 * 1e-3,
            *(1.0, min(t, 3.0)),
            epsabs=1e-12,
        )
        return value

    t = np.array([0.5, 1.0, 1.7, 3.0, 5.0, 100.0])
    assert np.allclose(
        history.force(GEL, power, t), [0.0] + [relaxed(at) for at in t[1:]], atol=1e-6 * 36
    )


def test_the_tolerance_is_met_and_not_wasted():
    history = DepthHistory(np.array([1.0, 3.0]), np.array([0.0, 0.002]))
    fast, t = Prony((0.95,), (0.02,)), np.linspace(1.0, 3.5, 301)
    best = history.force(fast, power, t, 1e-10)
    for tolerance in (1e-2, 1e-4, 1e-6):
        error = np.abs(history.force(fast, power, t, tolerance) - best).max() / power(0.002)
        assert 0.2 * tolerance < error <= tolerance


def test_a_step_of_depth_relaxes_as_g():
    history = DepthHistory(np.array([0.0, 5.0]), np.array([0.001, 0.001]))
    t = np.geomspace(1e-3, 1e4, 20)
    assert np.allclose(history.force(GEL, power, t), power(0.001) * GEL.relaxation(t), rtol=1e-13)


def test_depth_and_force_undo_each_other():
    """The forces of a depth history, as a force history, make the same dents: at second order."""
    depths = DepthHistory(np.array([0.0, 1.0, 4.0, 5.0]), np.array([0.0, 0.001, 0.0014, 0.0012]))
    errors = []
    for count in (201, 401):
        t = np.linspace(0.0, 5.0, count)
        again = ForceHistory(t, depths.force(GEL, power, t, 1e-9)).elastic_force(GEL, t)
        errors.append(np.abs(again - power(np.interp(t, depths.times, depths.depths))).max())
    assert errors[1] < 1e-5 * power(0.0014)
    assert np.log2(errors[0] / errors[1]) > 1.4


def test_a_raised_indenter_leaves_its_dent_behind():
    depths = DepthHistory(np.array([0.0, 0.01, 30.0, 30.01]), np.array([0.0, 0.002, 0.002, 0.0]))
    t = np.concatenate([np.linspace(0, 30, 301), np.linspace(30, 30.01, 301), [31, 60, 330]])
    forces = depths.force(GEL, power, t)
    assert forces.min() == 0.0
    assert np.all(forces[-10:] == 0.0)
    dents = ForceHistory(t, forces).elastic_force(GEL, t[-3:])
    assert np.all(np.diff(dents) < 0)
    assert np.all(dents > 0)


def test_depth_before_contact_takes_no_force():
    """An indenter that comes down through air for a third of its way."""
    history = DepthHistory(np.array([0.0, 1.0]), np.array([0.0, 0.003]))
    force = history.force(GEL, lambda d: np.maximum(d - 0.001, 0) * 1e4, np.array([0.2, 1.0]))
    relaxed, _ = quad(lambda s: float(GEL.relaxation(1 - s)) * 30.0, 1 / 3, 1.0)
    assert force == pytest.approx([0.0, relaxed], abs=1e-5 * 20)


def force_at_one_second(force_of_depth, *times):
    depths = np.linspace(0.001 if len(times) == 1 else 0.0, 0.001, len(times))
    return DepthHistory(np.array(times), depths).force(GEL, force_of_depth, 1.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ForceHistory(np.array([]), np.array([])), "one or more"),
        (lambda: ForceHistory(np.array([0.0, 1.0]), np.array([1.0])), "as many forces"),
        (lambda: ForceHistory(np.array([1.0, 0.0]), np.array([1.0, 1.0])), "never fall"),
        (lambda: ForceHistory(np.array([0.0, np.nan]), np.array([1.0, 1.0])), "finite"),
        (lambda: ForceHistory(np.array([0.0]), np.array([-1.0])), "not negative"),
        (lambda: DepthHistory(np.array([0.0]), np.array([np.inf])), "depths in m"),
        (lambda: ForceHistory(np.zeros(1), np.ones(1)).elastic_force(GEL, np.nan), "finite"),
        (lambda: Memory.none(GEL).after(-1.0, 1.0), "seconds"),
        (lambda: Memory.none(GEL).after(1.0, float("nan")), "force"),
        (
            lambda: force_at_one_second(lambda d: np.where(d > 0.0003, 1.0, 0.0), 0.0, 1.0),
            "continuous function",
        ),
        (lambda: force_at_one_second(lambda d: d * np.nan, 0.0, 1.0), "finite"),
        (lambda: force_at_one_second(lambda d: d * np.nan, 0.0), "finite"),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(ConfigurationError, match=message):
        make()
