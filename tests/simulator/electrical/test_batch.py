"""Many scenes at once, and how exact and large each resolution is."""

import dataclasses
import math
import tracemalloc
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from eitskin import compiled
from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Hinge, Rectangle, SensorDesign
from eitskin.geometry.deformation.kinematics import Displaced
from eitskin.geometry.design.regular_layouts import grid, uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import (
    EXACT,
    Cylinder,
    ForwardModel,
    Mechanics,
    Protocol,
    Scene,
    Simulator,
    Sphere,
    Touch,
)
from eitskin.simulator.electrical.batch import TOLERANCE, BatchSolver, LayerFields
from eitskin.simulator.electrical.deformed_layer import DeformedLayer
from eitskin.simulator.electrical.function_space import estimated_memory
from eitskin.simulator.electrical.resolution import discretisation, press_length, suited_cells
from eitskin.simulator.electrical.sensor_impedances import SensorImpedances
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity
from eitskin.simulator.simulator import impedances_together

from contacts import with_contacts

pytestmark = pytest.mark.slow

COARSE = ((2, 2, 1), Grading(2e-3, 8e-3, 3.0))
ANGLES = (-20.0, 0.0, 25.0, 50.0)
PRESSED = Mechanics(piezoresistivity=Piezoresistivity(volume=0.5, pressure=2e-6))
PLACES = np.array([[0.02, 0.015], [0.055, 0.04], [0.09, 0.02], [0.13, 0.045]])


def touches(count, seed=0, force=8.0):
    """Touches apart from each other, near one place each."""
    rng = np.random.default_rng(seed)
    places = PLACES[:count] + rng.uniform(-0.004, 0.004, (count, 2))
    return tuple(Touch(float(x), float(y), force) for x, y in places)


def scenes():
    """One to four touches at each angle."""
    return [
        Scene(Bend(angle), touches(count, seed=count, force=4.0 + 2.0 * count))
        for angle in ANGLES
        for count in (1, 2, 3, 4)
    ]


def plainly(sim, some):
    """Measurements [ohm] of scenes that are each solved by itself, (scenes, measurements)."""
    return np.array([sim.measure(scene).impedance for scene in some])


def signal_errors(sim, some, **options):
    """Errors of the signals of touches, each over the norm of its signal, (scenes,)."""
    without = [dataclasses.replace(scene, touches=()) for scene in some]
    truth = plainly(sim, some) - plainly(sim, without)
    found = sim.measure_all([*some, *without], **options)
    errors = found[: len(some)] - found[len(some) :] - truth
    return np.linalg.norm(errors, axis=1) / np.linalg.norm(truth, axis=1)


@pytest.fixture(scope="module")
def small() -> Simulator:
    return Simulator(SensorDesign.reference(), COARSE)


# Errors


def test_signals_of_touches_are_off_by_less_than_a_thousandth(small) -> None:
    pressed = Simulator(small.design, COARSE, mechanics=PRESSED)
    assert signal_errors(pressed, scenes()[::2]).max() < 1e-3
    complex_contacts, some = Simulator(with_contacts(1e-3 - 2e-4j), COARSE), scenes()[:2]
    exact = plainly(complex_contacts, some)
    assert complex_contacts.measure_all(some) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("z", [1e-7, 10.0])
def test_electrodes_of_any_contact_impedance(z) -> None:
    """In the form of the flat sensor, which is the lifted one where contact is good."""
    sim = Simulator(with_contacts(z), COARSE)
    near = [Scene(Bend(15.0), (Touch(x, 0.008, 6.0),)) for x in (0.022, 0.075, 0.128)]
    assert signal_errors(sim, near).max() < 1e-3
    assert signal_errors(sim, near, tolerance=1e-8).max() < 1e-6


def solved(solver, layer, tolerance=TOLERANCE):
    """Impedances [ohm] of one layer, begun with the factorised one."""
    fields = LayerFields.from_layer(layer, solver.model.assembly)
    return solver.solve([(fields, solver.base)], tolerance)[0].impedance


@pytest.mark.parametrize(
    ("cells", "solver"), [("prisms", "block Cholesky"), ("hexahedra", "nested dissection")]
)
def test_meshes_and_solvers_of_any_kind(small, cells, solver) -> None:
    model = ForwardModel(small.design, COARSE, cells=cells, solver=solver)
    batch = BatchSolver(model, small.deformed_layer(Scene()))
    flat = batch.base.impedance
    assert flat == pytest.approx(model.impedance(), rel=1e-10, abs=1e-9)
    for scene in (Scene(touches=touches(2)), Scene(Bend(30.0), touches(1))):
        layer = small.deformed_layer(scene)
        plain = model.impedance(layer.conductivity, layer.area_ratio)
        change = np.linalg.norm(plain - flat)
        assert np.linalg.norm(solved(batch, layer) - plain) < 3e-4 * change
        assert np.linalg.norm(solved(batch, layer, 1e-8) - plain) < 1e-7 * change


