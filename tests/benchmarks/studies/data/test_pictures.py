"""The study of pictures: its data in the order of another program, and what it quotes."""

import numpy as np

from eitskin.benchmarks.studies.data.pictures import QUOTED, adjacent_rows, columns, figures
from eitskin.protocol import Protocol
from eitskin.training import FiguresOfMerit


def test_measurements_are_found_in_another_order_and_polarity():
    table = Protocol(((0, 1, 3, 2), (1, 0, 3, 2), (5, 6, 9, 10)), 16)
    own = Protocol.adjacent(16)
    impedance = np.random.default_rng(0).normal(size=(16, 16))
    signs, rows = adjacent_rows(table)
    assert np.allclose(signs * own.measure(impedance)[rows], table.measure(impedance))


def test_every_quantity_is_quoted_at_every_distance():
    found = [FiguresOfMerit(2.0, (-0.005, 0.0), 0.3, 0.0, 0.1)] * 19
    curves = columns(found)
    assert (curves["amplitude"] == 1.0).all()
    assert np.allclose(curves["position error"], 0.1)
    quoted = dict(figures({"one": curves}))
    assert len(quoted) == 5 * len(QUOTED)
    assert quoted["one / ringing at 0.6"] == 0.1
