"""Tabulated presses against presses, and where they are kept."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import SensorDesign
from eitskin.simulator import Cylinder, Mechanics
from eitskin.simulator.deformation import press_table as tables
from eitskin.simulator.deformation import solution_store
from eitskin.simulator.deformation.dents import Dents, PlacedDent
from eitskin.simulator.deformation.press_table import (
    PressTable,
    load_press_table,
    press_problems,
    press_table,
)
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.materials import NeoHookean

DESIGN = SensorDesign.reference()
REFERENCE = Mechanics()


@pytest.fixture(scope="module")
def table() -> PressTable:
    return press_table(DESIGN, REFERENCE, Cylinder())


def disc(dent, n=40):
    """Points (r, z) of the layer within the dent's reach, a little off its faces."""
    r, z = np.meshgrid(np.linspace(1e-4, 0.9 * dent.reach, n), np.linspace(2e-4, 4.8e-3, 9))
    return r.ravel(), z.ravel()


@pytest.mark.slow
def test_between_tabulated_depths_dents_are_those_of_a_press(table) -> None:
    stack = REFERENCE.stack(DESIGN)
    press = AxisymmetricPress(stack, Cylinder(), finest=0.0075 / 40)
    dent, pressed = table.dent_from_depth(9e-4), press.to_depth(9e-4)
    assert dent.force == pytest.approx(pressed.force, rel=0.01)
    assert dent.thinning == pytest.approx(pressed.thinning(1), rel=0.002)
    in_gel = (pressed.z > 0.0035 - 1e-9) & (pressed.z < 0.0085 + 1e-9)
    r, z = np.meshgrid(pressed.r, pressed.z[in_gel] - 0.0035, indexing="ij")
    near = r < dent.reach
    u = moved(dent, r[near], z[near])[:2].T
    solved = pressed.displacement[:, in_gel][near]
    assert u == pytest.approx(solved, abs=0.004 * np.abs(solved).max())
    # A stack relaxes by shares that differences of moduli give as well.
    soft, hard = (
        AxisymmetricPress(
            dataclasses.replace(REFERENCE, gel=NeoHookean(mu)).stack(DESIGN),
            Cylinder(),
            finest=2e-3,
        ).to_depth(9e-4)
        for mu in (19e3, 21e3)
    )
    assert dent.share == pytest.approx(np.log(hard.force / soft.force) / np.log(21 / 19), abs=0.01)


def moved(dent, r, z):
    """u, w, du/dz, dw/dz, du/dr and dw/dr at places by themselves, (6, n)."""
    return dent.motion(r, z[:, None])[..., 0].T


@pytest.mark.parametrize("force", [0.1, 20.0])
def test_a_dent_keeps_volume_and_is_found_by_force_and_by_depth(table, force) -> None:
    dent = table.dent_from_force(force)
    assert table.dent_from_depth(dent.depth).force == pytest.approx(force, rel=1e-9)
    r, z = disc(dent)
    u, _, shear, stretch, radial, tilt = moved(dent, r, z)
    J = (1 + u / r) * ((1 + radial) * (1 + stretch) - shear * tilt)
    assert J == pytest.approx(np.ones(len(J)), abs=2e-3 * max(1.0, force / 10))
    assert np.sqrt(np.mean((J - 1) ** 2)) < 3e-4 * max(1.0, force / 10)


def test_strains_are_derivatives_of_displacements(table) -> None:
    dent, step = table.dent_from_force(7.0), 1e-7
    r, z = disc(dent)
    _, _, shear, stretch, radial, tilt = moved(dent, r, z)
    along = moved(dent, r + step, z)[:2] - moved(dent, r - step, z)[:2]
    upward = moved(dent, r, z + step)[:2] - moved(dent, r, z - step)[:2]
    assert along / (2 * step) == pytest.approx(np.stack([radial, tilt]), abs=1e-6)
    assert upward / (2 * step) == pytest.approx(np.stack([shear, stretch]), abs=1e-6)