@dataclasses.dataclass(frozen=True)
class Layer:
    """Layer of a conductivity `sigma` (n, 3) -> (n,) and flat electrodes."""

    sigma: Callable
    shift: None = None
    deformation = is_flat = False
    contact_impedance = SensorDesign.reference().contact_impedance

    def entries_and_ratio(self, points, cells, normals):
        count = cells[0] * cells[1]
        ratio = np.ones((len(normals), (len(points) - count) // len(normals)))
        return self.entries(points[:count].reshape(*cells, 3)), ratio

    def entries(self, x):
        return self.sigma(x)[..., None] * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])

    def conductivity(self, x):
        return self.sigma(x)[..., None, None] * np.eye(3)

    def area_ratio(self, x, normal):
        del normal
        return np.ones(x.shape[:-1])


def test_corrections_take_most_of_the_error_and_wild_scenes_are_solved_alone(small):
    """By the square of the part that the conductivity changes by, which is a half at most."""
    batch = BatchSolver(small.model, Layer(lambda x: np.ones(x.shape[:-1])))
    changed = Layer(lambda x: 1.0 + 0.5 * np.sin(60.0 * x[..., 0]) * np.cos(90.0 * x[..., 1]))
    plain = small.model.impedance(changed.conductivity, changed.area_ratio)
    change = np.linalg.norm(plain - batch.base.impedance)
    for tolerance in (1e-3, 1e-4, 1e-5, 1e-6, 1e-8):
        before = batch.solutions
        error = np.linalg.norm(solved(batch, changed, tolerance) - plain)
        assert error < tolerance * change
        assert batch.solutions - before <= 2.0 - math.log(tolerance) / math.log(4.0)
    strange = Layer(lambda x: np.where(np.sin(200.0 * x[..., 0] + 130.0 * x[..., 1]) > 0, 1.0, 1e6))
    plain = small.model.impedance(strange.conductivity, strange.area_ratio)
    gentle, wild = Scene(Bend(20.0)), Scene(Bend(10.0))
    layers = {gentle: small.deformed_layer(gentle), wild: strange}
    sensor = SensorImpedances(
        small.design, COARSE, (), None, lambda some: [layers[s] for s in some]
    )
    batch = sensor.own.solver(small.model)
    before = small.model.factorisations, batch.solutions
    with compiled.kernels():
        found = sensor.solve_scenes([wild, gentle], TOLERANCE)
    assert found[wild] == pytest.approx(plain, rel=1e-7, abs=1e-9 * np.abs(plain).max())
    assert np.array_equal(found[gentle], small.impedances([gentle])[0])
    assert small.model.factorisations == before[0] + 1
    assert batch.solutions > before[1] + 5


# Work


def test_many_scenes_of_many_bends_share_one_factorisation() -> None:
    never_seen = dataclasses.replace(SensorDesign.reference(), conductivity=0.987)
    sim, some = Simulator(never_seen, COARSE), scenes()[::3]
    found = sim.measure_all([*some, *some])
    assert sim.model.factorisations == 1
    assert np.array_equal(found[: len(some)], found[len(some) :])
    exact = sim.measure_all([*some, *some], tolerance=EXACT)
    assert sim.model.factorisations == 1 + len(some)
    assert exact[: len(some)] == pytest.approx(plainly(sim, some), rel=1e-12)


@pytest.mark.parametrize(("electrodes", "plain"), [(8, False), (5, True), (70, False)])
def test_bytes_do_not_depend_on_neighbours(monkeypatch, electrodes, plain) -> None:
    """Scenes in any order and number, beside quick and slow ones, in any place of a batch."""
    if plain:
        monkeypatch.setattr(compiled, "load_kernels", lambda _: None)
    ring = uniform(SensorDesign.reference().outline, electrodes, min(0.005, 0.2 / electrodes))
    design = dataclasses.replace(SensorDesign.reference(), electrodes=ring)
    sim = Simulator(design, ((2, 2, 1), Grading(2e-3, 8e-3, 3.0)))
    some = [*scenes()[1::2], Scene(Bend(25.0)), Scene(Bend(-3.0)), Scene()]
    together = dict(zip(some, sim.impedances(some), strict=True))
    rng = np.random.default_rng(0)
    for count in (1, 2, len(some)):
        chosen = [some[k] for k in rng.permutation(len(some))[:count]]
        again = sim.impedances(chosen)
        assert [each.tobytes() for each in again] == [together[s].tobytes() for s in chosen]


# Specimens on the mesh of a nominal sensor


