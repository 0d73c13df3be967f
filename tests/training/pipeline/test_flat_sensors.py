"""Distribution of flat sensors: false alarms, bends told, few specimens, saved arrays."""

from functools import lru_cache

import numpy as np
import pytest

from eitskin.training.pipeline.flat_sensors import FALSE_ALARM, FEWEST_SPECIMENS, FlatSensors

RNG = np.random.default_rng(3)
C = 10
MIXING = RNG.normal(size=(3, C)) * 0.02
MIDDLE = np.log(np.linspace(400.0, 800.0, C))
BEND = np.array([RNG.normal(size=C) * 0.03, RNG.normal(size=C) * 0.004])
ANGLES = np.linspace(-20.0, 50.0, 15)


def change(angle_deg):
    t = np.asarray(angle_deg)[..., None] / 45.0
    return t * BEND[0] + t**2 * BEND[1]


def sensors(count, angle_deg=0.0, seed=0):
    """Sensors of any conductivity, which differ in three directions and by a board's paths."""
    rng = np.random.default_rng(seed)
    logs = MIDDLE + rng.normal(size=(count, 3)) @ MIXING + change(angle_deg)
    logs = logs + 0.004 * rng.normal(size=(count, C)) + 0.3 * rng.normal(size=(count, 1))
    return np.exp(logs - 0.01j)


@lru_cache
def known(count=200):
    return FlatSensors.fit(sensors(count), ANGLES, change(ANGLES))


def doubted(judge, values):
    return np.mean([bool(judge.judge(each).doubt) for each in values])


@pytest.mark.parametrize("count", [FEWEST_SPECIMENS, 20, 200])
def test_flat_sensors_are_seldom_doubted(count):
    assert doubted(known(count), sensors(400, seed=1)) <= 10 * FALSE_ALARM


def test_chances_of_flat_sensors_are_about_uniform():
    chances = [known().judge(each).chance for each in sensors(400, seed=2)]
    assert np.quantile(chances, [0.1, 0.5, 0.9]) == pytest.approx([0.1, 0.5, 0.9], abs=0.2)


def test_bent_sensors_are_told_with_their_angle():
    starts = [known().judge(each) for each in sensors(200, 40.0, seed=4)]
    assert np.mean([bool(start.doubt) for start in starts]) > 0.9
    errors = np.array([(start.bend_deg - 40.0) / start.deviation_deg for start in starts])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.25)
    assert "a bend of" in starts[0].doubt


def test_other_sensors_are_told():
    other = sensors(1, seed=5)[0] * np.exp(0.1 * (np.arange(C) == 4))
    start = known().judge(other)
    assert start.chance < FALSE_ALARM
    assert "does not look flat" in start.doubt


def test_bad_channels_are_left_out():
    bent = sensors(1, 50.0, seed=6)[0]
    whole = known().judge(bent)
    bent[3] = np.nan
    assert known().judge(bent).bend_deg == pytest.approx(whole.bend_deg, abs=10.0)
    assert known().judge(np.full(C, np.nan)).doubt == ""


def test_without_bends_no_angle_is_told():
    start = FlatSensors.fit(sensors(50)).judge(sensors(1, 50.0, seed=7)[0])
    assert np.isnan(start.bend_deg)
    assert start.bend_chance == 1.0


def test_too_few_or_equal_specimens_give_no_distribution():
    assert FlatSensors.fit(sensors(FEWEST_SPECIMENS - 1)) is None
    assert FlatSensors.fit(np.repeat(sensors(1), 20, axis=0)) is None


def test_arrays_restore_the_distribution():
    fitted = known()
    again = FlatSensors.from_arrays(fitted.arrays())
    value = sensors(1, 20.0, seed=8)[0]
    assert again.judge(value).chance == pytest.approx(fitted.judge(value).chance, rel=1e-4)
    assert again.judge(value).bend_deg == fitted.judge(value).bend_deg


def test_own_values_of_a_known_sensor_are_not_doubted_and_its_bends_are():
    strange = sensors(1, seed=5)[0] * np.exp(0.1 * (np.arange(C) == 4))
    own = known().of_sensor(np.abs(strange))
    later = 1.3 * strange * np.exp(0.004 * np.random.default_rng(9).normal(size=(100, C)))
    assert doubted(known(), later) == 1.0
    assert doubted(own, later) <= 10 * FALSE_ALARM
    bent = [own.judge(each) for each in later * np.exp(change(40.0))]
    assert np.mean([bool(start.doubt) for start in bent]) > 0.9
    assert np.median([start.bend_deg for start in bent]) == pytest.approx(40.0, abs=5.0)
    partly = np.where(np.arange(C) == 2, np.nan, np.abs(strange))
    assert not known().of_sensor(partly).judge(strange).doubt