def test_points_above_each_other_are_as_points_one_by_one(table) -> None:
    forces = {(0.05, 0.02): 9.0, (0.08, 0.03): 4.0}
    dents = Dents(tuple(PlacedDent(*at, table.dent_from_force(f)) for at, f in forces.items()))
    places = np.random.default_rng(2).uniform((0.03, 0.01), (0.12, 0.05), (30, 2))
    columns = np.empty((30, 4, 3))
    columns[..., :2], columns[..., 2] = places[:, None], (0.0, 0.001, 0.0032, 0.005)
    for field in (dents.gradient, dents.positions, dents.mean_stress):
        together, apart = field(columns), field(columns.reshape(-1, 3))
        assert np.concatenate(together) == pytest.approx(apart, rel=1e-12)
    axis, beside = dents.gradient(np.array([[0.05, 0.02, 0.002], [0.05 + 1e-7, 0.02, 0.002]]))
    assert axis == pytest.approx(beside, abs=1e-4)


def test_pressure_falls_from_the_axis_to_nothing(table) -> None:
    dent = table.dent_from_force(10.0)
    under, far = dent.mean_stress(np.array([0.0, 0.03]), np.full((2, 1), 0.0025))[:, 0]
    mean = -10.0 / (np.pi * dent.contact_radius**2)
    assert 2.0 * mean < under < 0.3 * mean
    assert abs(far) < 0.02 * abs(under)


# Between and beyond


def test_kernels_between_stiffness_ratios_are_interpolated(table, monkeypatch) -> None:
    """By four of them; here of a law in the ratio that a cubic in its logarithm does not meet."""

    def scaled(stack, _):
        ratio = stack.sheets[0].law.shear_modulus / stack.sheets[1].law.shear_modulus
        return dataclasses.replace(table, forces=table.forces * ratio**0.6)

    monkeypatch.setattr(tables, "load_press_table", scaled)
    mechanics = Mechanics(gel=NeoHookean(13e3))
    found = press_table.__wrapped__(DESIGN, mechanics, Cylinder())
    assert found.forces == pytest.approx(table.forces * (28 / 13) ** 0.6, rel=2e-4)
    assert found.moved == pytest.approx(table.moved, abs=1e-12)


def test_kernels_scale_with_lengths_and_moduli(table) -> None:
    big = dataclasses.replace(DESIGN, thickness=2 * DESIGN.thickness, encapsulated_thickness=0.024)
    hard = Mechanics(gel=NeoHookean(60e3), encapsulation=NeoHookean(84e3))
    found = press_table(big, hard, Cylinder(0.015))
    assert found.forces == pytest.approx(12 * table.forces, rel=1e-12)
    assert found.knots == pytest.approx(2 * table.knots, rel=1e-12)
    dent, twice = table.dent_from_force(5.0), found.dent_from_force(60.0)
    assert twice.depth == pytest.approx(2 * dent.depth, rel=1e-9)
    assert twice.peak_pressure == pytest.approx(3 * dent.peak_pressure, rel=1e-9)


@pytest.mark.parametrize("wrong", [0.0, 1e3, float("nan")])
def test_forces_beyond_the_table_are_refused(table, wrong) -> None:
    for find in (table.dent_from_force, table.dent_from_depth):
        with pytest.raises(ConfigurationError, match=r"(force|depth).*above 0"):
            find(wrong)


# Where they are kept


def test_what_a_table_depends_on_gives_it_another_name() -> None:
    def names(indenter=Cylinder(), **mechanics):  # noqa: B008
        (problem,) = press_problems(DESIGN, Mechanics(**mechanics), indenter)
        return problem.name

    indenters = Cylinder(), Cylinder(rough=False), Cylinder(0.006), Cylinder(edge=0.1)
    assert len({*map(names, indenters), names(bulk_ratio=1e3)}) == 5
    assert names(margin=0.002) == names()


def test_tables_that_are_not_stored_are_solved_at_their_own_size(
    table, tmp_path, monkeypatch
) -> None:
    solved = []
    monkeypatch.setattr(tables, "solve_table", lambda *of: solved.append(of) or table)
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    monkeypatch.setattr(solution_store, "LIBRARY", tmp_path / "nothing ships")
    stacks = [Mechanics(NeoHookean(k * 20e3), NeoHookean(k * 28e3)).stack(DESIGN) for k in (1, 2)]
    first, harder = (load_press_table(stack, Cylinder()) for stack in stacks)
    assert [(stack, layer) for stack, layer, _ in solved] == [(stacks[0], 1)]
    for field in dataclasses.fields(PressTable):
        assert getattr(first, field.name) == pytest.approx(getattr(table, field.name))
    assert harder.forces == pytest.approx(2.0 * table.forces)
