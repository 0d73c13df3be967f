"""The promises of the named resolutions, meshes for small indenters, and the bound of memory."""

import dataclasses
import tracemalloc
from functools import cache

import numpy as np
import pytest

from eitskin.benchmarks.accuracy import shear_deformation
from eitskin.errors import ConfigurationError
from eitskin.geometry import Hinge, Rectangle, SensorDesign
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import ForwardModel, Protocol, Scene, Simulator, Touch
from eitskin.simulator.deformation.deformed_layer import DeformedLayer
from eitskin.simulator.electrical.function_space import estimated_memory
from eitskin.simulator.electrical.resolution import discretisation, press_length, suited_cells
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity
from eitskin.simulator.scene.indenters import Cylinder, Sphere

DESIGN = SensorDesign.reference()
# Converged to a tenth of the promise that each is compared with.
CONVERGED = {
    "coarse": ((4, 4, 4, 3, 2), Grading(3e-4, 6e-3, 3.0)),
    "fast": ((4, 4, 4, 3, 2), Grading(3e-4, 6e-3, 3.0)),
    "standard": ((5, 5, 5, 4, 3), Grading(2e-4, 6e-3, 3.0)),
}
PRESSED = Scene(touches=(Touch(0.060, 0.030),))
SCENES = {"press": PRESSED, "sheared": shear_deformation(0), "sheared across": shear_deformation(1)}
PROMISES = {"coarse": 3e-2, "fast": 1e-2, "standard": 3e-3}
# Orders that fall with the part over the height follow presses and bends, but not a shear of the
# whole layer, which couples the parts.
OF_SHEAR = PROMISES | {"fast": 4e-2}


@cache
def simulator(resolution):
    return Simulator(DESIGN, resolution)


@cache
def flat(resolution):
    return simulator(resolution).measure(Scene()).impedance.real


@cache
def signal(resolution, name):
    sim, scene = simulator(resolution), SCENES[name]
    frame = sim.measure(scene) if isinstance(scene, Scene) else sim.simulate_deformation(scene)
    return frame.impedance.real / flat(resolution) - 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SCENES))
@pytest.mark.parametrize("resolution", list(PROMISES))
def test_signals_are_as_exact_as_promised(resolution, name) -> None:
    truth, found = signal(CONVERGED[resolution], name), signal(resolution, name)
    promise = (PROMISES if name == "press" else OF_SHEAR)[resolution]
    assert np.linalg.norm(found - truth) < promise * np.linalg.norm(truth)


# Meshes for small indenters


@pytest.mark.parametrize("cells", ["hexahedra", "prisms"])
@pytest.mark.parametrize("extent", [0.03, 0.18, 1.0])
def test_cells_are_not_larger_than_an_indenter_allows(extent, cells) -> None:
    wide = dataclasses.replace(
        DESIGN, outline=(o := Rectangle(extent, extent)), electrodes=uniform(o, 4)
    )
    for indenter in (Cylinder(), Cylinder(0.0025), Sphere(0.003), Sphere(0.1)):
        _, grading = discretisation("fast", wide, cells, indenter)
        assert grading.coarsest < press_length(wide, indenter)


def test_small_indenters_have_a_finer_mesh_and_wide_ones_share_the_base_mesh() -> None:
    sim = Simulator(SensorDesign.reference(), "fast")
    family = sim._impedances.own
    default, wide, small = (
        Touch(0.05, 0.03, indenter=each) for each in (Cylinder(), Cylinder(0.01), Sphere(0.003))
    )
    assert family.model_for_touches([]) is family.model_for_touches([default, wide]) is sim.model
    fine = family.model_for_touches([default, small])
    assert len(fine.mesh.cells) > len(sim.model.mesh.cells)
    assert family.model_for_touches([small]) is fine
    own = Simulator(SensorDesign.reference(), ((3, 2, 1), Grading(1e-3, 6e-3, 2.0)))
    assert own._impedances.own.model_for_touches([small]) is own.model


