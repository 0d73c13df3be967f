"""Grids of solved sensors in files of old and new form, and presses on soft substrates."""

import dataclasses

import elastic_forms
import numpy as np
import pytest

from eitskin.config import to_toml
from eitskin.datasets import Recipe
from eitskin.errors import ConfigurationError
from eitskin.geometry import Clamp, Rigid, SensorDesign, Substrate, Support
from eitskin.simulator import Cylinder, Mechanics, SensorGrid
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, StackGrid, read_fixed
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Sheet, Stack
from eitskin.simulator.mechanics.materials import NeoHookean

GRID = SensorGrid(0.005, 1.4, 0.04, 0.008)


def test_files_of_version_02_are_read_with_their_grid(tmp_path) -> None:
    fixture, mechanics = tmp_path / "fixture.toml", tmp_path / "mechanics.toml"
    fixture.write_text("span = 0.041\nsolved_span = 0.04\nsolved_offset = 0.008\n")
    mechanics.write_text("margin = 0.004\nsolved_thickness = 0.005\nsolved_ratio = 1.4\n")
    assert read_fixed(fixture, mechanics) == (Clamp(0.041), Mechanics(margin=0.004), GRID)
    assert read_fixed(None, None) == (Clamp(), Mechanics(), SensorGrid())
    mechanics.write_text(f"{to_toml(Mechanics())}\n[grid]\n{to_toml(GRID)}")
    assert read_fixed(None, mechanics) == (Clamp(), Mechanics(), GRID)
    mechanics.write_text("[grid]\nratio = 0.0\n")
    with pytest.raises(ConfigurationError, match="ratio"):
        read_fixed(None, mechanics)


def test_recipes_of_version_02_are_read_with_their_grid(tmp_path) -> None:
    path = tmp_path / "old.toml"
    path.write_text(
        'name = "old"\nscenes = [{ state = "idle", count = 1 }]\n'
        "[fixture]\nspan = 0.041\nsolved_span = 0.04\n[mechanics]\nsolved_thickness = 0.005\n"
    )
    recipe = Recipe.from_toml(path)
    assert recipe.grid == SensorGrid(thickness=0.005, span=0.04)
    made = recipe.nominal(0)
    assert (made.fixture, made.grid) == (Clamp(0.041), GRID)
    path.write_text(recipe.to_toml())
    assert Recipe.from_toml(path) == recipe
    for old in (lambda: Mechanics(solved_thickness=0.005), lambda: Clamp(solved_span=0.04)):
        with pytest.warns(DeprecationWarning, match="SensorGrid"):
            assert old() in (Mechanics(), Clamp())


DESIGN = SensorDesign.reference()
SOFT = Substrate(0.010, 5e3)


def on(support: Support) -> Stack:
    return Mechanics().stack(dataclasses.replace(DESIGN, support=support))


def test_a_substrate_is_the_lowest_layer() -> None:
    found, rigid = on(SOFT), on(Rigid())
    assert found.sheets == (Sheet(0.010, NeoHookean(5e3)), *rigid.sheets)
    assert (found.gel, rigid.gel) == (2, 1)
    bare = dataclasses.replace(DESIGN, encapsulated_thickness=0.005)
    assert Mechanics().stack(bare).gel == 0
    assert Mechanics().stack(dataclasses.replace(bare, support=SOFT)).gel == 1


@pytest.mark.parametrize("support", [SOFT, Substrate(0.005, 1e6)])
def test_small_presses_are_those_of_linear_layers(support) -> None:
    """Smooth punch: its own pressure on the layers by Hankel transform gives its displacements."""
    stack, force = on(support), 1e-3
    found = AxisymmetricPress(stack, Cylinder(rough=False), 0.0075 / 8).to_force(force)
    sheets = [(sheet.thickness, sheet.law.shear_modulus) for sheet in stack.sheets]
    acting = np.trapezoid(2.0 * np.pi * found.radii * found.pressure, found.radii)
    heights = stack.levels[1:3]
    expected = elastic_forms.layered_deflection(
        sheets, heights, 0.0075, found.radii, found.pressure * force / acting
    )
    rows = np.searchsorted(found.z, np.array(heights) - 1e-9)
    assert -found.displacement[0, rows, 1] == pytest.approx(expected, rel=0.01)


def test_tables_between_solved_moduli_of_the_substrate_are_interpolated() -> None:
    """By four of them; the weights add up to one and reproduce a cubic."""
    design = dataclasses.replace(DESIGN, support=Substrate(0.010, 6e3))
    needed = list(StackGrid.from_design(design, Mechanics(), OWN_GRID).full_weights())
    moduli = [stack.sheets[0].law.shear_modulus for stack, _ in needed]
    assert moduli == pytest.approx([20e3 * 2.0 ** (k / 2) for k in (-5, -4, -3, -2)])
    assert all(stack.sheets[1:] == on(Rigid()).sheets for stack, _ in needed)
    for power in range(4):
        found = sum(np.log(mu) ** power * w for mu, (_, w) in zip(moduli, needed, strict=True))
        assert found == pytest.approx(np.log(6e3) ** power, rel=1e-9)
