"""Shares of the layers in the force on an indenter, against moduli that are varied one by one."""

from functools import cache

import numpy as np
import pytest

from eitskin.benchmarks.studies.physics.creep import layer_shares
from eitskin.geometry import SensorDesign
from eitskin.simulator.mechanics.axisymmetric_press import AxisymmetricPress
from eitskin.simulator.mechanics.layer_stack import Mechanics, Sheet, Stack
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.mechanics.viscoelasticity import ECOFLEX, GEL, REFERENCE, mixture
from eitskin.simulator.scene.indenters import Cylinder, Sphere

T = np.geomspace(1e-3, 1e5, 60)
MODULI, DEPTH = np.array([28e3, 12e3]), 0.0004


@cache
def pressed(*factors):
    """A ball on two layers whose moduli are multiplied by the factors: the force."""
    return ball(factors).to_depth(DEPTH).force


@cache
def shares_under_a_ball():
    return layer_shares(ball((1, 1)), DEPTH)


def ball(factors):
    sheets = [Sheet(0.003, NeoHookean(mu)) for mu in MODULI * factors]
    return AxisymmetricPress(
        Stack(tuple(sheets)), Sphere(0.004, rough=False), finest=0.001, reach=0.012
    )


@pytest.mark.slow
def test_shares_are_what_moduli_do_to_the_force():
    shares, h = shares_under_a_ball(), 0.02
    assert shares.sum() == pytest.approx(1.0)
    slopes = [
        (pressed(1 + h, 1) - pressed(1 - h, 1)) / (2 * h * pressed(1, 1)),
        (pressed(1, 1 + h) - pressed(1, 1 - h)) / (2 * h * pressed(1, 1)),
    ]
    assert shares == pytest.approx(slopes, abs=0.002)


@pytest.mark.slow
def test_the_long_time_force_is_that_of_relaxed_moduli():
    shares = shares_under_a_ball()
    relaxed = pressed(0.9, 0.75) / pressed(1, 1)
    assert mixture([ECOFLEX, GEL], shares).relaxation(np.inf) == pytest.approx(relaxed, abs=0.005)


@pytest.mark.slow
def test_the_reference_has_the_shares_of_the_reference_stack():
    press = AxisymmetricPress(Mechanics().stack(SensorDesign.reference()), Cylinder(), finest=0.001)
    below, gel, above = layer_shares(press, 0.0014)
    assert gel == pytest.approx(0.43, abs=0.01)
    whole = mixture([ECOFLEX, GEL, ECOFLEX], [below, gel, above])
    assert np.allclose(whole.creep(T), REFERENCE.creep(T), rtol=0.002)
