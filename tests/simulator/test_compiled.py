"""Compiled kernels against their plain twins."""

import numpy as np
import pytest

from eitskin import compiled
from eitskin.compiled import kernels
from eitskin.geometry import Bend, SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import Scene, Simulator, Touch

KERNELS = "eitskin.simulator.deformation.kernels"
if compiled.load_kernels(KERNELS) is None:
    pytest.skip("needs the extra `fast`, without EITSKIN_PLAIN", allow_module_level=True)

COARSE = ((2, 2, 1), Grading(2e-3, 8e-3, 3.0))
PRESSED = (Touch(0.050, 0.020, 6.0), Touch(0.078, 0.034, 4.0), Touch(0.130, 0.045, 3.0))


def with_kernels(evaluated, *arguments):
    with kernels():
        return evaluated(*arguments)


@pytest.fixture(scope="module")
def sim():
    return Simulator(SensorDesign.reference(), COARSE)


@pytest.mark.parametrize("scene", [Scene(touches=PRESSED), Scene(Bend(35.0), PRESSED[:1])])
def test_deformations_are_those_of_plain_numpy(sim, scene) -> None:
    points = sim.model.assembly.points
    layer = sim.deformed_layer(scene)
    plain = layer.entries(points)
    assert with_kernels(layer.entries, points) == pytest.approx(plain, rel=1e-11, abs=1e-13)
    rng = np.random.default_rng(0)
    scattered = rng.uniform((0.0, 0.0, 0.0), (0.150, 0.060, 0.005), (500, 3))
    for evaluated in (layer.deformation.gradient, layer.deformation.positions):
        plain = evaluated(scattered)
        assert with_kernels(evaluated, scattered) == pytest.approx(plain, rel=1e-11, abs=1e-12)


def test_frames_are_those_of_plain_numpy(sim) -> None:
    scenes = [Scene(Bend(20.0), PRESSED), Scene(touches=PRESSED[:1]), Scene(Bend(-10.0))]
    plain = np.array([sim.measure(scene).impedance for scene in scenes])
    found = sim.measure_all(scenes, tolerance=0.0)
    flat = sim.measure(Scene()).impedance
    assert not np.array_equal(found, plain)  # kernels round otherwise
    assert np.abs(found - plain).max() < 1e-8 * np.abs(plain - flat).max()


def test_scenes_in_single_precision_are_those_of_plain_numpy(monkeypatch) -> None:
    sim = Simulator(SensorDesign.reference(), "coarse")
    scenes = [Scene(Bend(20.0), PRESSED), Scene(touches=PRESSED[:1]), Scene(Bend(-10.0))]
    found = sim.impedances(scenes, 1e-5)
    monkeypatch.setattr(compiled, "load_kernels", lambda _: None)
    plain = sim.impedances(scenes, 1e-5)
    assert not np.array_equal(found, plain)
    assert np.abs(found - plain).max() < 1e-6 * np.abs(plain).max()


def test_kernels_can_be_left_out(monkeypatch) -> None:
    assert compiled.compiled_kernels(KERNELS) is None
    assert with_kernels(compiled.compiled_kernels, KERNELS) is not None
    monkeypatch.setenv("EITSKIN_PLAIN", "1")
    assert compiled.load_kernels.__wrapped__(KERNELS) is None
