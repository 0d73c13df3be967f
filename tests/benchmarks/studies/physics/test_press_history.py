"""Histories of presses against plain convolutions, superposition and thermodynamics."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.benchmarks.studies.physics.press_history import ForceHistory, Memory
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


@pytest.mark.slow
@steady
@given(histories(closed=True), st.sampled_from([GEL, ECOFLEX, Prony((0.3, 0.4), (0.2, 5.0))]))
def test_closed_cycles_dissipate(history, prony):
    assert dissipated(history, prony) >= -1e-12 * np.square(history.forces).sum()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ForceHistory(np.array([]), np.array([])), "one or more"),
        (lambda: ForceHistory(np.array([0.0, 1.0]), np.array([1.0])), "as many forces"),
        (lambda: ForceHistory(np.array([1.0, 0.0]), np.array([1.0, 1.0])), "never fall"),
        (lambda: ForceHistory(np.array([0.0, np.nan]), np.array([1.0, 1.0])), "finite"),
        (lambda: ForceHistory(np.array([0.0]), np.array([-1.0])), "not negative"),
        (lambda: ForceHistory(np.zeros(1), np.ones(1)).elastic_force(GEL, np.nan), "finite"),
        (lambda: Memory.none(GEL).after(-1.0, 1.0), "seconds"),
        (lambda: Memory.none(GEL).after(1.0, float("nan")), "force"),
    ],
)
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(ConfigurationError, match=message):
        make()
