"""Sessions: references, order of frames, doubts, and references that are stored."""

import dataclasses
import math
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eitskin.datasets import State
from eitskin.errors import ConfigurationError, DataError, FrameError
from eitskin.geometry import Bend, SensorDesign
from eitskin.simulator import Frame, Protocol, Scene, Simulator, Touch
from eitskin.training import StoredReference, Zero
from eitskin.training.method.observations import relative_difference
from eitskin.training.pipeline.flat_sensors import FALSE_ALARM, MIN_SPECIMENS, FlatSensors
from eitskin.training.pipeline.held_touch import HeldTouch
from eitskin.training.pipeline.references import MAX_ELAPSED_TIME, MAX_MEAN_FRAMES, SessionOrder
from eitskin.training.pipeline.session import Session

NOISE = 3e-4  # of the difference of two frames
FLAT = np.linspace(400.0, 820.0, 28) * np.exp(-0.02j)
BENT = FLAT * np.linspace(1.01, 1.05, 28)


def frames(truth, count, seed=0):
    """Noisy frames of a still sensor; each has 1 / sqrt(2) of the noise of a difference."""
    noise = np.random.default_rng(seed).normal(size=(2, count, 28)) * NOISE / np.sqrt(2)
    return truth * (1 + noise[0] + 1j * noise[1])


def error(reference, truth):
    return np.sqrt(np.mean(relative_difference(reference, truth) ** 2))


def averaged(*stills):
    session = Session(NOISE)
    for frame in (frame for still in stills for frame in still):
        session.average(frame)
    return session


@given(gain=st.floats(0.1, 10), phase=st.floats(-3, 3))
def test_difference_is_relative_real_and_blind_to_gain_and_phase(gain, phase):
    V, ref = np.array([11.0 + 1j]), np.array([10.0 + 1j])
    turned = gain * np.exp(1j * phase)
    assert relative_difference(V * turned, ref * turned) == pytest.approx(((V - ref) / ref).real)


def test_references_are_means_of_a_still_sensor_frozen_by_a_touch_until_a_new_beginning():
    """Of the opening for the static one, of the latest stillness for the dynamic one."""
    for count in (2, 5, MAX_MEAN_FRAMES):
        still = frames(FLAT, count)
        session = averaged(still)
        np.testing.assert_allclose(session.touch, still.mean(axis=0), rtol=1e-13)
        np.testing.assert_array_equal(session.touch, session.bend)
    assert averaged(frames(FLAT, 2000)).dynamic.count == MAX_MEAN_FRAMES
    session = averaged(frames(FLAT, 20), frames(BENT, 20, seed=1))
    assert error(session.touch, BENT) < NOISE / 3
    opening = session.bend.copy()
    assert error(opening, FLAT) < NOISE / 3
    for frame in frames(FLAT, 20, seed=2):
        session.average(frame)
    np.testing.assert_array_equal(session.bend, opening)
    drift = np.linspace(1.0, 1.01, 1000)  # a hundredth of the noise per frame at first
    slow = averaged(FLAT * drift[:, None])
    assert error(slow.touch, FLAT * drift[-1]) < 2 * NOISE
    assert error(slow.bend, FLAT) < NOISE  # or a slow bend would become the zero
    session = averaged(frames(FLAT, 5))
    session.renew(FLAT, touched=True)
    frozen, opening = session.touch.copy(), session.bend.copy()
    session.renew(FLAT, touched=True)
    np.testing.assert_array_equal(session.touch, frozen)
    session.average(FLAT)
    np.testing.assert_array_equal(session.bend, opening)
    session.begin()
    assert session.empty
    session.average(BENT)
    np.testing.assert_array_equal(session.bend, BENT)