def test_specimens_share_a_mesh_and_factors(small) -> None:
    """Signals are those of the specimen's own mesh, within what either mesh leaves."""
    nominal, electrodes = small.design, []
    for k, e in enumerate(small.design.electrodes):
        shift = 1e-3 * (-1) ** k if e.y in (0.0, 0.06) and 0.0 < e.x < 0.15 else 0.0
        z = e.contact_impedance * (1.0 + 0.2 * k)
        electrodes.append(dataclasses.replace(e, x=e.x + shift, contact_impedance=z))
    changed = {"thickness": 0.0052, "conductivity": 1.3 * nominal.conductivity}
    specimen = dataclasses.replace(nominal, electrodes=tuple(electrodes), **changed)
    own, shared, twin = (
        Simulator(specimen, COARSE, Hinge(transition=0.01), nominal=each)
        for each in (None, nominal, nominal)
    )
    some = [Scene(Bend(20.0)), Scene(Bend(-10.0))]
    flat, *bent = shared.measure_all([Scene(), *some]).real
    exact, *plain = own.measure_all([Scene(), *some]).real
    assert flat == pytest.approx(exact, rel=0.03)
    for one, other in zip(bent, plain, strict=True):
        signal = other / exact - 1.0
        assert np.linalg.norm(one / flat - 1.0 - signal) < 0.02 * np.linalg.norm(signal)
    family = shared.sensor_impedances.shared
    assert family is twin.sensor_impedances.shared
    before = family.base.factorisations
    assert np.array_equal(twin.measure_all(some[::-1])[::-1].real, bent)
    beside = impedances_together([(twin, some[::-1]), (shared, some[:1])])
    alone = shared.impedances(some)
    assert np.array_equal(beside[0][::-1], alone)
    assert np.array_equal(beside[1], alone[:1])
    assert family.base.factorisations == before


# Resolutions


def shear_deformation(axis: int) -> Displaced:
    """Simple shear of the whole layer by 45 deg, along x (0) or y (1)."""
    slope = np.zeros((3, 3))
    slope[axis, 2] = 1.0
    return Displaced(
        lambda x: np.asarray(x @ slope.T), lambda x: np.broadcast_to(slope, (*x.shape[:-1], 3, 3))
    )


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


def test_many_scenes_of_two_meshes_are_those_of_one_by_one(monkeypatch) -> None:
    """Light presses stand for those of small indenters, whose dents take minutes to solve."""
    sim = Simulator(SensorDesign.reference(), "coarse")
    fine = ForwardModel(sim.design, ((3, 2, 1), Grading(1.5e-3, 6e-3, 2.0)))
    family = sim.sensor_impedances.own
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


@pytest.mark.parametrize(
    ("order", "size", "cells"),
    [
        ((3, 3, 2, 1), 6e-3, None),
        ((5, 5, 4, 3), 8e-3, None),  # half of it for the products of functions
        ((3, 2, 1), 8e-3, "prisms"),
        ((2,), 6e-3, "tetrahedra"),
    ],
)
def test_the_estimate_is_near_the_memory_that_is_taken(order, size, cells) -> None:
    if cells == "tetrahedra":
        pytest.importorskip("pytetwild")
    resolution = order, Grading(size, size, 1.0)
    ForwardModel(DESIGN, resolution, cells=cells)  # makes and stores its mesh
    tracemalloc.start()
    try:
        model = ForwardModel(DESIGN, resolution, cells=cells)
        model.solver.factorise(model._system(model._conductivity(1.0), None)[1].values)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    most = 1.6 if cells == "tetrahedra" else 1.25
    assert 0.75 * peak < estimated_memory(model.assembly.space) < most * peak
    with pytest.raises(ConfigurationError, match="more than the 8 GB"):
        ForwardModel(DESIGN, ((10,) * 6, Grading(5e-3, 1e-2, 1.0)))


# Kinds of cells


def test_many_electrodes_have_prisms_and_simulators_of_a_design_share_its_mesh():
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
    sim = Simulator(SensorDesign.reference(), "fast")
    family, small = sim.sensor_impedances.own, Touch(0.05, 0.03, indenter=Sphere(0.003))
    wide = [Touch(0.05, 0.03), Touch(0.05, 0.03, indenter=Cylinder(0.01))]
    assert family.model_for_touches([]) is family.model_for_touches(wide) is sim.model
    fine = family.model_for_touches([*wide, small])
    assert len(fine.mesh.cells) > len(sim.model.mesh.cells)
    own = Simulator(SensorDesign.reference(), ((3, 2, 1), Grading(1e-3, 6e-3, 2.0)))
    assert own.sensor_impedances.own.model_for_touches([small]) is own.model


def test_prisms_are_as_exact_as_promised() -> None:
    model = ForwardModel(DESIGN, "fast", cells="prisms")
    layer = DeformedLayer(DESIGN, SCENES[1], Piezoresistivity())
    bent, flat = model.impedance(layer.conductivity, layer.area_ratio), model.impedance()
    pairs, truth = Protocol.pairwise(8), signals(CONVERGED)[1]
    found = (pairs.measure(bent) / pairs.measure(flat)).real - 1.0
    assert np.linalg.norm(found - truth) < 1e-2 * np.linalg.norm(truth)
