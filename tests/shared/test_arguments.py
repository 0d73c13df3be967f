"""Arguments of public names: numbers of any library are taken, what no type holds is refused."""

from decimal import Decimal
from fractions import Fraction

import numpy as np
import pandas
import pytest
import torch

from eitskin import Frame, Protocol, SensorDesign, Touch, generate
from eitskin.datasets import Dataset, open_dataset
from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Disc, Polygon
from eitskin.simulator import ForwardModel
from eitskin.training import StoredReference, TrainingSettings

PAIRS = Protocol.pairwise(8)
VALUES = np.full(28, 600.0)
MASKED = np.ma.masked_equal(np.arange(28), 3)


@pytest.mark.parametrize(
    "number", [np.float32(0.5), np.array(0.5), Decimal("0.5"), Fraction(1, 2), torch.tensor(0.5)]
)
def test_a_number_of_any_library_is_a_number(number):
    assert Disc(number) == Disc(0.5)
    assert type(Disc(number).radius) is float


@pytest.mark.parametrize(
    "values", [VALUES.tolist(), pandas.Series(VALUES), torch.ones(28), np.ma.ones(28), range(28)]
)
def test_arrays_of_any_library_are_arrays(values):
    assert Frame(values, PAIRS).impedance.shape == (28,)


REFUSED = {
    "Touch: x: .* a float can hold": lambda: Touch(10**400, 0.02),
    "Touch: y: expected a real number, got 1j": lambda: Touch(0.02, 1j),
    "Disc: radius: expected a real number, got '1'": lambda: Disc("1"),
    "Bend: angle_deg: expected a real number": lambda: Bend(True),
    "Touch: indenter: expected a Cylinder or a Sphere": lambda: Touch(0.05, 0.02, indenter=3),
    "protocol: expected a Protocol": lambda: Frame(VALUES, "pairwise:8"),
    "impedance: expected no masked": lambda: Frame(MASKED, PAIRS),
    "impedance: expected an array": lambda: Frame(torch.ones(28, requires_grad=True), PAIRS),
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