STEADY = tuple((n, 0.3 * n) for n in range(5))
AHEAD = ((5_000_000, 1.5), (5, 4294.9), (5_000_000, 1e300), (2**31, 9e9))
# Frames (number, time) or (number, time, session); whether the last one begins a session, words of
# its problem, time elapsed.
ORDERS = [
    (STEADY, False, "", 1.2),
    ((*STEADY, (5, 1.5, 1)), True, "session 1 follows session 0", 0.0),
    ((*STEADY, (2, 0.1)), True, "2 follows 4", 0.0),
    ((*STEADY, (5, 4294.9), (0, 0.0)), True, "0 follows 5", 0.0),
    (((4, 1.0), (4, 1.3)), False, "", 0.3),
    (((2**32 - 1, 1.0), (0, 1.3)), False, "", 0.3),
    (((4, 1.0), (900, 1.3)), False, "", 0.3),
    ((*STEADY, (5, 0.2)), False, "frame 5: the clock ran back by 1 s; the references stay", 1.2),
    ((*STEADY, (2, 1.5)), False, "its number follows 4", 1.5),
    ((*STEADY, (6, 1.8), (5, 1.5)), False, "it comes after frame 6; the references stay", 1.8),
    ((*STEADY, (5, 3600.0)), False, "jumped ahead", 3600.0),
    ((*STEADY, (54, 1.5)), False, "ahead by 50, in 0.3 s", 1.5),
    ((*STEADY, (24, 7.2)), False, "", 7.2),  # lost frames
    ((*STEADY, (5, 4.0)), False, "", 4.0),  # a short pause
    (((0, -1e308), (1, 1e308)), False, "", MAX_ELAPSED_TIME),
    *(((*STEADY, wrong, (6, 1.8)), False, "", 1.8) for wrong in AHEAD),
    *(
        case
        for time in (math.nan, math.inf, -math.inf)
        for case in (
            ((*STEADY, (5, time)), False, f"its time is {time}", 1.2),
            ((*STEADY, (5, time), (6, 1.8)), False, "", 1.8),
            (((0, time), (1, 7000.0), (2, 7000.3)), False, "", 0.3),
        )
    ),
]


@pytest.mark.parametrize(("given", "begins", "problem", "elapsed"), ORDERS)
def test_order_of_frames(given, begins, problem, elapsed):
    order = SessionOrder()
    for number, time, *session in given:
        step = order.follow(Frame(np.ones(3), Protocol.pairwise(3), time, number, *session))
    assert step.new_session == begins
    assert step.gap == ("jumped" in problem or given[-1] == (24, 7.2) or given[-1][1] == 1e308)
    assert problem in " ".join(step.problems)
    assert len(step.problems) == bool(problem)
    assert order.elapsed_time == pytest.approx(elapsed)


def shown(places, noise=1e-4, seed=0):
    """Places that frames of a moving touch show in a session, and how many frames each is of."""
    rng, flat, turn = np.random.default_rng(seed), np.full(28, 500.0), np.arange(28)
    response = {p: flat * (1.0 + 1e-3 * np.sin(0.08 * p + turn)) for p in np.arange(0.0, 60.0, 0.1)}
    session, seen, counts = Session(3e-4, averages=True), [], []
    for number, place in enumerate([None] * 12 + list(places)):
        value = flat if place is None else response[min(response, key=lambda p: abs(p - place))]
        V = value * (1.0 + noise * rng.standard_normal(28)) + 0j
        session.follow(Frame(V, Protocol.pairwise(8), time=0.3 * number, number=number))
        if session.empty:
            session.average(V)
        row = session.to_observations(V)
        session.renew(V, touched=place is not None)
        if place is None:
            continue
        near = min(response, key=lambda p: np.linalg.norm(response[p] / flat - 1.0 - row.static[0]))
        seen.append(near)
        counts.append(round(row.frames[0] / row.static_frames[0] * session.static.count))
    return np.array(seen), np.array(counts)


