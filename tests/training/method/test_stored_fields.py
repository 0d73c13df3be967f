"""Dataclasses that are saved as arrays by the names of their fields."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from eitskin.training.method.stored_fields import (
    GIVEN_FIELD,
    StoredField,
    StoredFields,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Part(StoredFields):
    values: Annotated[Array, StoredField(single=True)]
    size: Annotated[float, StoredField("numbers")]
    ends: Annotated[tuple[int, int], StoredField("numbers")]


@dataclass(frozen=True)
class Whole(StoredFields):
    sensor: Annotated[str, GIVEN_FIELD]
    part: Part
    layers: Annotated[tuple[Array, ...], StoredField("layer")]
    none: Part | None
    names: tuple[int, ...] = (7,)
    half: Array = field(init=False)

    def __post_init__(self):
        object.__setattr__(self, "half", 0.5 * self.part.values)


WHOLE = Whole("disc", Part(np.arange(3.0), 0.5, (2, 4)), (np.eye(2), np.ones(1)), None)


def test_arrays_have_the_names_of_fields_and_restore_them():
    arrays = WHOLE.arrays()
    assert set(arrays) == {"part.values", "part.numbers", "layer0", "layer1", "names"}
    assert arrays["part.values"].dtype == np.float32
    np.testing.assert_array_equal(arrays["part.numbers"], [0.5, 2, 4])
    again = Whole.from_arrays({**arrays, "of_others": np.ones(2)}, sensor="disc")
    assert (again.sensor, again.none, again.names) == ("disc", None, (7,))
    assert (again.part.size, again.part.ends) == (0.5, (2, 4))
    np.testing.assert_array_equal(again.half, WHOLE.half)
    assert [layer.shape for layer in again.layers] == [(2, 2), (1,)]
