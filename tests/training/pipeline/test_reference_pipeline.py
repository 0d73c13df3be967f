"""The pipeline that ships with eitskin, on frames of the simulator."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from eitskin.benchmarks.paper.scores import replay
from eitskin.datasets import Recipe, State
from eitskin.datasets.generation.shard_simulation import simulate_frames
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.errors import DataError, FrameError
from eitskin.geometry import Bend, Clamp, Plates, SensorDesign
from eitskin.simulator import Frame, Instrument, Protocol, Scene, Simulator, Touch
from eitskin.training import FrameLabel, Pipeline, TouchLabel
from eitskin.training.joint import method as joint
from eitskin.training.joint.model_selection import PlainFit, fit_plain

pytestmark = pytest.mark.slow

DESIGN = SensorDesign.reference()
ANGLES = (-20.0, 0.0, 15.0, 30.0, 50.0)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(DESIGN, "fast")


class Session:
    """Frames of scenes, as a board with white noise gives them, through the shipped pipeline."""

    def __init__(self, simulator, seed=0):
        self.pipeline, self.simulator = Pipeline.load("reference.eitmodel"), simulator
        self.rng, self.number = np.random.default_rng(seed), 0

    def frame(self, scene, **changes):
        frame = self.simulator.measure(scene, Instrument(), self.rng)
        self.number += 1
        counted = {"time": 0.3 * self.number, "number": self.number}
        return replace(frame, **counted | changes)

    def __call__(self, scene, **changes):
        return self.pipeline.process(self.frame(scene, **changes))


@pytest.fixture
def session(simulator):
    session = Session(simulator)
    for _ in range(4):
        assert session(Scene()).state is State.IDLE
    return session


def assert_touched(said, *places):
    """Touches are found within 5 mm of these places."""
    assert said.state is State.TOUCH
    found = sorted([touch.x, touch.y] for touch in said.touches)
    assert len(found) == len(places)
    assert np.linalg.norm(np.subtract(found, sorted(places)), axis=1).max() < 5e-3


def test_the_response_learned_is_that_of_the_simulator_without_noise(simulator):
    """Within 8 % of the change by single touches near and far from the rim, flat and bent."""
    method = Pipeline.load("reference.eitmodel").method
    touches = np.random.default_rng(4).uniform((0.012, 0.012, 4.0), (0.138, 0.048, 11.0), (20, 3))
    errors = []
    for bend in (Bend(0.0), Bend(25.0)):
        scenes = [Scene(bend), *(Scene(bend, (Touch(*each),)) for each in touches.tolist())]
        values = np.abs([simulator.measure(scene).impedance for scene in (Scene(), *scenes)])
        change, flat = np.log(values[2:] / values[1]), values[0]
        learned = method.responses(flat)[0](touches, bend.angle_deg)
        errors.append(np.linalg.norm(learned - change, axis=1) / np.linalg.norm(change, axis=1))
    assert np.sqrt(np.mean(np.square(errors), axis=1)).max() < 0.08


@pytest.mark.parametrize("angle_deg", [0.0, 30.0])
def test_touches_on_plates_are_found_and_no_others(angle_deg):
    """The plates that bend the sensor carry it; their response to touches and bends is another."""
    session = Session(Simulator(replace(DESIGN, support=Plates()), "fast"))
    for share in (0.0, 0.0, 0.5, 1.0, 1.0):
        session(Scene(Bend(share * angle_deg)))
    assert session(Scene(Bend(angle_deg))).bend_angle_deg == pytest.approx(angle_deg, abs=3.0)
    for place in ((0.025, 0.020), (0.120, 0.035)):
        said = session(Scene(Bend(angle_deg), (Touch(*place, 8.0),)))
        assert said.state is State.TOUCH
        (touch,) = said.touches
        assert np.hypot(touch.x - place[0], touch.y - place[1]) < 3.0 * touch.deviation < 0.015
        assert session(Scene(Bend(angle_deg))).state is not State.TOUCH


def test_the_response_on_plates_is_fitted_only_where_it_may_hold(simulator, monkeypatch):
    """Estimates are those of both fits; most touches on a base need one."""
    fits, places = [], []
    monkeypatch.setattr(joint, "fit_plain", lambda *given: fits.append(1) or fit_plain(*given))
    for weighs_both in (False, True):
        if weighs_both:
            monkeypatch.setattr(PlainFit, "may_fit_better", lambda *_: True)
        session = Session(simulator)
        touched = Scene(touches=(Touch(0.05, 0.02, 8.0), Touch(0.11, 0.04, 6.0)))
        estimates = list(map(session, [Scene()] * 4 + [touched, Scene()] * 4))
        places.append([touch.x for each in estimates for touch in each.touches])
        fits.append(0)
    assert len(places[0]) == 8
    assert places[0] == places[1]
    first = fits.index(0)
    assert first < 0.8 * sum(fits[first:])


def test_taps_that_begin_with_the_session_are_not_taken_for_noise(simulator):
    session, places = Session(simulator), ((0.05, 0.02), (0.11, 0.04))
    for _ in range(4):
        session(Scene())
        said = session(Scene(touches=tuple(Touch(*place, 8.0) for place in places)))
        assert_touched(said, *places)


def test_bent_sensors_are_told_where_touched_and_capacitances_by_phases(session):
    bend, places = Bend(30.0), [(0.040, 0.020), (0.110, 0.040)]
    for _ in range(3):
        bent = session(Scene(bend))
    assert bent.state is State.BEND
    assert abs(bent.bend_angle_deg - 30.0) < 3 * bent.bend_deviation_deg
    said = session(Scene(bend, (Touch(*places[0], 10.0), Touch(*places[1], 8.0))))
    assert_touched(said, *places)
    assert said.problems == ()
    assert session(Scene(bend)).state is State.BEND
    moving = session(Scene(Bend(34.0), (Touch(0.030, 0.030, 10.0),)))
    assert_touched(moving, (0.030, 0.030))
    flat = session.simulator.measure(Scene(), Instrument(), session.rng).impedance
    leaking = flat / (1.0 + 0.02j * (np.arange(len(flat)) == 5))
    for impedance, told in ((flat, False), (leaking, True), (leaking * np.exp(0.003j), True)):
        said = session(Scene(), impedance=impedance)
        assert any("a capacitance" in each for each in said.problems) == told


@pytest.mark.parametrize(
    ("angle_deg", "problem"),
    [(48.0, ""), *((angle, "-20 to 50 deg") for angle in (-32.0, 60.0, 65.0)), (80.0, "")],
)
def test_a_bend_beyond_those_learned_is_reported(session, angle_deg, problem):
    for share in (0.3, 0.6, 1.0, 1.0):
        estimate = session(Scene(Bend(share * angle_deg)))
    assert problem in " ".join(estimate.problems)
    assert bool(estimate.problems) == (angle_deg != 48.0)


def test_a_sensor_that_bends_fast_is_not_lost():
    """A reference that was measured meanwhile looks like changed contacts and a bend of 55 deg."""
    spread = dict.fromkeys(("conductivity", "contact_impedance"), 0.15)
    spread |= dict.fromkeys(("gel_modulus", "encapsulation_modulus"), 0.1)
    spread |= {"electrode_place": 5e-4, "hinge_span": 5e-4, "hinge_offset": 3e-4}
    recipe = replace(
        Recipe.from_shipped("paper_demo"),
        seed=3006,
        resolution="fast",
        reference_frames=8,
        specimens=Specimens(count=1, thickness=0.02, **spread),
    )
    data = simulate_frames(recipe, range(63))
    estimates = list(replay(Pipeline.load("reference.eitmodel"), data))[55:]
    assert {each.state for each in estimates} == {State.BEND}
    assert max(abs(each.bend_angle_deg - 20.0) for each in estimates) < 3.0


@pytest.mark.parametrize("change", [{"session": 1}, {"number": 0, "time": 0.0}])
def test_a_new_session_begins_with_new_references_and_is_told(session, change):
    assert session(Scene(Bend(30.0))).state is State.BEND
    assert "the clock ran back" in session(Scene(Bend(30.0)), time=0.0).problems[0]
    assert session(Scene(Bend(30.0))).state is State.BEND  # the references stay
    again = session(Scene(Bend(30.0)), **change)
    assert "a new session begins" in again.problems[0]
    assert again.state is None  # it does not look flat
    assert session(Scene(), session=2).bend_angle_deg == pytest.approx(0.0, abs=1.0)


PAIRS = Protocol.pairwise(8)
SWAPPED = Protocol((PAIRS.table[1], PAIRS.table[0], *PAIRS.table[2:]), 8)
REFUSED = {
    "table": (lambda flat: Frame(flat, SWAPPED), "a table for 8 electrodes"),
    "electrodes": (lambda flat: Frame(flat, Protocol(PAIRS.table, 16)), r"pairwise:8.*16 elec"),
    "frequency": (lambda flat: Frame(flat, PAIRS, frequency=50e3), r"40000 Hz.*50000"),
    "units": (lambda flat: Frame(flat * 40.0, PAIRS), "40 times"),
    "order": (lambda flat: Frame(flat[np.arange(28)[::-1]], PAIRS), "scatter|another order"),
}


@pytest.mark.parametrize(("frame", "message"), REFUSED.values(), ids=REFUSED)
def test_frames_of_other_sensors_and_measurements_are_refused(pipeline, frame, message):
    flat = pipeline.layout.reference + 0j
    pipeline.reset()
    with pytest.raises(FrameError, match=message):
        pipeline.process(frame(flat))
    assert pipeline.process(Frame(flat, PAIRS, frequency=40.1e3)).state is State.IDLE


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ((-20.0, 0.0, 15.0, 20.0, 50.0), "at 20 deg contradict"),  # instead of 30 degrees
        ((20.0, 0.0, 15.0, 30.0, 50.0), "at 20 deg contradict"),
        (np.radians(ANGLES), "radians"),
        (ANGLES, ""),
    ],
)
def test_known_angles_that_contradict_each_other_are_named(session, labels, message):
    frames = [session.frame(Scene(Bend(angle))) for angle in ANGLES]
    with pytest.raises(DataError, match=message) if message else nullcontext():
        assert session.pipeline.calibrate(frames, labels).residual_deg < 1.0


@pytest.mark.parametrize(
    ("flip", "force", "message"),
    [(False, 8.0, ""), (True, 8.0, "found elsewhere"), (False, 816.0, "newtons")],
)
def test_known_touches_of_other_axes_or_units_are_refused(session, flip, force, message):
    frames, labels = [session.frame(Scene())], [FrameLabel()]
    for x, y in ((0.030, 0.015), (0.120, 0.045), (0.050, 0.042)):
        frames += [session.frame(Scene()), session.frame(Scene(touches=(Touch(x, y, 8.0),)))]
        known = TouchLabel(0.150 - x if flip else x, y, force)
        labels += [FrameLabel(), FrameLabel(touches=(known,))]
    with pytest.raises(DataError, match=message) if message else nullcontext():
        assert session.pipeline.adapt(frames, labels).touches == 3


def test_four_touches_that_look_like_a_large_bend_leave_the_angle_what_it_was(session):
    """The frames' likeliest bends without touches lie at the end of the range."""
    for angle_deg, places in (
        (18.0, [(27, 49), (81, 48), (132, 50), (38, 12)]),
        (29.7, [(121, 21), (39, 27), (66, 15), (73, 48)]),
        (19.6, [(62, 11), (117, 14), (18, 45), (76, 49)]),
    ):
        session(Scene(Bend(angle_deg)))
        touches = tuple(Touch(x / 1e3, y / 1e3, 10.0) for x, y in places)
        said = session(Scene(Bend(angle_deg), touches))
        assert len(said.touches) == 4, angle_deg
        error = abs(said.bend_angle_deg - angle_deg)
        assert error < min(2.0, 3 * said.bend_deviation_deg), angle_deg


