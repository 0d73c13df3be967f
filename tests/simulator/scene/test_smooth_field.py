"""Smooth fields: polynomials exactly, images of presses to what their tables' end leaves."""

import numpy as np
import pytest

from eitskin.geometry import SensorDesign
from eitskin.simulator import Mechanics, Scene, Simulator, Touch
from eitskin.simulator.layer import pressed_touches as presses
from eitskin.simulator.layer.dents import Dents
from eitskin.simulator.layer.smooth_field import Box, SmoothField

BOX = Box((-0.01, 0.0, 0.001), (0.05, 0.03, 0.004))


def polynomial(columns):
    """Polynomials of degrees 3, 2 and 1 in x, y and z, two components, (2, h, n)."""
    x, y, z = (1e2 * columns[..., axis].T for axis in range(3))
    return np.stack([x**3 * y**2 * z - 2.0 * y, 1.0 + x * z])


def columns(count, heights, seed=0):
    rng = np.random.default_rng(seed)
    places = rng.uniform(BOX.low[:2], BOX.high[:2], (count, 2))
    found = np.empty((count, len(heights), 3))
    found[..., :2], found[..., 2] = places[:, None], heights
    return found


def test_polynomials_are_met_everywhere() -> None:
    field = SmoothField.of(polynomial, BOX, (4, 3, 2))
    at = columns(20, (0.001, 0.002, 0.004))
    assert field(at) == pytest.approx(polynomial(at), rel=1e-12, abs=1e-13)
    single = at.reshape(-1, 1, 3)[np.random.default_rng(1).permutation(60)]
    assert field(single) == pytest.approx(polynomial(single), rel=1e-12, abs=1e-13)


def test_smooth_functions_converge_geometrically() -> None:
    def wave(columns):
        return np.exp(np.sin(60.0 * columns[..., 0] + 40.0 * columns[..., 1])).T[None]

    at, errors = columns(200, (0.002, 0.003)), []
    for degree in (4, 8, 12):
        errors.append(np.abs(SmoothField.of(wave, BOX, (degree, degree, 2))(at) - wave(at)).max())
    assert errors[1] < 0.05 * errors[0]
    assert errors[2] < 0.05 * errors[1]
    # Outside, distances are from the nearest side.
    assert BOX.distance(0.02, 0.01) == 0.0
    assert BOX.distance(0.054, 0.033) == pytest.approx(0.005)


@pytest.mark.slow
@pytest.mark.parametrize("place", [(0.075, 0.030), (0.023, 0.021), (0.085, 0.015)])
def test_interpolated_images_change_signals_by_less_than_the_model_is_good_for(place) -> None:
    sim = Simulator(SensorDesign.reference(), resolution="fast")
    touch = Touch(*place, 10.0)
    dents = presses.dents((touch,), sim.design, Mechanics(), "tabulated")
    whole = Dents(dents.presses)
    points = sim.model.assembly.points
    assert dents.gradient(points) == pytest.approx(whole.gradient(points), abs=5e-4)
    flat = sim.measure(Scene()).impedance
    found, exact = (sim.deformed(each).impedance - flat for each in (dents, whole))
    error = np.linalg.norm(found - exact) / np.linalg.norm(exact)
    assert 0.0 < error < 0.01