def test_frames_of_a_touch_that_stands_are_averaged():
    seen, counts = shown([20.0] * 12)
    assert list(counts) == [1, 2, 3, 4, 5, 6, 7, 8, 8, 8, 8, 8]
    assert abs(seen[-1] - 20.0) < 0.6


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0, 4.0])
def test_a_touch_that_slides_is_not_dragged_behind(speed):
    """The mean over eight frames lags by three and a half of them."""
    places = 10.0 + speed * np.arange(12)
    seen, _ = shown(places)
    assert np.sqrt(np.mean((seen - places)[4:] ** 2)) < 0.9


def test_a_touch_that_lingers_waits_for_a_bend_that_settles_it():
    """A bend hides it that is too small at first to show that it is one."""
    force, along, turn = np.random.default_rng(3).standard_normal((3, 28)) * 2e-3
    session, values = Session(NOISE, averages=True), frames(FLAT, 15)
    for number, value in enumerate(values[:12]):
        session.follow(Frame(value, Protocol.pairwise(8), time=0.3 * number, number=number))
        if session.empty:
            session.average(value)
        session.to_observations(value)
        session.renew(value, touched=False)
    shares = zip(values[12:], (0.0, 0.1, 3.0), strict=True)
    touched, barely, bent = (value * (1.0 + force + share * turn) for value, share in shares)
    session.renew(touched, touched=True, directions=np.array([along, along, force, turn]))
    for value, hides in ((barely, False), (bent, True)):
        observed = session.to_observations(value)
        assert (session.with_hidden(value, observed) is not None) == hides
        session.renew(value, touched=False)
        assert any("an earlier touch" in problem for problem in session.problems(("",) * 28))
    assert error(session.touch, FLAT * (1.0 + 3.0 * turn)) < 1e-3


# ---- flat sensors ----

RNG = np.random.default_rng(3)
C = 10
MIXING = RNG.normal(size=(3, C)) * 0.02
BEND = np.array([RNG.normal(size=C) * 0.03, RNG.normal(size=C) * 0.004])
ANGLES = np.linspace(-20.0, 50.0, 15)
ODD = np.exp(0.1 * (np.arange(C) == 4))


def change(angle_deg):
    t = np.asarray(angle_deg)[..., None] / 45.0
    return t * BEND[0] + t**2 * BEND[1]


def sensors(count, angle_deg=0.0, seed=0):
    """Sensors of any conductivity, which differ in three directions and by a board's paths."""
    rng = np.random.default_rng(seed)
    logs = np.log(np.linspace(400.0, 800.0, C)) + rng.normal(size=(count, 3)) @ MIXING
    logs = logs + change(angle_deg) + 0.004 * rng.normal(size=(count, C))
    return np.exp(logs + 0.3 * rng.normal(size=(count, 1)) - 0.01j)


@lru_cache
def known(count=200):
    return FlatSensors.fit(sensors(count), ANGLES, change(ANGLES))


def doubted(judge, values):
    return np.mean([bool(judge.judge(each).doubt) for each in values])


@pytest.mark.parametrize("count", [MIN_SPECIMENS, 20, 200])
def test_flat_sensors_are_seldom_doubted(count):
    assert doubted(known(count), sensors(400, seed=1)) <= 10 * FALSE_ALARM
    chances = [known().judge(each).chance for each in sensors(400, seed=2)]
    assert np.quantile(chances, [0.1, 0.5, 0.9]) == pytest.approx([0.1, 0.5, 0.9], abs=0.2)