def test_faults_of_electrodes_are_told_and_are_no_touches(session, simulator):
    """Some whose contacts rise a little, by which some clamp bends or touches too; an open one."""
    through = np.array([[e in row for row in simulator.protocol.table] for e in range(8)])
    for rise, changed in (*((3.4, [e]) for e in range(8)), (5.0, [1, 4]), (5.0, [2, 6])):
        flat = session.frame(Scene()).impedance
        said = session(Scene(), impedance=flat + rise * through[changed].sum(axis=0))
        assert said.state is State.IDLE
        assert abs(said.bend_angle_deg) < 2.0
        told = {e for e in range(8) if any(f"electrode {e} " in each for each in said.problems)}
        assert told == set(changed)
        session(Scene())
    scene = Scene(touches=(Touch(0.040, 0.020, 10.0),))
    said = session(scene, status=8 * through[5].astype(np.uint8))
    assert sum("left out" in problem for problem in said.problems) == 7
    assert_touched(said, (0.040, 0.020))


@pytest.mark.parametrize("channel", [9, 18])
def test_a_measurement_that_is_wrong_is_left_out_and_touches_are_found(session, channel):
    """It changes the frame more than the touches do; the frame after is as it was."""
    places = [(0.040, 0.030), (0.110, 0.030)]
    scene = Scene(touches=(Touch(*places[0], 10.0), Touch(*places[1], 9.0)))
    assert_touched(session(scene), *places)
    wrong = session.frame(scene).impedance * np.where(np.arange(28) == channel, 1.02, 1.0)
    said = session(scene, impedance=wrong)
    assert_touched(said, *places)
    assert session.pipeline.layout.protocol.labels[channel] in said.problems[0]
    after = session(scene)
    assert_touched(after, *places)
    assert not after.problems


