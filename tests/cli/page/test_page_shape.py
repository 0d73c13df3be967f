"""Pictures of the live page: the bent and pressed sensor, and changes of its channels."""

import base64
import struct

import numpy as np
import pytest

from eitskin.cli.page.shape import COLUMNS, ROWS, GelDrawing, GelShape
from eitskin.cli.page.state import filled, relative_change
from eitskin.geometry import Bend, Clamp
from eitskin.simulator import Frame, Mechanics
from eitskin.simulator.bends import bend_store

from page_fakes import DESIGN, PROTOCOL


def decoded(text, unit):
    steps = np.array(struct.unpack(f"<{len(text) // 2}h", text)) * unit
    return steps.reshape(-1, 3)


def test_the_drawn_sensor_is_bent_and_dented_as_the_simulated_one() -> None:
    shape = GelShape.of(DESIGN)
    flat = shape.bent(0.0, [])
    assert np.allclose(flat, shape.points, atol=1e-12)
    bent = shape.bent(30.0, [])
    layer = bend_store.bend(DESIGN, Clamp(), Mechanics(), Bend(30.0))
    wanted = layer.positions(shape.points)
    assert np.allclose(bent, wanted)
    dented = shape.bent(0.0, [(0.075, 0.03, 10.0)])
    middle = ROWS // 2 * COLUMNS + COLUMNS // 2
    # The closed form thins the gel by 0.036 F + 0.0012 F^2 on the axis.
    assert dented[middle, 2] == pytest.approx(0.005 * (1 - 0.48))
    assert np.array_equal(shape.bent(500.0, []), shape.bent(shape.most, []))
    assert np.array_equal(shape.bent(float("nan"), []), flat)


def test_noise_is_not_drawn_again() -> None:
    drawing = GelDrawing.of(DESIGN)
    first = drawing.points(10.0, [(0.05, 0.03, float("nan"))])
    assert drawing.points(10.1, [(0.0505, 0.03, float("nan"))]) is first
    moved = drawing.points(10.5, [(0.05, 0.03, float("nan"))])
    assert moved != first
    assert drawing.points(10.5, []) != moved
    places = decoded(base64.b64decode(drawing.points(0.0, [])), drawing.unit)
    assert np.allclose(places, drawing.shape.points, atol=drawing.unit)


def test_a_channel_that_was_bad_at_first_is_compared_with_its_first_good_value():
    status = np.zeros(28, np.uint8)
    status[3] = 8
    values = np.full(28, 500.0)
    first = Frame(np.where(status, 1e5, values), PROTOCOL, status=status)
    later = Frame(values * 1.01, PROTOCOL, number=1)
    reference = filled(first, later)
    assert not reference.status.any()
    change = relative_change(Frame(values * 1.02, PROTOCOL, number=2), reference)
    assert change[3] == pytest.approx(100 * (1.02 / 1.01 - 1), abs=1e-3)
    assert change[4] == pytest.approx(2.0)
