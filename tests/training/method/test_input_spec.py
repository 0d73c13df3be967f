"""Sensors that a pipeline takes for its own, by how its training specimens scatter."""

from functools import partial

import numpy as np
import pytest

from eitskin.datasets import Dataset
from eitskin.errors import FrameError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol
from eitskin.training.method.input_spec import MAX_SPREAD, InputSpec

PROTOCOL = Protocol.pairwise(8)
FLAT = np.linspace(400.0, 800.0, 28)


def of_specimens(scatter):
    """Specification for eight specimens whose channels scatter by so much, and the generator."""
    rng = np.random.default_rng(0)
    reference = FLAT * np.exp(scatter * rng.normal(size=(8, 28)))
    data = Dataset.from_arrays(reference, reference, specimen=np.arange(8), state=np.zeros(8))
    return InputSpec.from_dataset(data, SensorDesign.reference(), PROTOCOL), rng


def test_the_limit_is_never_lower_than_of_sensors_that_hardly_scatter_and_is_saved():
    spec, _ = of_specimens(0.01)
    assert spec.spread == MAX_SPREAD
    for each in (spec, of_specimens(0.15)[0]):
        again = InputSpec.from_document(each.document(), each.reference)
        assert again.spread == each.spread
    old = {key: value for key, value in spec.document().items() if key != "spread"}
    assert InputSpec.from_document(old, spec.reference).spread == MAX_SPREAD


def test_another_order_of_the_electrodes_is_named_however_sensors_scatter():
    flat = 500.0 * np.exp(0.3 * np.random.default_rng(4).normal(size=28))
    rows = {frozenset(row[:2]): number for number, row in enumerate(PROTOCOL.table)}

    def plugged(partner):
        return flat[[rows[frozenset(partner[e] for e in row[:2])] for row in PROTOCOL.table]]

    spec = InputSpec(SensorDesign.reference(), PROTOCOL, 40e3, flat, spread=0.5)
    exchanged = [0, 6, 2, 3, 4, 5, 1, 7]
    backwards = [(3 - e) % 8 for e in range(8)]
    for refuse in (spec.require_same_sensor, partial(spec.require_same_sensor, adapting=True)):
        with pytest.raises(FrameError, match=r"electrodes 1 and 6 exchanged: .* another order"):
            refuse(plugged(exchanged).astype(complex))
        with pytest.raises(FrameError, match="counted backwards from 3 on"):
            refuse(plugged(backwards).astype(complex))


def test_a_sensor_that_scatters_more_is_taken_once_its_flat_values_are_known():
    spec, rng = of_specimens(0.01)
    strange = 1.5 * FLAT * np.exp(0.2 * rng.normal(size=28))
    with pytest.raises(FrameError, match=r"expected up to 10\.0%"):
        spec.require_same_sensor(strange.astype(complex))
    spec.require_same_sensor(strange.astype(complex), adapting=True)
    partly = np.where(np.arange(28) == 5, np.nan, strange)
    for own in (spec.for_sensor(strange), spec.for_sensor(partly)):
        own.require_same_sensor((0.8 * strange).astype(complex))
        with pytest.raises(FrameError, match="scatter by"):
            own.require_same_sensor(FLAT.astype(complex))
    with pytest.raises(FrameError, match="scatter by"):
        spec.require_same_sensor(
            (FLAT * np.exp(0.8 * rng.normal(size=28))).astype(complex), adapting=True
        )
