"""Protocols: order, patterns, and what is refused."""

import numpy as np
import pytest

from eitskin.geometry import ConfigurationError
from eitskin.simulator import Protocol


def test_pairwise_lists_every_pair_once_in_order() -> None:
    protocol = Protocol.pairwise(8)
    assert len(protocol) == 28
    assert protocol.labels[:3] == ("0-1", "0-2", "0-3")
    assert protocol.labels[-1] == "6-7"


def test_measure_is_sense_pattern_times_matrix_times_drive_pattern() -> None:
    rng = np.random.default_rng(0)
    Z = rng.standard_normal((5, 4, 4))
    protocol = Protocol(((0, 1, 2, 3), (1, 3, 0, 2)), 4)
    drive, sense = protocol.patterns()
    expected = np.einsum("em,nef,fm->nm", sense, Z, drive)
    assert protocol.measure(Z) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ((), "at least one measurement"),
        (((0, 1, 0, 8),), "each from 0 to 7"),
        (((0, 0, 1, 2),), "two different electrodes"),
        (((0, 1, 2),), "expected"),
    ],
)
def test_impossible_tables_are_refused(table, message) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Protocol(table, 8)


def test_a_matrix_of_another_size_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"\(8, 8\)"):
        Protocol.pairwise(8).measure(np.eye(7))
