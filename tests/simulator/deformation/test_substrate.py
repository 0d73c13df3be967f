"""Presses of a sensor on a soft substrate: order of the layers, limits, and linear elasticity."""

import dataclasses

import elastic_forms
import numpy as np
import pytest

from eitskin.geometry import Rigid, SensorDesign, Substrate, Support
from eitskin.simulator import Cylinder, Mechanics
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, StackGrid
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Indentation, Sheet, Stack
from eitskin.simulator.mechanics.materials import NeoHookean

DESIGN = SensorDesign.reference()
SOFT = Substrate(0.010, 5e3)
COARSE = Cylinder().radius / 8


def on(support: Support) -> Stack:
    return Mechanics().stack(dataclasses.replace(DESIGN, support=support))


def pressed(stack: Stack, force: float, indenter: Cylinder | None = None) -> Indentation:
    return AxisymmetricPress(stack, indenter or Cylinder(), COARSE).to_force(force)


def test_a_substrate_is_the_lowest_layer() -> None:
    found, rigid = on(SOFT), on(Rigid())
    assert found.sheets == (Sheet(0.010, NeoHookean(5e3)), *rigid.sheets)
    assert (found.gel, rigid.gel) == (2, 1)
    bare = dataclasses.replace(DESIGN, encapsulated_thickness=0.005)
    assert Mechanics().stack(bare).gel == 0
    assert Mechanics().stack(dataclasses.replace(bare, support=SOFT)).gel == 1


def test_a_very_stiff_substrate_is_a_rigid_base() -> None:
    rigid, stiff = pressed(on(Rigid()), 3.0), pressed(on(Substrate(0.010, 28e6)), 3.0)
    assert stiff.depth == pytest.approx(rigid.depth, rel=0.01)
    assert stiff.thinning(2) == pytest.approx(rigid.thinning(1), rel=0.01)
    assert abs(stiff.thinning(0)) < 5e-4


@pytest.mark.parametrize("support", [SOFT, Substrate(0.030, 300.0), Substrate(0.005, 1e6)])
def test_small_presses_are_those_of_linear_layers(support) -> None:
    """Smooth punch: its own pressure on the layers by Hankel transform gives its displacements."""
    stack, force = on(support), 1e-3
    found = pressed(stack, force, Cylinder(rough=False))
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
