"""Arguments of any library, extreme numbers, and threads."""

import dataclasses
import os
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from eitskin import Touch, generate
from eitskin.bounds import require_positive, sample_uniform
from eitskin.datasets import Dataset, open_dataset, touch_maps
from eitskin.errors import ConfigurationError, EitskinError
from eitskin.geometry import Bend, Disc, Hinge, Polygon, Rectangle, SensorDesign
from eitskin.hardware.diagnosis.reading_check import check_readings
from eitskin.hardware.diagnosis.sensor_check import check_sensor
from eitskin.simulator import ForwardModel, Frame, Mechanics, Protocol
from eitskin.threads import one_thread, one_thread_per_process
from eitskin.training import (
    PixelGrid,
    Regularisation,
    StoredReference,
    TrainingSettings,
    TwinPrior,
    Zero,
    figures_of_merit,
)
from eitskin.training.method.input_spec import usable_values

from on_demand import OnDemand

pandas, torch = OnDemand("pandas"), OnDemand("torch")
PAIRS = Protocol.pairwise(8)
VALUES = np.full(28, 600.0)
MASKED = np.ma.masked_equal(np.arange(28), 3)


@pytest.mark.parametrize("number", [np.float32(0.5), np.array(0.5), Decimal("0.5"), Fraction(1, 2)])
def test_a_number_of_any_library_is_a_number(number):
    assert Disc(number) == Disc(0.5)
    assert type(Disc(number).radius) is float


@pytest.mark.parametrize(
    "made",
    [VALUES.tolist, lambda: pandas.Series(VALUES), lambda: np.ma.ones(28), lambda: range(28)],
)
def test_arrays_of_any_library_are_arrays(made):
    assert Frame(made(), PAIRS).impedance.shape == (28,)


@pytest.mark.slow
def test_values_of_torch_are_taken_and_those_with_gradients_refused():
    assert Disc(torch.tensor(0.5)) == Disc(0.5)
    assert Frame(torch.ones(28), PAIRS).impedance.shape == (28,)
    with pytest.raises(ConfigurationError, match="impedance: expected an array"):
        Frame(torch.ones(28, requires_grad=True), PAIRS)


REFUSED = {
    "Touch: x: .* a float can hold": lambda: Touch(10**400, 0.02),
    "Touch: y: expected a real number, got 1j": lambda: Touch(0.02, 1j),
    "Disc: radius: expected a real number, got '1'": lambda: Disc("1"),
    "Bend: angle_deg: expected a real number": lambda: Bend(True),
    "Touch: indenter: expected a Cylinder or a Sphere": lambda: Touch(0.05, 0.02, indenter=3),
    "protocol: expected a Protocol": lambda: Frame(VALUES, "pairwise:8"),
    "impedance: expected no masked": lambda: Frame(MASKED, PAIRS),
    "status: expected an array of whole": lambda: Frame(VALUES, PAIRS, status=VALUES * np.nan),
    "time: expected a real number": lambda: Frame(VALUES, PAIRS, time="now"),
    "n_electrodes: expected a whole number": lambda: Protocol.pairwise(8.5),
    "n_electrodes: .* 64 bits": lambda: Protocol.pairwise(10**30),
    "zero: expected 'first frames' or": lambda: StoredReference(
        VALUES, PAIRS, 4e4, 7, 1, None, "now"
    ),
    "resolution: expected 'coarse' or": lambda: ForwardModel(SensorDesign.reference(), "finer"),
    "path: .* 255 bytes": lambda: open_dataset(300 * "a"),
    "path: .* without NUL": lambda: open_dataset("a\0b"),
    "recipe: expected a Recipe": lambda: generate("quick", "set"),
    "from_arrays: impedance: expected an": lambda: Dataset.from_arrays(["a"], [[1.0]]),
    "seed must be from 0": lambda: TrainingSettings(seed=-5),
    "points: expected the shape": lambda: Disc(0.03).contains([1.0, 2.0, 3.0]),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_a_type_cannot_hold_is_refused_by_name(words):
    with pytest.raises(ConfigurationError, match=words):
        REFUSED[words]()


def test_sequences_and_stand_ins_of_the_caller_are_taken():
    corners = [[0, 0], np.array([0.1, 0]), (0.1, 0.1)]
    assert hash(Polygon(corners)) == hash(Polygon(((0, 0), (0.1, 0), (0.1, 0.1))))

    class Double:
        """A protocol of somebody else's."""

        def __len__(self):
            return 2

    assert Frame([1.0, 2.0], Double()).impedance.size == 2


# Threads


def test_linear_algebra_has_one_thread_and_the_environment_is_as_before(monkeypatch):
    def threads() -> set[int]:
        found = threadpool_info()
        return {each["num_threads"] for each in found if each["user_api"] == "blas"}

    np.ones((2, 2)) @ np.ones((2, 2))
    with threadpool_limits(2):
        before = threads()
        with one_thread():
            assert threads() == {1}
        assert one_thread()(threads)() == {1}
        assert threads() == before
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with one_thread_per_process():
        assert os.environ["OMP_NUM_THREADS"] == os.environ["OPENBLAS_NUM_THREADS"] == "1"
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


# Extreme numbers


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


def test_readings_beyond_all_sensors_and_alternating_nonsense_are_left_out(recwarn):
    for value in EXTREMES:
        assert check_sensor(frames(value), FLAT).findings
        check_readings(np.array([frame.impedance for frame in frames(value)]), PROTOCOL)
    assert not recwarn.list
    for value in EXTREMES:
        found, problems = usable_values(frames(value)[0])
        assert np.isnan(found).sum() == len(problems) == 14
    values = np.array([FLAT + 0j, FLAT + 0j])
    values[1, 0] = -np.inf
    stored = StoredReference.from_frames(list(values), PROTOCOL, 40e3, Zero.FLAT)
    assert np.isfinite([stored.noise, *stored.impedance[1:]]).all()


def test_arguments_beyond_what_can_be_are_refused_and_a_range_may_end_at_minus_zero():
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
    rng = np.random.default_rng(0)
    assert sample_uniform(rng, (0.0, -0.0)) == 0.0
    for value in (5e-324, 1e-310, 1e308, -1.0, float("nan")):
        with pytest.raises(ConfigurationError, match="S/m"):
            dataclasses.replace(SensorDesign.reference(), conductivity=value)
    for value in (1e-15, 1e15):
        require_positive("conductivity", value, "S/m")