@pytest.mark.parametrize("gain", [0.998, 1.03, np.exp(0.07j)])
def test_a_step_of_the_boards_gain_or_phase_is_taken_back(session, simulator, gain):
    """Of a flat, a touched and a bent sensor: said once, and no estimate changes."""
    touched = Scene(touches=(Touch(0.060, 0.030, 10.0),))
    rng, factor = np.random.default_rng(1), 1.0
    for scene, state in (
        (Scene(), State.IDLE),
        (touched, State.TOUCH),
        (Scene(Bend(20.0)), State.BEND),
    ):
        said = []
        for step in (1.0, 1.0, gain, 1.0, 1.0):
            factor *= step
            impedance = factor * simulator.measure(scene, Instrument(), rng).impedance
            said.append(session(scene, impedance=impedance))
        assert {each.state for each in said} == {state}
        assert {len(each.touches) for each in said} == {len(scene.touches)}
        assert [bool(each.problems) for each in said] == [False, False, True, False, False]


def test_loud_boards_hide_no_touch_and_faint_touches_are_told_together(simulator):
    """Three times the noise of training: frames are still, and a touch stays one for long."""
    session, loud = Session(simulator), Instrument(snr_db=65.5)
    session.frame = lambda scene, **changes: replace(
        Session.frame(session, scene, **changes),
        impedance=simulator.measure(scene, loud, session.rng).impedance,
    )
    flat = [session(Scene()) for _ in range(24)][4:]
    assert {each.state for each in flat} == {State.IDLE}
    assert sum(bool(each.problems) for each in flat) <= 2
    said = [session(Scene(touches=(Touch(0.040, 0.030, 9.0),))) for _ in range(24)]
    assert {each.state for each in said[2:]} == {State.TOUCH}
    errors = [np.hypot(each.touches[0].x - 0.040, each.touches[0].y - 0.030) for each in said[8:]]
    assert np.sqrt(np.mean(np.square(errors))) < 5e-3
    assert {session(Scene()).state for _ in range(3)} == {State.IDLE}
    # Too faint for one frame; the references take in none of it.
    session, loud = Session(simulator), Instrument(snr_db=66.0)
    session.frame = lambda scene, **changes: replace(
        Session.frame(session, scene, **changes),
        impedance=simulator.measure(scene, loud, session.rng).impedance,
    )
    for _ in range(16):
        session(Scene())
    faint = Scene(touches=(Touch(0.060, 0.040, 5.5),))
    said = [session(faint) for _ in range(14)]
    assert said[0].state is not State.TOUCH
    assert all(each.state is State.TOUCH or each.problems for each in said[8:])


