"""Reanalysis: what touches change, solved between what they do not, against whole solutions."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Disc, Hinge, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import (
    EXACT,
    Cylinder,
    ForwardModel,
    Mechanics,
    Scene,
    Simulator,
    Tolerance,
    Touch,
)
from eitskin.simulator.electrical.reanalysis import Reanalysis
from eitskin.simulator.layer import pressed_touches
from eitskin.simulator.linalg.block_cholesky import BlockCholesky
from eitskin.simulator.linalg.two_sided_elimination import TwoSidedElimination
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity

from contacts import with_contacts

COARSE = ((2, 2, 1), Grading(2e-3, 8e-3, 3.0))
BEND = Bend(25.0)
PRESSED = Piezoresistivity(volume=0.5, pressure=2e-6)


def touches(count, seed=0, force=8.0):
    """Places that are apart, one touch each."""
    rng = np.random.default_rng(seed)
    places = np.array([[0.02, 0.015], [0.055, 0.04], [0.09, 0.02], [0.13, 0.045]])[:count]
    places = places + rng.uniform(-0.004, 0.004, places.shape)
    return tuple(Touch(float(x), float(y), force) for x, y in places)


def scenes(bend=BEND):
    """One to four touches, at random places."""
    return [Scene(bend=bend, touches=touches(count, count)) for count in (1, 2, 3, 4)] + [
        Scene(bend=bend, touches=(Touch(0.03 + 0.03 * k, 0.02 + 0.006 * k, 5.0 + k),))
        for k in range(4)
    ]


def signals(sim, some, tolerance=None):
    flat = sim.measure(dataclasses.replace(some[0], touches=())).impedance
    return (sim.measure_all(some, tolerance) - flat).real


# Between the ends


def random_tridiagonal(seed=0):
    """A positive definite matrix of uneven strips, as values at places, and columns B."""
    rng = np.random.default_rng(seed)
    sizes = np.array([3, 5, 2, 4, 6, 1, 3])
    strip = rng.permutation(np.repeat(np.arange(len(sizes)), sizes))
    near = np.abs(strip[:, None] - strip) <= 1
    M = np.where(near, rng.normal(size=near.shape), 0.0)
    A = np.where(near, M + M.T, 0.0) + 12.0 * np.eye(len(strip))
    rows, columns = np.nonzero(np.tril(near))
    return A, rows, columns, strip, rng.normal(size=(len(strip), 3))


@pytest.mark.parametrize(("first", "last"), [(0, 6), (0, 0), (6, 6), (2, 4), (0, 3), (4, 6)])
def test_strips_between_the_ends_are_eliminated_as_in_the_whole(first, last) -> None:
    A, rows, columns, strip, B = random_tridiagonal()
    ends = TwoSidedElimination(BlockCholesky(rows, columns, strip), A[rows, columns], B)
    rng = np.random.default_rng(1)
    inside = (strip >= first) & (strip <= last)
    changed = A + np.diag(rng.uniform(1.0, 5.0, len(A)) * inside)
    new_B = np.where(inside[:, None], rng.normal(size=B.shape), B)
    found = ends.congruence(changed[rows, columns], new_B, first, last)
    assert found == pytest.approx(new_B.T @ np.linalg.solve(changed, new_B), rel=1e-12)
    assert ends.factors.solve(B) == pytest.approx(np.linalg.solve(A, B), rel=1e-12, abs=1e-13)


# Whole scenes


@pytest.mark.slow
@pytest.mark.parametrize("bend", [Bend(0.0), BEND])
@pytest.mark.parametrize("piezoresistive", [False, True])
def test_without_tolerance_scenes_are_solved_as_one_by_one(sim, bend, piezoresistive) -> None:
    if piezoresistive:
        sim = Simulator(sim.design, COARSE, mechanics=Mechanics(piezoresistivity=PRESSED))
    found = sim.measure_all(scenes(bend), EXACT)
    plain = np.array([sim.measure(scene).impedance for scene in scenes(bend)])
    assert np.abs(found / plain - 1.0).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("cells", ["prisms", "hexahedra"])
def test_meshes_of_any_kind_fall_into_strips(cells) -> None:
    sim = Simulator(SensorDesign.reference(), COARSE)
    model = ForwardModel(sim.design, COARSE, cells=cells, solver="block Cholesky")
    solved = Reanalysis(model, sim.deformed_layer(Scene()), EXACT)
    for scene in scenes(Bend(0.0))[3:6]:
        setting = sim.deformed_layer(scene)
        plain = model.impedance(setting.conductivity, setting.area_ratio)
        assert solved.impedance(setting) == pytest.approx(plain, rel=1e-11, abs=1e-10)


@pytest.mark.parametrize("z", [1e-7, 1e-3, 10.0])
def test_electrodes_of_any_contact_impedance(z) -> None:
    """Lifted off where contact is good, not where it is poor; both when touches change them."""
    sim = Simulator(with_contacts(z), COARSE)
    near = [Scene(touches=(Touch(x, 0.008, 6.0),)) for x in (0.022, 0.075, 0.128)]
    found, plain = sim.measure_all(near, EXACT), [sim.measure(s).impedance for s in near]
    assert np.abs(found - plain).max() < 1e-12 * np.abs(plain).max()
    flat = sim.measure(Scene()).impedance
    error = np.linalg.norm(sim.measure_all(near) - plain, axis=1)
    assert (error < 0.02 * np.linalg.norm(plain - flat, axis=1)).all()


@pytest.mark.slow
def test_tolerances_leave_less_than_a_percent_of_the_signal(sim) -> None:
    exact = signals(sim, scenes(), EXACT)
    size = np.linalg.norm(exact, axis=1)
    default = np.linalg.norm(signals(sim, scenes()) - exact, axis=1) / size
    assert default.max() < 0.01
    assert np.median(default) < 0.004
    loose = np.linalg.norm(signals(sim, scenes(), Tolerance(0.05, 0.2)) - exact, axis=1) / size
    assert np.median(loose) > 2.0 * np.median(default)


class Graded:
    """A conductivity and electrode areas that change along x and y by a part of themselves."""

    def __init__(self, part):
        self.part = part

    def entries(self, x):
        change = self.part * (x[..., 0] / 0.15 - x[..., 1] / 0.12)
        unit = np.array([1.0, 1.0, 1.0, 0.2, 0.0, 0.1])
        return (1.0 + change)[..., None] * unit

    def conductivity(self, x):
        return self.entries(x)[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]

    def area_ratio(self, x, normal):
        del normal
        return 1.0 + self.part * (0.5 - x[..., 0] / 0.15)


def test_what_is_left_out_is_of_second_order(sim) -> None:
    solved = Reanalysis(sim.model, Graded(0.0), Tolerance(0.9, 0.9))
    errors, changes = [], []
    for part in (0.02, 0.04):
        changed = Graded(part)
        exact = sim.model.impedance(changed.conductivity, changed.area_ratio)
        errors.append(np.abs(solved.impedance(changed) - exact).max())
        changes.append(np.abs(exact - solved.base).max())
    assert solved.strips == 2 * len(sim.model.solver.block_rows)
    # Not quite 4, since the first order is integrated by the coarse rule.
    assert errors[1] / errors[0] == pytest.approx(4.0, rel=0.15)
    assert errors[1] < 0.05 * changes[1]


# Work


def test_one_bend_is_factorised_once_and_touches_cost_their_strips() -> None:
    sim = Simulator(SensorDesign.reference(), COARSE)
    some = scenes()
    base = Scene(bend=BEND)
    sim.measure_all([*some, *some, base])
    assert sim.model.factorisations == 1
    solved = Reanalysis(sim.model, sim.deformed_layer(base))
    strips = len(sim.model.solver.block_rows)
    assert (solved.strips, solved.resolved) == (2 * strips, 0)
    solved.impedance(sim.deformed_layer(Scene(bend=BEND, touches=(Touch(0.02, 0.03, 6.0),))))
    assert 0 < solved.strips - 2 * strips < 0.6 * strips
    assert 0 < solved.resolved < 0.4 * len(sim.model.assembly.space.numbers)
    before = solved.strips, solved.resolved
    assert solved.impedance(sim.deformed_layer(base)) == pytest.approx(solved.base, abs=1e-9)
    assert (solved.strips, solved.resolved) == before


def test_few_touches_of_a_bend_are_solved_one_by_one(sim) -> None:
    before = sim.model.factorisations
    some = [Scene(bend=Bend(a), touches=touches(1)) for a in (-7.0, 3.0, 9.0)]
    found = sim.measure_all([*some, some[0]])
    assert sim.model.factorisations == before + 3
    assert np.array_equal(found[0], found[3])
    assert np.array_equal(found[1], sim.measure(some[1]).impedance)


def test_each_solution_can_be_stopped(sim) -> None:
    class Stop(Exception):  # noqa: N818
        pass

    calls = []

    def stop():
        calls.append(None)
        if len(calls) == 3:
            raise Stop

    with pytest.raises(Stop):
        sim.measure_all(scenes(), before_each=stop)


# Refusals


@pytest.mark.slow
def test_other_solvers_and_complex_contacts_are_refused_but_simulated(monkeypatch) -> None:
    sim = Simulator(with_contacts(1e-3 - 2e-4j), COARSE)
    with pytest.raises(ConfigurationError, match="real contact impedances"):
        Reanalysis(sim.model, sim.deformed_layer(Scene()))
    some = scenes()[:4]
    plain = [sim.measure(scene).impedance for scene in some]
    assert np.array_equal(sim.measure_all(some), plain)
    round_sensor = SensorDesign(Disc(0.04), 0.005, uniform(Disc(0.04), 8, 0.005))
    # Dents serve here, without their corrections, which take seconds each on a disc.
    uncorrected = lambda pressed, *_: ((), (0.0,) * len(pressed))  # noqa: E731
    monkeypatch.setattr(pressed_touches, "_corrected", uncorrected)
    disc = Simulator(round_sensor, fixture=Hinge(span=0.02), resolution="fast")
    pressed = [Scene(touches=(Touch(0.04 + 0.01 * k, 0.04, 5.0, Cylinder()),)) for k in range(3)]
    alone = [disc.measure(scene).impedance for scene in pressed]
    assert disc.measure_all(pressed, EXACT) == pytest.approx(np.array(alone), rel=1e-11)


@pytest.mark.parametrize(("linear", "coarse"), [(-0.1, 0.1), (0.2, 0.1), (0.1, 1.0)])
def test_tolerances_that_cannot_be_are_refused(linear, coarse) -> None:
    with pytest.raises(ConfigurationError, match="linear <= coarse"):
        Tolerance(linear, coarse)
