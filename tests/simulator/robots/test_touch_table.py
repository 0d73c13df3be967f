"""Table of touches: beside the function that it tabulates, and beside the simulator itself."""

import types

import numpy as np
import pytest

from eitskin.geometry import SensorDesign
from eitskin.geometry.design.outline import Rectangle
from eitskin.simulator import Cylinder, Scene, Simulator, Touch
from eitskin.simulator.robots.touch_table import TouchRules, TouchTable

OUTLINE, RULES = Rectangle(0.1, 0.05), TouchRules()
FLAT = np.array([400.0 + 3.0j, 700.0 - 2.0j, 550.0])


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))


def changed(touch):
    """Smooth change of the logarithms by one touch, (3,)."""
    u, v, f = touch.x / 0.1, touch.y / 0.05, touch.force / RULES.most
    wave = np.array([np.sin(3 * u + v), np.cos(2 * v) * u, 0.5j * np.cos(u * v)])
    return 0.05 * f * (1.0 + 0.3 * f) * wave


class SmoothSimulator:
    """Simulator of three measurements; counts its scenes."""

    design = mechanics = touch_model = grid = None

    def __init__(self):
        self.solved = 0

    def measure_all(self, scenes, **_):
        self.solved += len(scenes)
        return np.array([FLAT * np.exp(sum(map(changed, each.touches))) for each in scenes])


def test_places_and_forces_between_are_interpolated() -> None:
    table = TouchTable.solved(SmoothSimulator(), OUTLINE, Cylinder(), RULES, spacing=0.005)
    shares = np.random.default_rng(5).random((20, 3))
    touches = [
        Touch(0.005 + 0.09 * x, 0.005 + 0.04 * y, RULES.most * (0.01 + 0.99 * force))
        for x, y, force in shares
    ]
    expected = [np.exp(changed(each)) for each in touches]
    np.testing.assert_allclose(table.factors(touches), expected, rtol=0, atol=2e-6)


def test_a_table_is_solved_once_for_all_it_depends_on() -> None:
    simulator = SmoothSimulator()

    def solved(indenter=Cylinder(), rules=RULES):  # noqa: B008
        return TouchTable.solved(simulator, OUTLINE, indenter, rules, spacing=0.005)

    first, scenes = solved(), simulator.solved
    assert scenes == 1 + 19 * 9 * 6
    again = solved()
    assert simulator.solved == scenes + 1  # the untouched one, by which the table is known
    touches = [Touch(0.033, 0.021, 5.0)]
    assert np.array_equal(first.factors(touches), again.factors(touches))
    solved(Cylinder(0.005))
    solved(rules=TouchRules(most=6.0))
    simulator.design = types.SimpleNamespace(thickness=0.004)
    solved()
    assert simulator.solved == 4 * scenes + 1


@pytest.mark.slow
def test_touches_of_the_reference_sensor_between_solved_ones_are_those_of_the_simulator() -> None:
    """Places 2.5 mm apart near an electrode: within 2 % of the signal."""
    simulator = Simulator(SensorDesign.reference(), "coarse")
    x, y = 0.018 + 0.0025 * np.arange(4), 0.008 + 0.0025 * np.arange(4)
    forces = np.array([0.0, 3.0, 6.0, 12.0])
    places = [(Touch(a, b, force),) for a in x for b in y for force in forces[1:]]
    flat, *solved = simulator.measure_all([Scene(), *(Scene(touches=each) for each in places)])
    logarithms = np.log(np.array(solved) / flat)
    changes = np.concatenate([logarithms.real, logarithms.imag], axis=1).reshape(4, 4, 3, -1)
    table = TouchTable((x, y, forces), np.pad(changes, [(0, 0), (0, 0), (1, 0), (0, 0)]))

    touches = [Touch(0.0213, 0.0121, force) for force in (1.0, 5.0, 11.0)]
    expected = simulator.measure_all([Scene(touches=(each,)) for each in touches]) / flat
    error = np.linalg.norm(table.factors(touches) - expected, axis=1)
    assert np.all(error < 0.02 * np.linalg.norm(expected - 1.0, axis=1)), error
