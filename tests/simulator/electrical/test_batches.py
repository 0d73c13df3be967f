"""Batches of block eliminations by torch against one at a time."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import ForwardModel, Scene, Simulator, Touch

COARSE = ((2, 2, 1), Grading(2e-3, 8e-3, 3.0))


@pytest.fixture(scope="module")
def sim() -> Simulator:
    return Simulator(SensorDesign.reference(), COARSE)


def test_batches_are_as_one_by_one(sim) -> None:
    scenes = [Scene(Bend(5.0 * k), (Touch(0.03 + 0.01 * k, 0.02, 4.0 + k),)) for k in range(5)]
    scenes += [Scene(), Scene(Bend(30.0)), scenes[2]]
    found = sim.measure_all(scenes, device="cpu")
    plain = np.array([sim.measure(scene).impedance for scene in scenes])
    assert np.abs(found / plain - 1.0).max() < 1e-11


def test_equal_scenes_are_solved_once() -> None:
    sim = Simulator(SensorDesign.reference(), COARSE)
    sim.measure_all([Scene(), Scene(), Scene(Bend(10.0))], device="cpu")
    assert sim.model.factorisations == 2


def test_what_cannot_be_batched_is_refused(sim) -> None:
    with pytest.raises(ConfigurationError, match="'no such device'"):
        sim.measure_all([Scene()], device="no such device")
    design = SensorDesign.reference()
    electrodes = tuple(
        dataclasses.replace(e, contact_impedance=1e-3 - 2e-4j) for e in design.electrodes
    )
    complex_contacts = Simulator(dataclasses.replace(design, electrodes=electrodes), COARSE)
    with pytest.raises(ConfigurationError, match="real contact impedances"):
        complex_contacts.measure_all([Scene()], device="cpu")
    sparse = ForwardModel(design, COARSE, solver="sparse LU")
    with pytest.raises(ConfigurationError, match="block Cholesky"):
        sparse.impedances([(1.0, lambda x, _: np.ones(x.shape[:-1]))])
