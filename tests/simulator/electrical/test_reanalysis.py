"""Reanalysis: scenes by Galerkin projection on another scene's factors, against whole solutions."""

import dataclasses
from itertools import islice, pairwise

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Hinge, SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import EXACT, ForwardModel, Mechanics, Scene, Simulator, Touch
from eitskin.simulator.electrical.reanalysis import Reanalysis
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


def test_signals_of_touches_are_off_by_less_than_a_thousandth(small) -> None:
    pressed = Simulator(small.design, COARSE, mechanics=PRESSED)
    assert signal_errors(pressed, scenes()[::2]).max() < 1e-3


def test_a_smaller_tolerance_leaves_a_smaller_error(small) -> None:
    some = scenes()[::5]
    default = signal_errors(small, some)
    assert signal_errors(small, some, tolerance=1e-8).max() < 1e-6 < default.max()
    assert small.measure_all(some, tolerance=EXACT) == pytest.approx(
        plainly(small, some), rel=1e-12
    )


@pytest.mark.parametrize("z", [1e-7, 10.0])
def test_electrodes_of_any_contact_impedance(z) -> None:
    """In the form of the flat sensor, which is the lifted one where contact is good."""
    sim = Simulator(with_contacts(z), COARSE)
    near = [Scene(Bend(15.0), (Touch(x, 0.008, 6.0),)) for x in (0.022, 0.075, 0.128)]
    assert signal_errors(sim, near).max() < 1e-3
    assert signal_errors(sim, near, tolerance=1e-8).max() < 1e-6


@pytest.mark.parametrize(
    ("cells", "solver"), [("prisms", "block Cholesky"), ("hexahedra", "nested dissection")]
)
def test_meshes_and_solvers_of_any_kind(small, cells, solver) -> None:
    model = ForwardModel(small.design, COARSE, cells=cells, solver=solver)
    flat = small.deformed_layer(Scene())
    solved = Reanalysis(model, flat)
    assert solved.base == pytest.approx(model.impedance(), rel=1e-10, abs=1e-9)
    for scene in (Scene(touches=touches(2)), Scene(Bend(30.0), touches(1))):
        layer = small.deformed_layer(scene)
        plain = model.impedance(layer.conductivity, layer.area_ratio)
        change = np.linalg.norm(plain - solved.base)
        assert np.linalg.norm(solved.impedance(layer) - plain) < 3e-4 * change
        assert np.linalg.norm(solved.impedance(layer, 1e-8) - plain) < 1e-7 * change


class Layer:
    """Layer of a conductivity `sigma` (n, 3) -> (n,) and flat electrodes."""

    contact_impedance = SensorDesign.reference().contact_impedance

    def __init__(self, sigma):
        self.sigma = sigma

    def entries(self, x):
        return self.sigma(x)[..., None] * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])

    def conductivity(self, x):
        return self.sigma(x)[..., None, None] * np.eye(3)

    def area_ratio(self, x, normal):
        del normal
        return np.ones(x.shape[:-1])


def test_each_correction_takes_away_most_of_the_error(small) -> None:
    solved = Reanalysis(small.model, Layer(lambda x: np.ones(x.shape[:-1])))
    changed = Layer(lambda x: 1.0 + 0.5 * np.sin(60.0 * x[..., 0]) * np.cos(90.0 * x[..., 1]))
    plain = small.model.impedance(changed.conductivity, changed.area_ratio)
    found = islice(solved.approximations(changed), 4)
    errors = [np.linalg.norm(each.impedance - plain) for each in found]
    # By the square of the part that the conductivity changes by, which is a half at most.
    assert all(after < 0.25 * before for before, after in pairwise(errors))


def test_a_scene_that_differs_too_much_is_solved_by_itself(small) -> None:
    strange = Layer(lambda x: np.where(np.sin(200.0 * x[..., 0] + 130.0 * x[..., 1]) > 0, 1.0, 1e6))
    plain = small.model.impedance(strange.conductivity, strange.area_ratio)
    solved = Reanalysis(small.model, small.deformed_layer(Scene()))
    before = small.model.factorisations, solved.solutions
    found = solved.impedance(strange)
    assert found == pytest.approx(plain, rel=1e-7, abs=1e-9 * np.abs(plain).max())
    assert small.model.factorisations == before[0] + 1
    assert solved.solutions > before[1] + 3


# Work


@pytest.mark.slow
def test_many_scenes_of_many_bends_share_one_factorisation() -> None:
    never_seen = dataclasses.replace(SensorDesign.reference(), conductivity=0.987)
    sim = Simulator(never_seen, COARSE)
    some = scenes()[::3]
    found = sim.measure_all([*some, *some])
    assert sim.model.factorisations == 1
    assert np.array_equal(found[: len(some)], found[len(some) :])
    sim.measure_all([*some, Scene(Bend(31.0))])
    assert sim.model.factorisations == 1
    alone = Simulator(never_seen, COARSE)
    assert alone.model is sim.model
    alone.measure_all([*some, *some], tolerance=EXACT)
    assert alone.model.factorisations == 1 + len(some)


def test_one_or_two_touches_take_two_or_three_solutions_with_the_factors(small) -> None:
    solved = Reanalysis(small.model, small.deformed_layer(Scene()))
    assert solved.solutions == 1
    for scene in scenes()[::2]:
        before = solved.solutions
        solved.impedance(small.deformed_layer(scene))
        most = 3 if len(scene.touches) < 3 else 5
        assert 2 <= solved.solutions - before <= most
    before = solved.solutions
    flat = solved.impedance(small.deformed_layer(Scene()))
    assert flat == pytest.approx(solved.base, abs=1e-10 * np.abs(solved.base).max())
    assert solved.solutions == before + 1


def test_a_scene_does_not_depend_on_the_others(small) -> None:
    some = [*scenes()[::5], Scene(Bend(25.0)), Scene()]
    together = small.measure_all(some)
    backwards = Simulator(small.design, COARSE).measure_all(some[::-1])[::-1]
    alone = [Simulator(small.design, COARSE).measure_all([scene])[0] for scene in some[::2]]
    assert together.tobytes() == np.ascontiguousarray(backwards).tobytes()
    assert together[::2].tobytes() == np.array(alone).tobytes()


# Refusals


def test_complex_contacts_are_refused_but_simulated() -> None:
    sim = Simulator(with_contacts(1e-3 - 2e-4j), COARSE)
    with pytest.raises(ConfigurationError, match="real contact impedances"):
        Reanalysis(sim.model, sim.deformed_layer(Scene()))
    some = scenes()[:2]
    assert sim.measure_all(some) == pytest.approx(plainly(sim, some), rel=1e-12)


# Specimens on the mesh of a nominal sensor


def test_specimens_share_a_mesh_and_factors(small) -> None:
    """Signals are those of the specimen's own mesh, within what either mesh leaves."""
    nominal = small.design
    electrodes = tuple(
        dataclasses.replace(
            e,
            x=e.x + (1e-3 if e.y in (0.0, 0.06) and 0.0 < e.x < 0.15 else 0.0) * (-1) ** k,
            contact_impedance=e.contact_impedance * (1.0 + 0.2 * k),
        )
        for k, e in enumerate(nominal.electrodes)
    )
    specimen = dataclasses.replace(
        nominal, electrodes=electrodes, thickness=0.0052, conductivity=1.3 * nominal.conductivity
    )
    smooth = Hinge(transition=0.01)
    own = Simulator(specimen, COARSE, smooth)
    shared = Simulator(specimen, COARSE, smooth, nominal=nominal)
    twin = Simulator(specimen, COARSE, smooth, nominal=nominal)
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
