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
from eitskin.simulator.electrical.deformed_layer import DeformedLayer
from eitskin.simulator.electrical.function_space import estimated_memory
from eitskin.simulator.electrical.resolution import discretisation, press_length, suited_cells
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity
from eitskin.simulator.scene.indenters import Cylinder, Sphere

DESIGN = SensorDesign.reference()
CONVERGED = ((5, 5, 5, 4, 3), Grading(2e-4, 6e-3, 3.0))
SCENES = (Scene(touches=(Touch(0.060, 0.030),)), shear_deformation(0), shear_deformation(1))


@cache
def signals(resolution):
    sim = Simulator(DESIGN, resolution)
    pressed, *sheared = SCENES
    frames = sim.measure(pressed), *map(sim.simulate_deformation, sheared)
    flat = sim.measure(Scene()).impedance.real
    return [frame.impedance.real / flat - 1.0 for frame in frames]


# Orders that fall with the part over the height follow presses and bends, but not a shear of the
# whole layer, which couples the parts.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("resolution", "of_press", "of_shear"),
    [("coarse", 5e-3, 2.5e-2), ("fast", 2e-3, 3.8e-2), ("standard", 1e-3, 2e-3)],
)
def test_signals_are_as_exact_as_promised(resolution, of_press, of_shear) -> None:
    limits = (of_press, of_shear, of_shear)
    for found, truth, limit in zip(signals(resolution), signals(CONVERGED), limits, strict=True):
        assert np.linalg.norm(found - truth) < limit * np.linalg.norm(truth)


# Meshes for small indenters


@pytest.mark.parametrize("cells", ["hexahedra", "prisms"])
@pytest.mark.parametrize("extent", [0.03, 1.0])
def test_cells_are_not_larger_than_an_indenter_allows(extent, cells) -> None:
    outline = Rectangle(extent, extent)
    wide = dataclasses.replace(DESIGN, outline=outline, electrodes=uniform(outline, 4))
    for indenter in (Cylinder(), Cylinder(0.0025), Sphere(0.003), Sphere(0.1)):
        _, grading = discretisation("fast", wide, cells, indenter)
        assert grading.coarsest < press_length(wide, indenter)


def test_small_indenters_have_a_finer_mesh_and_wide_ones_share_the_base_mesh() -> None:
    sim = Simulator(SensorDesign.reference(), "fast")
    family, small = sim._impedances.own, Touch(0.05, 0.03, indenter=Sphere(0.003))
    wide = [Touch(0.05, 0.03), Touch(0.05, 0.03, indenter=Cylinder(0.01))]
    assert family.model_for_touches([]) is family.model_for_touches(wide) is sim.model
    fine = family.model_for_touches([*wide, small])
    assert len(fine.mesh.cells) > len(sim.model.mesh.cells)
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
    assert (error < 2.5e-3 * np.linalg.norm(apart - flat, axis=1)[1:]).all()


# Memory


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
        model.solver.factorise(model._system(model._conductivity(1.0), None)[1].values)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak / 2.0 < estimated_memory(model.assembly.space) < 2.5 * peak
    with pytest.raises(ConfigurationError, match="more than the 8 GB"):
        ForwardModel(DESIGN, ((10,) * 6, Grading(5e-3, 1e-2, 1.0)))


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
    model = ForwardModel(DESIGN, "fast", cells="prisms")
    layer = DeformedLayer(DESIGN, SCENES[1], Piezoresistivity())
    bent, flat = model.impedance(layer.conductivity, layer.area_ratio), model.impedance()
    pairs, truth = Protocol.pairwise(8), signals(CONVERGED)[1]
    found = (pairs.measure(bent) / pairs.measure(flat)).real - 1.0
    assert np.linalg.norm(found - truth) < 1e-2 * np.linalg.norm(truth)


# Shared meshes


def test_simulators_of_one_design_share_its_mesh_and_its_flat_impedance() -> None:
    ring = dataclasses.replace(DESIGN, conductivity=0.321)
    one = Simulator(ring, "coarse")
    flat, solved = one.measure(Scene()).impedance, one.model.factorisations
    again = Simulator(ring, "coarse", protocol=Protocol.adjacent(8))
    assert again.model is one.model
    Z = again.impedance_matrix(Scene())
    assert np.array_equal(again.protocol.measure(Z), again.measure(Scene()).impedance)
    assert np.array_equal(one.protocol.measure(Z), flat)
    assert one.model.factorisations == solved
    assert Simulator(ring, "coarse", Hinge(0.030)).model is not one.model