def test_bent_and_odd_sensors_are_doubted_by_a_distribution_of_specimens():
    starts = [known().judge(each) for each in sensors(200, 40.0, seed=4)]
    assert np.mean(["a bend of" in start.doubt for start in starts]) > 0.9
    errors = np.array([(start.bend_deg - 40.0) / start.deviation_deg for start in starts])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.25)
    start = known().judge(sensors(1, seed=5)[0] * ODD)
    assert start.chance < FALSE_ALARM
    assert "does not look flat" in start.doubt
    bent = sensors(1, 50.0, seed=6)[0]
    whole = known().judge(bent)
    assert FlatSensors.fit(sensors(50)).judge(bent).bend_chance == 1.0  # knows no bends
    bent[3] = np.nan
    assert known().judge(bent).bend_deg == pytest.approx(whole.bend_deg, abs=10.0)
    assert known().judge(np.full(C, np.nan)).doubt == ""
    assert FlatSensors.fit(sensors(MIN_SPECIMENS - 1)) is None
    assert FlatSensors.fit(np.repeat(sensors(1), 20, axis=0)) is None
    again = FlatSensors.from_arrays(known().arrays())
    value = sensors(1, 20.0, seed=8)[0]
    assert again.judge(value).chance == pytest.approx(known().judge(value).chance, rel=1e-4)
    assert again.judge(value).bend_deg == known().judge(value).bend_deg
    strange = sensors(1, seed=5)[0] * ODD
    own = known().for_sensor(np.abs(strange))
    later = 1.3 * strange * np.exp(0.004 * np.random.default_rng(9).normal(size=(100, C)))
    assert doubted(known(), later) == 1.0
    assert doubted(own, later) <= 10 * FALSE_ALARM
    bent = [own.judge(each) for each in later * np.exp(change(40.0))]
    assert np.mean([bool(start.doubt) for start in bent]) > 0.9
    assert np.median([start.bend_deg for start in bent]) == pytest.approx(40.0, abs=5.0)
    partly = np.where(np.arange(C) == 2, np.nan, np.abs(strange))
    assert not known().for_sensor(partly).judge(strange).doubt


@pytest.mark.parametrize("speed", [0.0, 0.006, 0.015])
def test_a_standard_error_covers_a_motion_that_the_mean_of_frames_hides(speed):
    """A touch whose place one frame shows to 5 mm stands, then slides: no mean of eight follows."""
    along = 0.04 * np.linalg.qr(np.random.default_rng(2).normal(size=(28, 3)))[0].T
    places, seen = np.concatenate([np.zeros(20), speed * np.arange(1, 7)]), []
    for seed in range(8):
        rng, held = np.random.default_rng(seed), HeldTouch(3e-4, directions=along)
        for n, place in enumerate(places):
            V = FLAT * (1.0 + along[0] * place + 2e-4 * rng.standard_normal(28))
            count = held.add(V, FLAT, held=n > 0)[1]
            seen.append((place - places[n + 1 - count : n + 1].mean(), count, held.lag.sum()))
    lag, count, variance = np.array(seen).reshape(8, -1, 3)[:, 15:].transpose(2, 0, 1)
    errors = lag**2 + 0.005**2 / count
    assert 0.75 < np.sqrt(errors.mean() / np.mean(variance + 0.005**2 / count)) < 1.75
    assert count[:, :5].mean() > 6.0
    assert speed < 0.006 or count[:, -1].mean() < 3.5


# Stored references


BOARD_NOISE = 1e-4
PROTOCOL = Protocol.pairwise(8)
PRESS = (Touch(0.05, 0.02, force=9.0),)


@pytest.fixture
def pipeline(pipeline):
    pipeline.use(None)
    return pipeline


@pytest.fixture(scope="module")
def truth():
    """Noise-free values by name."""
    scenes = [Scene(), Scene(Bend(30.0)), Scene(Bend(30.0), PRESS), Scene(Bend(20.0))]
    simulator = Simulator(SensorDesign.reference(), resolution="fast")
    names = ("flat", "bent", "pressed", "back")
    return dict(zip(names, simulator.measure_all(scenes), strict=True))


def read_frames(values, count=8, first=0, seed=0):
    noisy = values * (1 + BOARD_NOISE * np.random.default_rng(seed).normal(size=(count, 28)))
    return [Frame(z, PROTOCOL, 0.3 * n, n) for n, z in enumerate(noisy, first)]


def last(pipeline, given):
    return [pipeline.process(frame) for frame in given][-1]


