"""The pipelines that come with eitskin, on frames of the simulator."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from eitskin.datasets import State
from eitskin.errors import FrameError
from eitskin.geometry import Bend, Clamp, SensorDesign
from eitskin.simulator import Frame, Instrument, Scene, Simulator, Touch
from eitskin.training import Pipeline


@pytest.fixture(scope="module")
def simulator():
    return Simulator(SensorDesign.reference(), "fast")


@pytest.fixture
def session(simulator):
    """Processes scenes one after the other, as a board with white noise would give them."""
    pipeline, rng, count = Pipeline.load("reference.eitmodel"), np.random.default_rng(0), [0]

    def process(scene, **changes):
        frame = simulator.measure(scene, Instrument(), rng)
        number = count[0]
        count[0] += 1
        values = {"time": 0.3 * number, "number": number, **changes}
        impedance = values.pop("impedance", frame.impedance)
        return pipeline.process(Frame(impedance, frame.protocol, **values))

    for _ in range(4):
        assert process(Scene()).state is State.IDLE
    return process


def test_it_says_where_a_bent_sensor_is_touched(session):
    bend = Bend(30.0)
    for _ in range(3):
        bent = session(Scene(bend))
    assert bent.state is State.BEND
    assert abs(bent.bend_angle_deg - 30.0) < 3 * bent.bend_deviation_deg
    touches = (Touch(0.040, 0.020, 10.0), Touch(0.110, 0.040, 8.0))
    said = session(Scene(bend, touches))
    assert said.state is State.TOUCH
    places = sorted([touch.x, touch.y] for touch in said.touches)
    assert (
        np.linalg.norm(np.subtract(places, [(0.040, 0.020), (0.110, 0.040)]), axis=1).max() < 5e-3
    )
    assert said.touch_map.shape == (32, 80)
    assert said.problems == ()
    assert session(Scene(bend)).state is State.BEND


@pytest.mark.slow
def test_four_touches_that_look_like_a_large_bend_leave_the_angle_what_it_was(session):
    """The frames' likeliest bends without touches lie at the end of the range."""
    for angle_deg, places in (
        (18.0, [(27, 49), (81, 48), (132, 50), (38, 12)]),
        (29.7, [(121, 21), (39, 27), (66, 15), (73, 48)]),
        (19.6, [(62, 11), (117, 14), (18, 45), (76, 49)]),
    ):
        bend = Bend(angle_deg)
        session(Scene(bend))
        said = session(Scene(bend, tuple(Touch(x / 1e3, y / 1e3, 10.0) for x, y in places)))
        assert len(said.touches) == 4, angle_deg
        error = abs(said.bend_angle_deg - angle_deg)
        assert error < min(2.0, 3 * said.bend_deviation_deg), angle_deg


def test_a_held_touch_becomes_surer(session):
    scene = Scene(touches=(Touch(0.060, 0.030, 10.0),))
    first, *_, last = (session(scene) for _ in range(6))
    assert last.touches[0].deviation < 0.7 * first.touches[0].deviation
    assert (
        np.hypot(last.touches[0].x - 0.060, last.touches[0].y - 0.030)
        < 3 * last.touches[0].deviation
    )


def test_it_finds_a_touch_that_comes_while_the_sensor_moves(session):
    session(Scene(Bend(10.0)))
    said = session(Scene(Bend(14.0), (Touch(0.030, 0.030, 10.0),)))
    assert said.state is State.TOUCH
    assert np.hypot(said.touches[0].x - 0.030, said.touches[0].y - 0.030) < 5e-3


def test_an_open_electrode_is_told_and_touches_are_still_found(session, simulator):
    scene = Scene(touches=(Touch(0.040, 0.020, 10.0),))
    impedance = simulator.measure(scene, Instrument(), np.random.default_rng(1)).impedance
    status = np.array([8 * (5 in row) for row in simulator.protocol.table], np.uint8)
    said = session(scene, impedance=impedance, status=status)
    assert sum("left out" in problem for problem in said.problems) == 7
    assert said.state is State.TOUCH
    assert np.hypot(said.touches[0].x - 0.040, said.touches[0].y - 0.020) < 5e-3


def test_a_contact_that_changes_is_no_touch(session, simulator):
    impedance = simulator.measure(Scene(), Instrument(), np.random.default_rng(1)).impedance
    through = np.array([2 in row for row in simulator.protocol.table])
    said = session(Scene(), impedance=impedance + 5.0 * through)
    assert said.state is not State.TOUCH
    assert any("electrode 2" in problem for problem in said.problems)


