"""Temperature, drying and loading history of a gel, against closed forms."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import SensorDesign
from eitskin.hardware import Script, Step
from eitskin.simulator import ForwardModel, Instrument, Protocol, Scene, Simulator, Touch, age_gel
from eitskin.simulator.instrument.gel import DAY, WARMING_TIME
from eitskin.simulator.mechanics.touch_history import held_touches, recall_touches
from eitskin.simulator.mechanics.viscoelasticity import REFERENCE, Prony, elastic_force

PROTOCOL = Protocol.pairwise(8)


def factors(times, **terms):
    """Factors on all impedances in a session without other terms."""
    instrument = dataclasses.replace(Instrument.ideal(), **terms)
    session = instrument.session(PROTOCOL, 1.0, np.random.default_rng(3))
    ones = np.ones((len(times), len(PROTOCOL)), complex)
    values, _ = session.measure(ones, np.array(times), np.random.default_rng(4))
    assert np.ptp(np.abs(values), axis=1) == pytest.approx(0.0, abs=1e-12)
    return values[:, 0].real


def test_a_warm_gel_conducts_two_percent_a_kelvin_better() -> None:
    warm = factors([0.0, WARMING_TIME, 1e6], gel_warming=(5.0, 5.0))
    assert 1.0 / warm == pytest.approx([1.0, 1.0 + 0.1 * (1.0 - np.exp(-1.0)), 1.1], rel=1e-9)


def test_a_dry_gel_conducts_as_mackie_and_meares_say() -> None:
    """Half of the water: 55 % of the thickness, polymer from 10 to 18.2 %."""
    f = 0.1 / 0.55
    expected = ((1 - f) / (1 + f)) ** 2 / (0.9 / 1.1) ** 2
    dry = factors([0.0, DAY], gel_drying=(0.5, 0.5))
    assert 1.0 / dry == pytest.approx([1.0, expected], rel=1e-9)


def test_a_session_changes_as_the_aged_sensor_does() -> None:
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


def test_cycles_on_one_place_approach_their_geometric_sum() -> None:
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


def test_a_touch_that_follows_others_on_its_place_is_deeper() -> None:
    """In a script that relaxes; elsewhere the earlier touch fades on its own."""
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
