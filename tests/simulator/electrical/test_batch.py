"""Scenes by Galerkin projection on the flat sensor's factors, against whole solutions."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest

from eitskin import compiled
from eitskin.geometry import Bend, Hinge, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import EXACT, ForwardModel, Mechanics, Scene, Simulator, Touch
from eitskin.simulator.electrical.batch import TOLERANCE, BatchSolver, LayerFields
from eitskin.simulator.electrical.sensor_impedances import SensorImpedances
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity

from contacts import with_contacts

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


@pytest.mark.slow
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
    fields = [LayerFields.from_layer(layer, solver.model.assembly)]
    return solver.solve(fields, layer.contact_impedance, solver.base, tolerance)[0].impedance


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

    def entries(self, x):
        return self.sigma(x)[..., None] * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])

    def conductivity(self, x):
        return self.sigma(x)[..., None, None] * np.eye(3)

    def area_ratio(self, x, normal):
        del normal
        return np.ones(x.shape[:-1])


def test_each_correction_takes_away_most_of_the_error(small) -> None:
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


def test_a_scene_that_differs_too_much_is_solved_by_itself(small) -> None:
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


@pytest.mark.slow
def test_many_scenes_of_many_bends_share_one_factorisation() -> None:
    never_seen = dataclasses.replace(SensorDesign.reference(), conductivity=0.987)
    sim, some = Simulator(never_seen, COARSE), scenes()[::3]
    found = sim.measure_all([*some, *some])
    assert sim.model.factorisations == 1
    assert np.array_equal(found[: len(some)], found[len(some) :])
    exact = sim.measure_all([*some, *some], tolerance=EXACT)
    assert sim.model.factorisations == 1 + len(some)
    assert exact[: len(some)] == pytest.approx(plainly(sim, some), rel=1e-12)


@pytest.mark.parametrize(
    ("electrodes", "plain"),
    [(8, False), (5, True), pytest.param(70, False, marks=pytest.mark.slow)],
)
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
    family = shared._impedances._shared
    assert family is twin._impedances._shared
    before = family.base.factorisations
    assert np.array_equal(twin.measure_all(some[::-1])[::-1].real, bent)
    assert family.base.factorisations == before