@pytest.mark.slow
def test_it_runs_without_torch():
    """Which takes seconds to load: a live session would lose its first frames."""
    code = (
        "import sys\n"
        "from eitskin.simulator import Frame\n"
        "from eitskin.training import Pipeline\n"
        "pipeline = Pipeline.load('reference.eitmodel')\n"
        "layout = pipeline.layout\n"
        "frame = Frame(layout.reference, layout.protocol, frequency=layout.frequency)\n"
        "print(pipeline.process(frame).state.name, 'torch' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["IDLE", "False"]


@pytest.mark.slow
def test_it_tells_angles_of_another_clamp_and_how_surely():
    """A sensor held below: the default clamp's bend curves are sure of angles that are wrong."""
    held_below = Simulator(SensorDesign.reference(), "coarse", fixture=Clamp(faces="bottom"))
    angles = np.array([-15.0, 10.0, 20.0, 30.0, 40.0])
    pipeline, rng = Pipeline.load("reference.eitmodel"), np.random.default_rng(0)
    known = pipeline.method
    sure = replace(known, bend_prior=known.usual, usual=None, angles=None)
    ratio = []
    for method in (known, sure):
        pipeline.method = method
        pipeline.use(None)
        frames = [
            held_below.measure(scene, Instrument(), rng)
            for scene in (Scene(), *(Scene(Bend(angle)) for angle in angles))
        ]
        said = [
            pipeline.process(replace(frame, time=float(number), number=number))
            for number, frame in enumerate(frames)
        ]
        error = np.array([each.bend_angle_deg for each in said[1:]]) - angles
        deviation = np.array([each.bend_deviation_deg for each in said[1:]])
        ratio.append(np.sqrt(np.mean((error / deviation) ** 2)))
        assert method is sure or all(each.state is State.BEND for each in said[1:])
    assert ratio[0] < 1.5
    assert ratio[0] < 0.5 * ratio[1]


def test_a_stored_reference_tells_a_sensor_that_starts_bent_and_touched(simulator):
    """By the bend curves of the usual clamp: where any is possible, some bend explains a touch."""
    pipeline, rng = Pipeline.load("reference.eitmodel"), np.random.default_rng(0)

    def measured(scene, number):
        frame = simulator.measure(scene, Instrument(), rng)
        return replace(frame, time=0.3 * number, number=number)

    pipeline.use(pipeline.tare([measured(Scene(), number) for number in range(8)]))
    touched = Scene(Bend(30.0), (Touch(0.050, 0.020, 10.0),))
    said = [pipeline.process(measured(touched, number)) for number in range(8, 11)][-1]
    assert said.state is State.TOUCH
    assert abs(said.bend_angle_deg - 30.0) < 3.0 * said.bend_deviation_deg
    assert np.hypot(said.touches[0].x - 0.050, said.touches[0].y - 0.020) < 5e-3


def test_a_sensor_with_contacts_like_no_other_is_adapted_to_and_then_taken_for_its_own():
    """Refused as trained; five angles make the pipeline its own, sessions included."""
    design = SensorDesign.reference()
    factors = np.exp([-1.0, 1.8, -1.0, -1.0, -1.0, 1.8, -1.0, 1.8])
    electrodes = tuple(
        replace(each, contact_impedance=factor * each.contact_impedance)
        for each, factor in zip(design.electrodes, factors, strict=True)
    )
    simulator = Simulator(replace(design, electrodes=electrodes), "fast")
    rng = np.random.default_rng(1)

    def frame(angle_deg, number):
        measured = simulator.measure(Scene(Bend(angle_deg)), Instrument(), rng)
        return replace(measured, time=0.3 * number, number=number)

    pipeline = Pipeline.load("reference.eitmodel")
    with pytest.raises(FrameError, match="scatter by"):
        pipeline.process(frame(0.0, 0))
    angles = (0.0, -20.0, 15.0, 30.0, 42.5, 50.0)
    frames = [frame(angle, number) for number, angle in enumerate(angles)]
    pipeline.calibrate(frames, angles)
    pipeline.process(frame(0.0, 0))
    for number, angle in enumerate((30.0, -15.0, 10.0), 1):
        said = pipeline.process(frame(angle, number))
        assert abs(said.bend_angle_deg - angle) < min(1.5, 3.0 * said.bend_deviation_deg)
