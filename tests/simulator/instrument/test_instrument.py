"""Instruments: each term by itself, and the gel that drifts with them."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError, FrameError
from eitskin.geometry import SensorDesign
from eitskin.hardware import Script, Step
from eitskin.simulator import (
    ForwardModel,
    Instrument,
    Protocol,
    Scene,
    Simulator,
    Status,
    Touch,
    age_gel,
)
from eitskin.simulator.instrument.drift import DAY, DRIFT_TIME, WARMING_TIME, RandomWalk
from eitskin.simulator.mechanics.touch_history import held_touches, recall_touches
from eitskin.simulator.mechanics.viscoelasticity import REFERENCE, Prony, elastic_force

from on_demand import OnDemand

stats = OnDemand("scipy.stats")

PAIRS = Protocol.pairwise(8)
FLAT = np.linspace(480.0, 850.0, 28).astype(complex)
FULL_SCALE = 850.0
OFF = Instrument(snr_db=0.0)
ALL = dataclasses.replace(Instrument.ad5940(), gel_drift=0.05)


def only(**terms):
    return dataclasses.replace(OFF, **terms)


def started(instrument, seed=0, protocol=PAIRS):
    return instrument.session(protocol, FULL_SCALE, np.random.default_rng((1, seed)))


def read(instrument, impedance=FLAT, *, seed=0, time=0.0, protocol=PAIRS):
    """One frame of a session; the same seed is the same session and the same noise."""
    session = started(instrument, seed, protocol)
    frames = np.asarray(impedance, complex)[None]
    (Z,), (status,) = session.measure(frames, np.array([time]), np.random.default_rng((2, seed)))
    return Z, status


def test_without_terms_nothing_changes_and_noise_is_below_full_scale_in_quadratures():
    Z = FLAT * np.exp(-0.3j)
    measured, status = read(OFF, Z, time=1e6)
    np.testing.assert_array_equal(measured, Z)
    assert not status.any()
    assert not OFF.offsets(PAIRS).any()
    np.testing.assert_allclose(Instrument.ad5940().offsets(PAIRS), 10.6e-3 * np.arange(28))
    # White noise alone is the default, and the board has every term.
    assert Instrument() == only(snr_db=75.0)
    board = Instrument.ad5940()
    off = {name for name in Instrument.__slots__ if getattr(board, name) == getattr(OFF, name)}
    gel = {"gel_drift", "gel_warming", "gel_drying"}
    assert off == gel | {"excitation", "pga_range", "rtia", "meter"}
    frames = np.tile(FLAT, (1000, 1))
    session = started(only(snr_db=60.0))
    noise = session.measure(frames, np.zeros(1000), np.random.default_rng(3))[0] - FLAT
    expected = FULL_SCALE * 10 ** (-60 / 20)
    # 28,000 values: four standard errors of a standard deviation are 1.7 %.
    assert noise.real.std() == pytest.approx(expected, rel=0.017)
    assert noise.imag.std() == pytest.approx(expected, rel=0.017)
    assert abs(np.corrcoef(noise.real.ravel(), noise.imag.ravel())[0, 1]) < 0.024
    excitation = 0.015
    session = started(only(floor=1.9e-6, excitation=excitation))
    frames = np.tile(FLAT, (2000, 1))
    noise = session.measure(frames, np.zeros(2000), np.random.default_rng(4))[0] - FLAT
    expected = 1.9e-6 / (excitation / np.abs(FLAT))
    assert np.mean(noise.imag.std(axis=0) / expected) == pytest.approx(1.0, abs=0.012)
    assert np.mean(noise.real.std(axis=0) / expected) == pytest.approx(1.0, abs=0.012)


# ---- drift ----


@pytest.mark.slow
def test_walks_grow_as_the_root_of_time_and_the_gel_drifts_before_capacitances():
    times = DRIFT_TIME * np.array([1 / 64, 1 / 16, 1 / 4, 1.0])
    walks = np.array([RandomWalk(0.002, seed)(times) for seed in range(4000)])
    # Four standard errors of a standard deviation of 4,000 values are 4.5 %.
    np.testing.assert_allclose(walks.std(axis=0), 0.002 * np.sqrt(times / DRIFT_TIME), rtol=0.045)
    steps = np.diff(walks, axis=1)
    assert np.abs(np.corrcoef(steps.T) - np.eye(3)).max() < 0.064
    stray = {"stray_capacitance": (1e-9, 1e-9)}
    w = 2 * np.pi * 40e3
    for term, before in (("gel_drift", True), ("drift", False)):
        factor = read(only(**{term: 0.1}), time=DRIFT_TIME)[0] / FLAT
        Z = FLAT * factor if before else FLAT
        expected = Z / (1 + 1j * w * 1e-9 * Z) * (1 if before else factor)
        found = read(only(**{term: 0.1}, **stray), time=DRIFT_TIME)[0]
        np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("term", ["drift", "gel_drift"])
def test_drift_is_one_factor_for_all_measurements_from_the_sessions_start(term):
    instrument = only(**{term: 0.002})
    np.testing.assert_array_equal(read(instrument)[0], FLAT)
    factor = read(instrument, time=DRIFT_TIME)[0] / FLAT
    session = started(instrument)
    walk = session.gel if term == "gel_drift" else session.drift
    np.testing.assert_allclose(factor, np.exp(walk(np.array([DRIFT_TIME]))[0]), rtol=1e-12)
    later = np.array([read(instrument, time=DRIFT_TIME, seed=seed)[0][0] for seed in range(1000)])
    assert np.log(later / FLAT[0]).real.std() == pytest.approx(0.002, rel=0.09)


# ---- gain, phase, reciprocity ----


@pytest.mark.slow
@pytest.mark.parametrize(
    ("term", "deviation", "limit"), [("gain", 0.0125, 0.0125), ("phase_deg", 0.1, 0.3)]
)
def test_gain_and_phase_have_their_deviation_and_end_at_their_limit(term, deviation, limit):
    factors = np.array([read(only(**{term: deviation}), seed=s)[0] / FLAT for s in range(1000)])
    assert np.ptp(factors, axis=1).max() < 1e-12
    if term == "gain":
        found = factors[:, 0].real - 1
        assert np.abs(factors.imag).max() == 0.0
    else:
        found = np.angle(factors[:, 0], deg=True)
        np.testing.assert_allclose(np.abs(factors), 1.0, rtol=1e-12)
    expected = deviation * stats.truncnorm.std(-limit / deviation, limit / deviation)
    assert found.std() == pytest.approx(expected, rel=0.09)
    assert np.abs(found).max() <= limit
    assert abs(found.mean()) < 4 * deviation / np.sqrt(1000)


def test_frames_are_the_same_at_once_and_reciprocal_but_for_their_errors():
    rows = Protocol.adjacent(8)
    reciprocal = [rows.table.index((c, d, a, b)) for a, b, c, d in rows.table]
    flat = np.full(len(rows), 100.0)
    sessions = (read(only(reciprocity=0.004), flat, seed=s, protocol=rows)[0] for s in range(200))
    error = np.array([Z.real / 100.0 - 1.0 for Z in sessions])
    # 4,000 pairs: four standard errors of a standard deviation are 4.5 %.
    assert len(np.unique(error[0])) == len(rows)
    assert (error - error[:, reciprocal]).std() == pytest.approx(0.004, rel=0.045)
    assert error.std() == pytest.approx(0.004 / np.sqrt(2), rel=0.045)
    session = started(dataclasses.replace(ALL, snr_db=0.0, floor=0.0))
    frames, times = np.tile(FLAT, (4, 1)), np.array([0.0, 5.0, 4000.0, 90000.0])
    rng = np.random.default_rng(0)
    together, _ = session.measure(frames, times, rng)
    for k in (2, 0, 3, 1):
        alone, _ = session.measure(frames[k : k + 1], times[k : k + 1], rng)
        np.testing.assert_array_equal(alone[0], together[k])


# ---- stray capacitance ----


def test_stray_capacitance_turns_by_its_ohms_and_is_that_of_the_drive_pair():
    """The capacitor is a further element of the network, whose nodal equations are solved."""
    w = 2 * np.pi * 40e3
    assert 1 / (w * 100e-12) == pytest.approx(39.8e3, rel=1e-3)
    (one,), _ = read(
        only(stray_capacitance=(1e-10, 1e-10)), [1000.0], protocol=Protocol.pairwise(2)
    )
    drawn = read(only(stray_capacitance=(40e-12, 100e-12)))[0]
    capacitance = (1 / drawn).imag / w
    assert (capacitance.min(), capacitance.max()) == pytest.approx((42e-12, 98e-12), abs=2.1e-12)
    assert one == pytest.approx(1 / (1 / 1000.0 + 1j * w * 100e-12), rel=1e-12)
    assert np.angle(one, deg=True) == pytest.approx(-1.4397, abs=1e-4)
    rows = Protocol(((2, 3, 2, 3), (0, 1, 0, 1), (0, 1, 2, 3), (1, 0, 3, 2)), 4)
    ohm = np.array([300.0, 600.0, 60.0, 60.0])
    found, _ = read(only(stray_capacitance=(40e-12, 100e-12)), ohm, protocol=rows)
    shunt = ohm / found
    np.testing.assert_allclose(shunt[2:], shunt[1], rtol=1e-12)
    assert shunt[0].imag / 300.0 != pytest.approx(shunt[1].imag / 600.0, rel=1e-3)
    C = 1e-9
    instrument, rng = only(stray_capacitance=(C, C)), np.random.default_rng(0)
    session = instrument.session(ADJACENT, 100.0, rng)
    both = instrument.terminal_impedances(Z, ADJACENT)
    found, _ = session.measure(both[None], np.zeros(1), rng)
    Y = np.linalg.pinv(Z)
    for (a, b, c, d), value in zip(ADJACENT.table, found[0], strict=True):
        e = np.zeros(N)
        e[[a, b]] = 1.0, -1.0
        V = np.linalg.pinv(Y + 2j * np.pi * 40e3 * C * np.outer(e, e)) @ e
        assert value == pytest.approx(V[c] - V[d], rel=1e-9)


# ---- four terminals ----

N, ADJACENT = 8, Protocol.adjacent(8)


def network(seed=0, ohm=300.0):
    """Impedance matrix (N, N) of a lossy random network [ohm], with zero sums."""
    root = np.random.default_rng(seed).standard_normal((N, N))
    centred = np.eye(N) - 1.0 / N
    contacts = np.diag(1.0 + 0.1j * np.arange(N))
    return ohm / N * centred @ (root @ root.T + contacts) @ centred


Z = network()


@pytest.mark.parametrize("protocol", [ADJACENT, Protocol.opposite(N), PAIRS], ids=str)
def test_terminal_impedances_are_those_of_a_current_through_the_drive_pair(protocol):
    both = Instrument.ad5940().terminal_impedances(Z, protocol)
    for i, (a, b, c, d) in enumerate(protocol.table):
        V = Z[:, a] - Z[:, b]
        assert both[0, i] == pytest.approx(V[c] - V[d], rel=1e-12)
        assert both[1, i] == pytest.approx(V[a] - V[b], rel=1e-12)


def test_the_drive_pair_limits_the_current_and_the_sensed_voltage_its_range():
    """Drive pairs of 100 ohm take 0.607 V only up to 3 mA: 121 mV is the largest that fits."""
    both = np.array([[0.5], [100.0]])[None].astype(complex)
    rows = Protocol(((0, 1, 2, 3),), 4)
    full = only(clipping=True, quantisation=True)
    session = full.session(rows, 1.0, np.random.default_rng(0))
    (value,), (status,) = session.measure(both, np.zeros(1), np.random.default_rng(0))
    assert not status.any()
    current = 0.121 / 100.0
    code = 0.133 / 2**17 / current
    assert value[0].real == pytest.approx(round(0.5 / code) * code, rel=2e-5)
    forced = dataclasses.replace(full, excitation=0.607).session(
        rows, 1.0, np.random.default_rng(0)
    )
    _, (clipped,) = forced.measure(both, np.zeros(1), np.random.default_rng(0))
    assert clipped.tolist() == [Status.CLIPPED]


# ---- what is refused ----


def test_times_that_no_session_has_and_frames_that_do_not_fit_are_refused():
    for time in (-1.0, np.nan, np.inf, 4e7):
        with pytest.raises(ConfigurationError, match="times from 0 to"):
            read(ALL, time=time)
    neighbours = Protocol.adjacent(8)
    for term in ({"floor": 1e-6}, {"quantisation": True}, {"clipping": True}):
        with pytest.raises(ConfigurationError, match="terminal_impedances"):
            read(only(**term), np.full(len(neighbours), 50.0), protocol=neighbours)
    session, rng = started(ALL), np.random.default_rng(0)
    for shape, times in (((28,), 1), ((2, 27), 2), ((2, 28), 3)):
        with pytest.raises(FrameError, match=r"\(frames, 28\)"):
            session.measure(np.ones(shape, complex), np.zeros(times), rng)
    with pytest.raises(FrameError, match="finite"):
        session.measure(np.full((1, 28), np.nan + 0j), np.zeros(1), rng)


# The gel as it warms, dries and tires


PROTOCOL = Protocol.pairwise(8)


def factors(times, **terms):
    """Factors on all impedances in a session without other terms."""
    instrument = dataclasses.replace(Instrument.ideal(), **terms)
    session = instrument.session(PROTOCOL, 1.0, np.random.default_rng(3))
    ones = np.ones((len(times), len(PROTOCOL)), complex)
    values, _ = session.measure(ones, np.array(times), np.random.default_rng(4))
    assert np.ptp(np.abs(values), axis=1) == pytest.approx(0.0, abs=1e-12)
    return values[:, 0].real


def test_gels_conduct_by_warmth_and_dryness_and_change_as_the_aged_sensor():
    """Half of the water: 55 % of the thickness, polymer from 10 to 18.2 %."""
    warm = factors([0.0, WARMING_TIME, 1e6], gel_warming=(5.0, 5.0))
    assert 1.0 / warm == pytest.approx([1.0, 1.0 + 0.1 * (1.0 - np.exp(-1.0)), 1.1], rel=1e-9)
    f = 0.1 / 0.55
    expected = ((1 - f) / (1 + f)) ** 2 / (0.9 / 1.1) ** 2
    dry = factors([0.0, DAY], gel_drying=(0.5, 0.5))
    assert 1.0 / dry == pytest.approx([1.0, expected], rel=1e-9)
    design = SensorDesign.reference()
    electrodes = tuple(
        dataclasses.replace(each, contact_impedance=1e-9) for each in design.electrodes
    )
    fresh = dataclasses.replace(design, electrodes=electrodes)
    aged = age_gel(fresh, warming=3.0, water=0.8)
    assert aged.encapsulated_thickness - aged.thickness == pytest.approx(0.007)
    before, after = (
        PROTOCOL.measure(ForwardModel(sensor, "coarse").impedance()) for sensor in (fresh, aged)
    )
    # The temperature is reached within days.
    factor = factors([10 * DAY], gel_warming=(3.0, 3.0), gel_drying=(1 - 0.8**0.1,) * 2)
    assert after / before == pytest.approx(np.full(28, factor), rel=1e-4)
    for wrong in ({"water": 0.0}, {"warming": 90.0}):
        with pytest.raises(ConfigurationError):
            age_gel(fresh, **wrong)


@pytest.mark.slow
def test_cycles_on_one_place_approach_their_sum_and_deepen_later_touches():
    """A standard linear solid, held for a and free for b: the rest of n holds is a series."""
    g, tau, a, b, force = 0.4, 5.0, 3.0, 2.0, 4.0
    solid, touch = Prony((g,), (tau,)), Touch(0.05, 0.03, force)
    steps = [
        (k * (a + b) + start, each) for k in range(60) for start, each in ((0, [touch]), (a, []))
    ]
    for n in (1, 2, 60):
        (now,) = recall_touches(held_touches(steps[: 2 * n - 1]), (n - 1) * (a + b) + a, solid)
        loads = ((now.force, now.held, now.released), *now.before)
        total = sum(elastic_force(solid, *load) for load in loads)
        amplitude, time = g / (1.0 - g), tau / (1.0 - g)
        q = np.exp(-(a + b) / time)
        series = (1.0 - np.exp(-a / time)) * (1.0 - q**n) / (1.0 - q)
        assert total == pytest.approx(force * (1.0 + amplitude * series), rel=2e-3)
    # In a script that relaxes; elsewhere the earlier touch fades on its own.
    here, there = Touch(0.05, 0.03, 8.0), Touch(0.10, 0.03, 8.0)
    steps = (Step(Scene(touches=(here,)), 30), Step(Scene(), 2))
    script = Script((*steps, Step(Scene(touches=(here, there)), 10)), relaxing=0.3)
    first, faded, second = script(0).touches, script(31).touches, script(33).touches
    assert [touch.held for touch in first] == [0.0]
    assert faded[0].released == pytest.approx(0.3)
    assert [touch.x for touch in second] == [0.05, 0.10]
    late, later = (script(33 + 42 * n).touches[0].before for n in (1000, 100_000))
    assert len(later) > 1
    assert np.allclose(late, later, rtol=1e-6)
    simulator = Simulator(SensorDesign.reference(), "coarse")
    again, alone = simulator.presses(Scene(touches=second))
    (earlier,), residual = second[0].before, elastic_force(REFERENCE, *second[0].before[0])
    assert earlier == pytest.approx((8.0, 9.0, 0.9))
    assert 0.2 < residual < 1.0
    whole = Touch(0.05, 0.03, elastic_force(REFERENCE, 8.0, 0.3) + residual)
    expected = simulator.presses(Scene(touches=(whole, there)))[0].depth
    assert again.depth == pytest.approx(expected, rel=2e-3)
    assert again.depth > 1.01 * alone.depth
    with pytest.raises(ConfigurationError):
        Touch(0.05, 0.03, 8.0, before=((1.0, 1.0, 1.0),))