@pytest.mark.slow
def test_many_scenes_of_two_meshes_are_those_of_one_by_one(monkeypatch) -> None:
    """Light presses stand for those of small indenters, whose dents take minutes to solve."""
    sim = Simulator(SensorDesign.reference(), "coarse")
    fine = ForwardModel(sim.design, ((3, 2, 1), Grading(1.5e-3, 6e-3, 2.0)))
    family = sim._impedances.own
    suited = lambda touches: fine if any(t.force < 5.0 for t in touches) else family.base  # noqa: E731
    monkeypatch.setattr(family, "model_for_touches", suited)
    scenes = [Scene(touches=(Touch(x, 0.03, F),)) for F in (10.0, 2.0) for x in (0.04, 0.06, 0.08)]
    scenes = [Scene(), *scenes]
    apart = np.array([sim.measure(scene).impedance for scene in scenes])
    assert sim.measure_all(scenes, tolerance=0.0) == pytest.approx(apart, rel=1e-11)
    found, flat = sim.measure_all(scenes), apart[0]
    hard, light = np.split(apart[1:].real - flat.real, 2)
    assert ((hard * light).sum(axis=1) > 0.0).all()
    # Rounding of single precision leaves 2e-7 of the impedances themselves.
    error = np.linalg.norm(found - apart, axis=1)[1:]
    assert (error < 3e-3 * np.linalg.norm(apart - flat, axis=1)[1:]).all()


# Memory


def test_a_model_beyond_the_bound_is_refused_before_it_is_assembled() -> None:
    with pytest.raises(ConfigurationError, match=r"needs about .* GB .* more than the 8 GB"):
        ForwardModel(DESIGN, ((10,) * 6, Grading(5e-3, 1e-2, 1.0)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "size", "cells"), [((3, 3, 2, 1), 6e-3, None), ((3, 2, 1), 8e-3, "prisms")]
)
def test_the_estimate_is_near_the_memory_that_is_taken(order, size, cells) -> None:
    tracemalloc.start()
    try:
        model = ForwardModel(
            DESIGN, (order, Grading(size, size, 1.0)), cells=cells, solver="block Cholesky"
        )
        model.solver.factorise(model._system(1.0, None)[1].values)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak / 2.0 < estimated_memory(model.assembly.space) < 2.5 * peak


# Kinds of cells


def test_many_electrodes_have_prisms_unless_hexahedra_are_needed_or_asked_for() -> None:
    """Lines of hexahedra through 32 electrodes would make five times the reference's unknowns."""
    eight, many, pads = (
        dataclasses.replace(DESIGN, electrodes=electrodes)
        for electrodes in (
            uniform(DESIGN.outline, 8),
            uniform(DESIGN.outline, 16),
            grid(DESIGN.outline, 4, 8, 0.005),
        )
    )
    kinds = [suited_cells("fast", design) for design in (eight, many, pads)]
    assert kinds == ["hexahedra", "prisms", "hexahedra"]
    assert suited_cells(((3, 2, 1), Grading(1e-3, 6e-3, 2.0)), many) == "hexahedra"
    assert suited_cells("fast", many, (0.055,)) == "hexahedra"
    assert suited_cells("coarse", many) == "hexahedra"
    few, more = ForwardModel(eight, "fast"), ForwardModel(many, "fast")
    assert more.mesh.cells.shape[1] == 6
    assert more.unknowns < 3.0 * few.unknowns


@pytest.mark.slow
def test_prisms_are_as_exact_as_promised() -> None:
    resolution = "fast"
    truth = signal(CONVERGED[resolution], "sheared")
    model = ForwardModel(DESIGN, resolution, cells="prisms")
    layer = DeformedLayer(DESIGN, SCENES["sheared"], Piezoresistivity())
    bent, flat = model.impedance(layer.conductivity, layer.area_ratio), model.impedance()
    pairs = Protocol.pairwise(8)
    found = (pairs.measure(bent) / pairs.measure(flat)).real - 1.0
    assert np.linalg.norm(found - truth) < PROMISES[resolution] * np.linalg.norm(truth)


# Shared meshes


def test_simulators_of_one_design_share_its_mesh_and_its_flat_impedance() -> None:
    ring = dataclasses.replace(DESIGN, conductivity=0.321)
    one = Simulator(ring, "coarse")
    flat = one.measure(Scene()).impedance
    solved = one.model.factorisations
    again = Simulator(ring, "coarse", protocol=Protocol.adjacent(8))
    assert again.model is one.model
    assert np.array_equal(
        again.protocol.measure(again.impedance_matrix(Scene())), again.measure(Scene()).impedance
    )
    assert one.model.factorisations == solved
    assert np.array_equal(Simulator(ring, "coarse").measure(Scene()).impedance, flat)
    assert Simulator(ring, "coarse", Hinge(0.030)).model is not one.model