@pytest.mark.parametrize("name", ["flat", "bent", "pressed"])
def test_a_start_that_is_not_flat_is_told_and_its_angle_unknown(pipeline, truth, name):
    estimate = last(pipeline, read_frames(truth[name]))
    assert estimate.zero is Zero.FIRST_FRAMES
    if name == "flat":
        assert (estimate.state, estimate.problems) == (State.IDLE, ())
        return
    assert estimate.state is None
    assert estimate.bend_angle_deg is estimate.bend_deviation_deg is None
    assert np.isnan(estimate.probabilities[[State.IDLE, State.BEND]]).all()
    (problem,) = estimate.problems
    assert "does not look flat" in problem
    assert "eitskin tare" in problem
    naive = dataclasses.replace(pipeline, flat_sensors=None)  # knows too few specimens
    assert last(naive, read_frames(truth["bent"])).problems == ()


@pytest.mark.parametrize(
    ("name", "state", "touches"),
    [("flat", State.IDLE, 0), ("bent", State.BEND, 0), ("pressed", State.TOUCH, 1)],
)
def test_with_a_reference_any_start_is_estimated(pipeline, truth, name, state, touches):
    pipeline.tare(read_frames(truth["flat"]))
    estimate = last(pipeline, read_frames(1.01 * truth[name], seed=1))
    assert (estimate.state, len(estimate.touches)) == (state, touches)
    assert estimate.bend_angle_deg == pytest.approx(0.0 if name == "flat" else 30.0, abs=3.0)
    assert (estimate.zero, estimate.problems) == (Zero.FLAT, ())
    if touches:
        assert estimate.touches[0][:2] == pytest.approx((0.05, 0.02), abs=5e-3)


def test_mounted_sensors_are_estimated_from_their_shape_and_other_frames_change_nothing(
    pipeline, truth
):
    with pytest.raises(DataError, match="--mounted"):
        pipeline.tare(read_frames(truth["bent"]))
    pipeline.tare(read_frames(truth["bent"]), Zero.MOUNTED)
    estimate = last(pipeline, read_frames(truth["bent"], seed=2))
    assert (estimate.state, estimate.zero, estimate.problems) == (State.IDLE, Zero.MOUNTED, ())
    estimate = last(pipeline, read_frames(truth["back"], first=8))
    assert estimate.state is State.BEND
    assert estimate.bend_angle_deg == pytest.approx(-10.0, abs=9.0)
    assert estimate.bend_deviation_deg is None
    reference = pipeline.tare(read_frames(truth["flat"]), board="0102", source="virtual:")
    moving = [*read_frames(truth["flat"], 3), *read_frames(truth["bent"], 3, first=3)]
    with pytest.raises(DataError, match="moves in frame 4 of 6"):
        pipeline.tare(moving)
    with pytest.raises(ConfigurationError, match="got none"):
        pipeline.tare([])
    with pytest.raises(FrameError, match="times those"):
        pipeline.use(dataclasses.replace(reference, impedance=40.0 * reference.impedance))
    assert pipeline.stored_reference is reference


@pytest.fixture
def reference(truth):
    values = [frame.impedance for frame in read_frames(truth["flat"])]
    return StoredReference.from_frames(
        values, PROTOCOL, 40e3, Zero.FLAT, board="0102", source="virtual:"
    )


def test_the_file_brings_everything_back(reference, tmp_path):
    impedance = np.where(np.arange(28) == 4, np.nan, reference.impedance)
    kept = dataclasses.replace(reference, impedance=impedance)
    again = StoredReference.read(kept.write(tmp_path / "r.json"))
    np.testing.assert_array_equal(again.impedance, impedance)
    others = StoredReference.__slots__[1:]
    assert [getattr(again, name) for name in others] == [getattr(kept, name) for name in others]
    assert reference.noise == pytest.approx(BOARD_NOISE * np.sqrt(2), rel=0.005)