@pytest.mark.parametrize("apart", [0.024, 0.030])
def test_two_uneven_touches_are_found_or_covered_by_what_is_claimed(session, apart):
    for x, y in ((0.050, 0.030), (0.085, 0.035)):
        pair = Touch(x, y, 8.0), Touch(x + apart, y, 4.9)
        for _ in range(4):
            said = session(Scene(touches=pair))
        for touch in () if said.problems else pair:
            claims = [(each, max(5e-3, 3.0 * each.deviation)) for each in said.touches]
            assert any(np.hypot(e.x - touch.x, e.y - touch.y) < most for e, most in claims)
        for _ in range(4):
            session(Scene())


@pytest.mark.parametrize("free", [0, 1])
def test_taps_of_one_frame_each_are_found(session, free):
    """The changes by touches are not taken for noise of the board."""
    rng, bend = np.random.default_rng(5), Bend(15.0)
    session(Scene(bend))
    for x, y, force in rng.uniform((0.02, 0.012, 6.0), (0.13, 0.048, 12.0), (6, 3)):
        assert_touched(session(Scene(bend, (Touch(x, y, force),))), (x, y))
        for _ in range(free):
            assert session(Scene(bend)).state is not State.TOUCH


@pytest.mark.parametrize(("faces", "noise"), [("both", 3e-4), ("bottom", 1e-4)])
def test_a_held_touch_is_not_lost_while_the_sensor_bends(faces, noise):
    """A bend hides the touch in every frame by itself; one of the clamps is not the usual."""
    simulator = Simulator(DESIGN, "coarse", fixture=Clamp(faces=faces))
    session, rng = Session(simulator), np.random.default_rng(3)
    scenes = [Scene()] * 4 + [
        Scene(Bend(float(angle)), (Touch(0.05, 0.02, 8.0),)) for angle in range(0, 41, 2)
    ]
    for scene in scenes:
        V = simulator.measure(scene).impedance
        said = session(scene, impedance=V * (1.0 + noise * rng.standard_normal(V.shape)))
        if scene.touches:
            (found,) = said.touches
            apart = np.hypot(found.x - 0.05, found.y - 0.02)
            assert apart < max(0.01, 3.0 * found.deviation)
            error = abs(said.bend_angle_deg - scene.bend.angle_deg)
            assert error < max(2.0, 3.0 * said.bend_deviation_deg)


