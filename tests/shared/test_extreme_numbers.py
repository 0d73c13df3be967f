"""Numbers at the ends of what a float holds: finite results, or one error of eitskin."""

import dataclasses

import numpy as np
import pytest

from eitskin.bounds import require_positive, sample_uniform
from eitskin.datasets import touch_maps
from eitskin.errors import ConfigurationError, EitskinError
from eitskin.geometry import Hinge, Rectangle, SensorDesign
from eitskin.hardware.diagnosis.reading_check import check_readings
from eitskin.hardware.diagnosis.sensor_check import check_sensor
from eitskin.simulator import ForwardModel, Frame, Mechanics, Protocol
from eitskin.training import (
    PixelGrid,
    Regularisation,
    StoredReference,
    TwinPrior,
    Zero,
    figures_of_merit,
)
from eitskin.training.method.input_spec import usable_values

PROTOCOL = Protocol.pairwise(8)
FLAT = np.linspace(400.0, 820.0, 28)
EXTREMES = (1e300, -1e308, 1e-300, 5e-324, 0.0, float("nan"), float("inf"))


def frames(value):
    """Sixteen frames whose channels are in turn as they should be, and extreme."""
    odd = np.arange(28) % 2 == 1
    return [
        Frame(np.where(odd ^ bool(number % 2), value, FLAT + 0j), PROTOCOL, 0.1 * number)
        for number in range(16)
    ]


def test_conductivities_that_lose_all_digits_are_refused():
    for value in (5e-324, 1e-310, 1e308, -1.0, float("nan")):
        with pytest.raises(ConfigurationError, match="S/m"):
            dataclasses.replace(SensorDesign.reference(), conductivity=value)
    for value in (1e-15, 1e15):
        require_positive("conductivity", value, "S/m")


def test_readings_that_alternate_with_nonsense_are_checked_without_noise(recwarn):
    for value in EXTREMES:
        assert check_sensor(frames(value), FLAT).findings
        check_readings(np.array([frame.impedance for frame in frames(value)]), PROTOCOL)
    assert not recwarn.list


def test_readings_beyond_all_sensors_are_left_out():
    for value in EXTREMES:
        found, problems = usable_values(frames(value)[0])
        assert np.isnan(found).sum() == len(problems) == 14
    values = np.array([FLAT + 0j, FLAT + 0j])
    values[1, 0] = -np.inf
    stored = StoredReference.from_frames(list(values), PROTOCOL, 40e3, Zero.FLAT)
    assert np.isfinite([stored.noise, *stored.impedance[1:]]).all()


def test_arguments_that_no_map_picture_or_prior_can_have_are_refused():
    """Each was accepted, and gave NaN, infinity or an error of NumPy."""
    grid = PixelGrid.from_outline(Rectangle(0.1, 0.06), 100)
    picture = np.ones(len(grid))
    one = np.full((1, 1), 0.03)
    calls = {
        "rows": lambda: touch_maps(one, one, one, shape=(-(2**63), 8)),
        "outline": lambda: touch_maps(one, one, one, outline=(1e300, 0.06)),
        "both coordinates": lambda: touch_maps(one, np.nan * one, one),
        "a centre": lambda: figures_of_merit(picture, grid, (float("nan"), 0.0), 1e-4),
        "a picture": lambda: figures_of_merit(1.7e308 * picture, grid, (0.0, 0.0), 1e-4),
        "integral": lambda: figures_of_merit(picture, grid, (0.0, 0.0), 5e-324),
        "prior": lambda: TwinPrior(conductivity=1.7e308),
        "margin": lambda: Mechanics(margin=1e300),
        "discs need": lambda: grid.discs([[float("nan"), 0.03]], 0.01),
        "lines of a mesh": lambda: ForwardModel(SensorDesign.reference(), "coarse", (1e-12,)),
        "every channel is bad": lambda: StoredReference.from_frames(
            [np.full(28, 1e300)], PROTOCOL, 40e3, Zero.FLAT
        ),
        "hinge offset": lambda: Hinge(offset=1.7e308),
        "n_electrodes": lambda: Protocol.pairwise(10**12),
        "n_electrodes must": lambda: Protocol.skip(65536, 2),
        "number from": lambda: Regularisation("lambda", 1.7e308),
        "expected": lambda: check_sensor(frames(FLAT), FLAT * 1e300),
        "1e-15": lambda: ForwardModel(SensorDesign.reference(), "coarse").impedance(5e-324),
    }
    for words, call in calls.items():
        with pytest.raises(EitskinError, match=words):
            call()


def test_a_range_may_end_at_minus_zero():
    rng = np.random.default_rng(0)
    assert sample_uniform(rng, (0.0, -0.0)) == 0.0
