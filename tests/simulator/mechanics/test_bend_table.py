"""Bends between the solved ones against solving them."""

import math

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Hinge
from eitskin.simulator.mechanics.bend_3d import ClampedStack
from eitskin.simulator.mechanics.bend_table import BendTable

from clamped_stack import COARSE, plain

X = np.random.default_rng(1).uniform([0.025, 0.0, 0.0], [0.075, 0.020, 0.010], (500, 3))


@pytest.fixture(scope="module")
def stack():
    design, materials = plain(0.100, 0.020, 0.010)
    return ClampedStack(design, Hinge(0.040), materials, COARSE, inside=0.010)


@pytest.fixture(scope="module")
def table(stack):
    return BendTable.of(stack, [-20.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0])


@pytest.mark.parametrize("angle", [-15.0, 5.0, 25.0])
def test_bends_between_the_solved_ones(stack, table, angle) -> None:
    (direct,) = stack.equilibria([angle])
    between = table.at(angle)
    assert between.positions(X) == pytest.approx(direct.positions(X), abs=5e-6)
    size = np.abs(direct.gradient(X) - np.eye(3)).max()
    assert between.gradient(X) == pytest.approx(direct.gradient(X), abs=5e-3 * size)
    assert between.energy == pytest.approx(direct.energy, rel=5e-3)
    assert between.moment == pytest.approx(direct.moment, rel=2e-2)
    # Outside what was solved the arms turn by exactly the angle asked for.
    end = between.gradient(np.array([0.095, 0.010, 0.005]))
    assert end[0, 0] == pytest.approx(math.cos(math.radians(angle / 2)), abs=1e-12)


def test_solved_bends_and_the_flat_one_are_met(table) -> None:
    for bent in table.solved:
        assert table.at(bent.angle_deg).positions(X) == pytest.approx(bent.positions(X), abs=1e-12)
    assert table.at(0.0).positions(X) == pytest.approx(X, abs=1e-12)
    assert [bent.angle_deg for bent in table.solved] == [-20, -10, 0, 10, 20, 30, 40]


def test_angles_outside_the_table_are_refused(stack, table) -> None:
    for angle in (40.1, math.nan):
        with pytest.raises(ConfigurationError, match="from -20 to 40 deg"):
            table.at(angle)
    with pytest.raises(ConfigurationError, match="four angles"):
        BendTable.of(stack, [10.0, 20.0, 30.0, 40.0])
