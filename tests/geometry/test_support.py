"""Supports: written and read with designs, and what is refused."""

import dataclasses
import math

import pytest

from eitskin.config import parse_toml
from eitskin.errors import ConfigurationError
from eitskin.geometry import (
    Disc,
    Free,
    Plates,
    Rectangle,
    Rigid,
    SensorDesign,
    Substrate,
)
from eitskin.geometry.design.regular_layouts import uniform

REFERENCE = SensorDesign.reference()
SUPPORTS = (Rigid(), Plates(), Plates(0.03), Substrate(0.01, 5e3), Free())


@pytest.mark.parametrize("support", SUPPORTS)
def test_a_design_keeps_its_support_in_its_file(support) -> None:
    design = dataclasses.replace(REFERENCE, support=support)
    assert parse_toml(SensorDesign, design.to_toml()) == design


def test_a_design_without_support_is_on_a_rigid_base() -> None:
    text = REFERENCE.to_toml().replace('support = "rigid"\n', "")
    assert parse_toml(SensorDesign, text) == REFERENCE
    assert REFERENCE.support == Rigid()


def test_plates_leave_the_middle_free() -> None:
    assert Plates(0.03).gap(Rectangle(0.15, 0.06)) == pytest.approx((0.06, 0.09))
    assert Plates(0.03).gap(Disc(0.05)) == pytest.approx((0.035, 0.065))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plates(0.0), "support span.*positive"),
        (lambda: Plates(40.0), "support span.*got 40 m"),
        (lambda: Substrate(math.nan, 1e3), "support thickness.*got nan"),
        (lambda: Substrate(0.01, 0.0), "support shear_modulus.*Pa, got 0"),
        (
            lambda: dataclasses.replace(REFERENCE, support=Plates(0.15)),
            "less than the sensor's length of 0.15 m, got 0.15 m; .*'free'",
        ),
    ],
)
def test_impossible_supports_are_refused(make, message) -> None:
    with pytest.raises(ConfigurationError, match=message):
        make()


def test_a_disc_rests_on_any_support() -> None:
    outline = Disc(0.05)
    for support in SUPPORTS:
        electrodes = uniform(outline, 8)
        assert SensorDesign(outline, 0.003, electrodes, support=support).support == support
