"""Bounds against closed forms, against estimates that reach them, and on real scenes."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.special import erf

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import FourTerminalMeter, Instrument, Scene, Simulator, Touch
from eitskin.training.evaluation.cramer_rao import (
    cramer_rao_bound,
    mean_distance,
    scene_derivatives,
)


@pytest.fixture(scope="module")
def sim():
    """A simulator of few cells: nothing here depends on how exact the resistances are."""
    return Simulator(SensorDesign.reference(), ((3, 2), Grading(2e-3, 8e-3, 1.0)))


def drawn(seed, parameters=4, measurements=9):
    """Derivatives, and standard deviations of the measurements."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(parameters, measurements)), rng.uniform(0.5, 2.0, measurements)


@pytest.mark.slow
def test_bounds_are_those_of_a_line_an_untouched_angle_and_a_boards_readings(sim):
    """y = a + b t with white noise s, by the formulas of linear regression."""
    t, s = np.array([1.0, 2.0, 4.0, 7.0, 11.0]), 0.3
    spread = ((t - t.mean()) ** 2).sum()
    found = cramer_rao_bound([np.ones(5), t], s)
    assert found[1, 1] == pytest.approx(s**2 / spread)
    assert found[0, 0] == pytest.approx(s**2 * (t**2).mean() / spread)
    assert found[0, 1] == pytest.approx(-(s**2) * t.mean() / spread)
    known = cramer_rao_bound(t[None], s)
    assert known[0, 0] == pytest.approx(s**2 / (t**2).sum())
    found = scene_derivatives(sim, Scene(Bend(10.0))).bound(2e-4, 4)
    assert len(found.place) == len(found.distance) == len(found.force) == 0
    slope = np.log(sim.measure(Scene(Bend(10.5))).impedance.real) - np.log(
        sim.measure(Scene(Bend(9.5))).impedance.real
    )
    assert found.angle_deg == pytest.approx(np.sqrt(1.25) * 2e-4 / np.linalg.norm(slope), rel=1e-6)
    board = Instrument(meter=FourTerminalMeter(source=1e-4, idle=1e-4))
    found = scene_derivatives(sim, Scene(Bend(10.0)), instrument=board)
    low, middle, high = (
        board.transfer_impedance(sim.impedance_matrix(Scene(Bend(angle))), sim.protocol).real
        for angle in (9.5, 10.0, 10.5)
    )
    np.testing.assert_allclose(found.resistance, middle, rtol=1e-9)
    noise = board.deviation(500.0) / np.abs(middle)  # of the logarithm
    np.testing.assert_allclose(found.noise(board, 500.0), noise, rtol=1e-9)
    np.testing.assert_allclose(found.by_angle, np.log(np.abs(high / low)), rtol=1e-5, atol=1e-9)
    plain = scene_derivatives(sim, Scene(Bend(10.0)))
    assert np.abs(plain.by_angle - found.by_angle).max() > 0.01 * np.abs(plain.by_angle).max()


@pytest.mark.parametrize("deviations", [(1.0, 1.0), (1.0, 0.3), (2.0, 0.05)])
def test_mean_distance_is_the_integral(deviations):
    """Of the distance, over its density, on a fine grid along the principal axes."""
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    covariance = turn @ np.diag(np.square(deviations)) @ turn.T
    edges = np.linspace(-8.0, 8.0, 1601)
    middle = 0.5 * (edges[1:] + edges[:-1])
    mass = np.diff(0.5 * erf(edges / np.sqrt(2.0)))
    distance = np.hypot(deviations[0] * middle[:, None], deviations[1] * middle)
    assert mean_distance(covariance) == pytest.approx(mass @ distance @ mass, rel=1e-4)
    limits = mean_distance(np.array([np.diag([4.0, 0.0]), np.eye(2), np.zeros((2, 2))]))
    assert limits == pytest.approx([2.0 * np.sqrt(2.0 / np.pi), np.sqrt(np.pi / 2.0), 0.0])


@dataclass
class Quadratic:
    """Takes the place of a simulator: logarithms are quadratic in x, y, force and angle."""

    forces: tuple[float, float] = (0.0, 20.0)
    seen: list[Scene] = field(default_factory=list)

    def deformation(self, scene):
        low, high = self.forces
        if not all(t.x >= 0.0 and t.y <= 0.06 and low <= t.force <= high for t in scene.touches):
            raise ConfigurationError("off")

    def measure_all(self, scenes, tolerance, instrument):
        assert tolerance == 0.0  # errors of reanalysis would be differentiated too
        assert instrument is None
        self.seen += scenes
        return -np.exp([self.logarithm(scene) for scene in scenes]) + 5.0j

    @staticmethod
    def logarithm(scene):
        a, (t,) = scene.bend.angle_deg, scene.touches
        x, y = 1e2 * t.x, 1e2 * t.y
        return [x**2 + y, y**2 + 0.1 * t.force**2, 0.01 * a**2 + x, y * y - x * x + 0.1 * a]


@pytest.mark.parametrize("place", [(0.03, 0.03), (0.0005, 0.0599), (0.0, 0.06)])
@pytest.mark.parametrize("force", [10.0, 19.9])
def test_differences_are_of_second_order_next_to_limits_too(place, force):
    model, scene = Quadratic(), Scene(Bend(5.0), (Touch(*place, force),))
    found = scene_derivatives(model, scene)
    x, y = 1e2 * place[0], 1e2 * place[1]
    expected = [[2e2 * x, 0, 1e2, -2e2 * x], [1e2, 2e2 * y, 0, 2e2 * y], [0, 0.2 * force, 0, 0]]
    assert found.by_touch[0] == pytest.approx(np.array(expected), rel=1e-9, abs=1e-9)
    assert found.by_angle == pytest.approx(np.array([0, 0, 0.1, 0.1]), abs=1e-10)
    assert found.resistance == pytest.approx(-np.exp(model.logarithm(scene)))
    for each in model.seen:
        model.deformation(each)
