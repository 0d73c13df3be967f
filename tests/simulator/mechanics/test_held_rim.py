"""Presses in the middle of round membranes: plate, slack membrane, stretched membrane."""

import elastic_forms
import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.simulator import Cylinder, Sphere
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress, HeldRim
from eitskin.simulator.mechanics.layer_stack import Sheet, Stack
from eitskin.simulator.mechanics.materials import NeoHookean

MU = 20e3
TIP = Sphere(0.001, rough=False)


def held(thickness, rim, bulk_ratio=1e4, indenter=TIP, finest=2e-4):
    stack = Stack((Sheet(thickness, NeoHookean(MU)),), bulk_ratio)
    return AxisymmetricPress(stack, indenter, finest, (0.0, indenter.rims[1]), rim=rim)


def falls(found, radii):
    """Downward displacements in the middle of the height at the nodes nearest to `radii`."""
    nearest = np.abs(found.r[:, None] - radii).argmin(axis=0)
    row = np.abs(found.z - 0.5 * found.stack.levels[-1]).argmin()
    return found.r[nearest], -found.displacement[nearest, row, 1]


def test_small_presses_bend_the_sheet_as_a_clamped_plate() -> None:
    found = held(0.0008, HeldRim(0.02)).to_depth(2e-5)
    rigidity, _ = elastic_forms.plate_stiffnesses(((0.0008, MU),))
    expected = elastic_forms.clamped_disc_deflection(0.02, rigidity, found.force)
    assert -found.displacement[0, 0, 1] == pytest.approx(expected, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [0.001, 0.002])
def test_deep_presses_stretch_the_sheet_as_a_slack_membrane(depth) -> None:
    """Ten and twenty times deeper than the sheet is thick, with nu = 1/3."""
    found = held(1e-4, HeldRim(0.02), bulk_ratio=8.0 / 3.0).to_depth(depth)
    r, w = falls(found, np.array([0.002, 0.005, 0.010]))
    expected = elastic_forms.slack_disc_deflection(r, 0.02, 1e-4, MU, found.force)
    assert w == pytest.approx(expected, rel=0.045 if depth < 0.0015 else 0.03)


@pytest.mark.parametrize("stretch", [1.05, 1.2])
def test_small_presses_of_a_stretched_sheet_are_those_of_a_taut_membrane(stretch) -> None:
    found = held(2e-4, HeldRim(0.02, stretch)).to_depth(1e-4)
    r, w = falls(found, np.array([0.002, 0.005, 0.010]))
    tension = elastic_forms.equibiaxial_tension(((2e-4, MU),), stretch)
    rigidity, _ = elastic_forms.plate_stiffnesses(((2e-4, MU),))
    # Distances scale with the stretch, and their ratios do not; the sheet has become thinner.
    sunk = 0.5 * 2e-4 * (1.0 - stretch**-2)
    expected = elastic_forms.taut_disc_deflection(r, 0.02, tension, rigidity, found.force)
    assert w + sunk == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
def test_a_rough_punch_on_a_stretched_sheet_holds_it_where_it_is() -> None:
    """At a touch without depth, nothing but the stretch has moved the sheet."""
    press = held(0.001, HeldRim(0.02, 1.1), indenter=Cylinder(0.002, edge=0.2))
    found = press.to_depth(1e-5)
    middle = np.abs(found.r - 0.01).argmin()
    assert found.displacement[middle, 0, 0] == pytest.approx(0.1 * found.r[middle], rel=0.01)
    # Without a base, the sheet gives way long before it thins.
    thinning = found.thinning(0)
    assert thinning == pytest.approx(1.0 - 1.1**-2, rel=0.02)


@pytest.mark.slow
def test_a_membrane_is_pressed_deeper_than_it_is_thick() -> None:
    """The gelatin sheet of 3 mm, 160 mm across, 20 mm deep by a tip of 5 mm."""
    stack = Stack((Sheet(0.003, NeoHookean(MU)),))
    tip = Sphere(0.0025)
    slack = AxisymmetricPress(stack, tip, finest=4e-4, rim=HeldRim(0.080))
    forces = np.array([slack.to_depth(d).force for d in (0.001, 0.010, 0.020)])
    # From a plate, linear in the depth, towards a membrane, in which force is its cube.
    assert forces[0] == pytest.approx(16 * np.pi * 1.8e-4 / 0.080**2 * 0.001, rel=0.03)
    assert 3.5 < forces[2] / forces[1] < 8.0
    assert forces[2] == pytest.approx(0.294, rel=0.02)
    J = slack.solid.volume_ratio(slack.unknowns)
    assert J == pytest.approx(np.ones_like(J), abs=0.05)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: HeldRim(80.0), "rim radius.*80 m"),
        (lambda: HeldRim(0.08, 0.9), "stretch of a held rim must be from 1 to 2, got 0.9"),
        (lambda: HeldRim(0.08, float("nan")), "got nan"),
    ],
)
def test_impossible_rims_are_refused(make, says) -> None:
    with pytest.raises(ConfigurationError, match=says):
        make()
