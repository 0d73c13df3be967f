"""Skin in MuJoCo: weights at known places as touches, and frames that are due as frames."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import Cylinder, Scene, Simulator, Sphere
from eitskin.simulator.robots.mujoco_skin import MujocoSkin, TouchRules, TouchTable

from on_demand import OnDemand

mujoco = OnDemand("mujoco")

SCRIPT = Path(__file__).parents[3] / "docs" / "how-to" / "mujoco" / "press.py"
SKIN = '<geom name="skin" type="box" size=".075 .03 .006" mass="1"/>'
WEIGHT, DISC = 9.81, Disc(0.04)  # N of one kilogram


@pytest.fixture(scope="module")
def simulator():
    return Simulator(SensorDesign.reference(), "coarse")


def loaded(bodies, skin=SKIN, pose="", time=1.5):
    """Model of a skin with bodies on it, and its state after they have come to rest."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="0.002"/><worldbody><body name="pad" {pose}>{skin}</body>'
        f'<geom name="floor" type="plane" size="1 1 1" pos="0 0 -.3"/>{bodies}</worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    while data.time < time:
        mujoco.mj_step(model, data)
    return model, data


def weight(geom, x, y, z, mass):
    """Free body that only slides along z, with one geom, over a place of the pad [m]."""
    return (
        f'<body pos="{x} {y} {z}"><joint type="slide" axis="0 0 1" damping="20"/>'
        f'<geom {geom} mass="{mass}"/></body>'
    )


@pytest.mark.slow
def test_balls_press_the_upper_face_alone_by_their_weight_however_it_stands(simulator):
    """A skin tilted by 20 degrees about x and turned about z feels the part along its normal."""
    model, data = loaded(weight('type="sphere" size=".0075"', 0.02, -0.01, 0.014, 0.5))
    skin = MujocoSkin(simulator, model, "skin")
    (touch,) = skin.touches(data)
    assert touch.force == pytest.approx(0.5 * WEIGHT, rel=1e-3)
    assert (touch.x, touch.y) == (pytest.approx(0.095, abs=1e-5), pytest.approx(0.02, abs=1e-5))
    assert touch.indenter == Cylinder()
    box, boxed = loaded(weight('type="box" size=".010 .009 .01"', -0.03, 0.005, 0.017, 0.4))
    assert boxed.ncon == 4  # its corners are one touch in its middle
    (touch,) = MujocoSkin(simulator, box, "skin").touches(boxed)
    assert touch.force == pytest.approx(0.4 * WEIGHT, rel=1e-3)
    assert (touch.x, touch.y) == (pytest.approx(0.045, abs=1e-4), pytest.approx(0.035, abs=1e-4))
    own = MujocoSkin(simulator, model, "skin", rules=TouchRules(indenter=None))
    assert own.touches(data)[0].indenter == Sphere(0.0075)
    tilt = np.radians(20.0)
    pose = 'pos=".1 .2 .3" euler="20 0 0"'
    ball = (
        '<body pos=".1 .2 .3" euler="20 0 0"><body pos=".02 .01 .0135">'
        '<joint type="slide" axis="0 0 1" damping="20"/><geom type="sphere" size=".0075" mass=".3" '
        'friction="0 0 0"/></body></body>'
    )
    model, data = loaded(ball, pose=pose)
    (touch,) = MujocoSkin(simulator, model, "skin").touches(data)
    assert touch.force == pytest.approx(0.3 * WEIGHT * np.cos(tilt), rel=1e-3)
    assert (touch.x, touch.y) == (pytest.approx(0.095, abs=1e-4), pytest.approx(0.04, abs=1e-4))
    # The skin lies on a table and a ball leans on its side: neither is a touch.
    table = '<geom type="box" size=".2 .2 .01" pos="0 0 -.016"/>'
    beside = (
        '<body pos=".0822 0 0"><joint type="slide" axis="1 0 0"/>'
        '<geom type="sphere" size=".0075" mass=".1"/></body>'
    )
    model, data = loaded(table + beside, SKIN + '<joint type="slide" axis="0 0 1"/>', time=0.2)
    assert (data.contact.geom == model.geom("skin").id).any(axis=1).sum() > 1
    assert not MujocoSkin(simulator, model, "skin").touches(data)


