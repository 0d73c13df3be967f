"""Reference solutions of presses, by NGSolve."""

import pytest

from eitskin.benchmarks.pressed_reference import ReferenceStack
from eitskin.benchmarks.reference_solid import Numerics
from eitskin.benchmarks.world import cases

pytest.importorskip("ngsolve", reason="needs the extra `reference` (NGSolve)")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["75_30_2N", "plates_75_30_2N_20deg"])
def test_coarse_presses_are_as_deep_as_published(name):
    (case,) = (each for each in cases() if each.name == name)
    stack = ReferenceStack(case, Numerics(order=2, path=2, rim=5.0, inside=6.0, far=16.0, steps=3))
    stack.solve()
    assert stack.depths[0] == pytest.approx(1e3 * case.depth[0], rel=0.12)  # order 2 is 10 % off