def test_it_tells_angles_of_another_clamp_and_how_surely():
    """A sensor held below: the default clamp's bend curves are sure of angles that are wrong."""
    session = Session(Simulator(DESIGN, "coarse", fixture=Clamp(faces="bottom")))
    angles = np.array([-15.0, 10.0, 20.0, 30.0, 40.0])
    known = session.pipeline.method
    ratios = []
    narrow = replace(known, bend_prior=known.usual, usual=None, other_usual=None, angles=None)
    for method in (known, narrow):
        session.pipeline.method = method
        session.pipeline.reset()
        session(Scene())
        said = [session(Scene(Bend(angle))) for angle in angles]
        error = np.array([each.bend_angle_deg for each in said]) - angles
        deviation = np.array([each.bend_deviation_deg for each in said])
        ratios.append(np.sqrt(np.mean((error / deviation) ** 2)))
        assert method is not known or all(each.state is State.BEND for each in said)
    assert ratios[0] < min(1.5, 0.5 * ratios[1])


def test_a_sensor_with_contacts_like_no_other_is_adapted_to_and_then_taken_for_its_own():
    """Refused as trained; five angles make the pipeline its own, sessions included."""
    factors = np.exp([-1.0, 1.8, -1.0, -1.0, -1.0, 1.8, -1.0, 1.8])
    electrodes = tuple(
        replace(each, contact_impedance=factor * each.contact_impedance)
        for each, factor in zip(DESIGN.electrodes, factors, strict=True)
    )
    session = Session(Simulator(replace(DESIGN, electrodes=electrodes), "fast"), seed=1)
    with pytest.raises(FrameError, match="scatter by"):
        session(Scene())
    angles = (0.0, -20.0, 15.0, 30.0, 42.5, 50.0)
    session.pipeline.calibrate([session.frame(Scene(Bend(angle))) for angle in angles], angles)
    session(Scene())
    for angle in (30.0, -15.0, 10.0):
        said = session(Scene(Bend(angle)))
        assert abs(said.bend_angle_deg - angle) < min(2.0, 3.0 * said.bend_deviation_deg)