def frames_of(skin, model, simulations, steps):
    """Frames by simulation, of so many steps."""
    found = [[] for _ in simulations]
    for _ in range(steps):
        for data in simulations:
            mujoco.mj_step(model, data)
        for into, frame in zip(found, skin.update(simulations), strict=True):
            if frame is not None:
                into.append(frame)
    return found


@pytest.mark.slow
def test_frames_come_at_their_rate_and_are_those_of_the_simulator(simulator) -> None:
    """Two simulations at once: their frames are what `measure` gives of the touches."""
    ball = weight('type="sphere" size=".0075"', 0.02, -0.01, 0.1, 0.8)
    model, resting = loaded(ball)
    falling = mujoco.MjData(model)
    skin = MujocoSkin(simulator, model, "skin", period=0.05)
    first, second = frames_of(skin, model, [falling, resting], 126)
    assert [frame.number for frame in first] == list(range(6))
    assert [frame.time for frame in second] == pytest.approx(0.05 * np.arange(6))
    flat = simulator.measure_all([Scene()])[0]
    assert np.array_equal(first[0].impedance, flat)
    mujoco.mj_resetData(model, falling)
    again, _ = skin.update([falling, resting])
    assert (again.session, again.number, again.time) == (1, 0, 0.0)
    lying = Scene(touches=skin.touches(resting))
    assert len(lying.touches) == 1
    change = simulator.measure_all([lying], tolerance=0.0)[0] - flat
    found = second[-1].impedance - flat
    assert np.abs(found - change).max() < 1e-3 * np.abs(change).max()


def test_a_table_gives_frames_of_one_touch_and_the_simulator_those_of_more(
    simulator, monkeypatch
) -> None:
    two = weight('type="sphere" size=".0075"', -0.03, 0.0, 0.014, 0.5)
    model, data = loaded(weight('type="sphere" size=".0075"', 0.03, 0.0, 0.014, 0.5) + two)
    _, alone = loaded(weight('type="sphere" size=".0075"', 0.03, 0.0, 0.014, 0.5))
    bare = mujoco.MjData(model)

    class Table:
        def factors(self, touches):
            return np.array([np.full(28, 1.0 + 0.01 * touch.force) for touch in touches])

    monkeypatch.setattr(TouchTable, "load_or_solve", lambda *_: Table())
    skin = MujocoSkin(simulator, model, "skin", touch_table=True)
    ((touch,), pair) = skin.touches(alone), skin.touches(data)
    found = [frame.impedance for frame in skin.update([alone, data, bare])]
    flat, both = simulator.measure_all([Scene(), Scene(touches=pair)])
    assert len(pair) == 2
    np.testing.assert_allclose(found, [flat * (1.0 + 0.01 * touch.force), both, flat], rtol=1e-12)
    rules = TouchRules(indenter=None)
    with pytest.raises(ConfigurationError, match="leave out touch_table"):
        MujocoSkin(simulator, model, "skin", rules=rules, touch_table=True)


def test_wrong_geoms_sizes_and_sensors_are_refused(simulator) -> None:
    model, _ = loaded("", time=0.0)
    twice, _ = loaded("", '<geom name="skin" type="box" size=".15 .06 .006"/>', time=0.0)
    round_sensor = Simulator(SensorDesign(DISC, 0.005, uniform(DISC, 8, 0.005)), "coarse")
    for given, message in (
        ((simulator, model, "pad"), "the model has floor, skin"),
        ((simulator, model, "floor"), "is none"),
        ((simulator, twice, "skin"), "half of that"),
        ((round_sensor, model, "skin"), "disc"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            MujocoSkin(*given)


@pytest.mark.slow
def test_the_arm_of_the_guide_presses_where_the_pipeline_finds_it() -> None:
    spec = importlib.util.spec_from_file_location("press", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    (error,) = script.main(places=script.PLACES[3:4])
    assert error < 3.0
