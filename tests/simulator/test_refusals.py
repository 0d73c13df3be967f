"""Refusals of the simulator: what was asked, and the words that name the key or the remedy."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import (
    Bend,
    Clamp,
    ColeCole,
    ConductivityTable,
    Disc,
    Free,
    FreeArc,
    Hinge,
    Inclusion,
    Plates,
    Rigid,
    Roll,
    SensorDesign,
    Twist,
)
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import (
    Cylinder,
    Footprint,
    ForwardModel,
    FourTerminalMeter,
    Instrument,
    Mechanics,
    Profile,
    Protocol,
    Scene,
    SensorGrid,
    Simulator,
    Sphere,
    Touch,
)
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.deformation.touches import pressed_touches
from eitskin.simulator.mechanics.layer_stack import Piezoresistivity
from eitskin.simulator.mechanics.materials import NeoHookean, Ogden
from eitskin.simulator.mechanics.viscoelasticity import Prony

REFERENCE, DISC = SensorDesign.reference(), Disc(0.04)
ROUND = SensorDesign(DISC, 0.005, uniform(DISC, 4))
MEMBRANE = dataclasses.replace(REFERENCE, support=Free())
RNG, NAN = np.random.default_rng(0), math.nan
PART = Inclusion.box(0.05, 0.025, 0.01, 0.01, 2.0)
TOUCH = Touch(0.020, 0.030, 8.0)
UNFORCED = Touch(
    0.06, 0.03, depth=1e-3, held=1.0, released=1.0, indenter=Footprint(0.012, 0.012, round=True)
)
DENTED = ((0.0, 0.0), (0.02, 0.0), (0.005, 0.005), (0.0, 0.02))
BENT_DISC = Scene(Bend(10.0), (Touch(0.04, 0.04, 6.0, indenter=Sphere(0.0061)),))
NEAR_GAP = Scene(Bend(5.0), (Touch(0.075, 0.030, 8.0),), support=Plates())
FAR_BENT = Scene(Bend(55.0), (TOUCH,), support=Plates())
LOSING = Mechanics(piezoresistivity=Piezoresistivity(pressure=-1e-3))
FLAT_REFUSALS = "neither bent, rolled nor twisted"


@cache
def model(design=REFERENCE):
    return ForwardModel(design, "coarse")


def measured(scene, design=REFERENCE, **terms):
    return Simulator(design, **{"resolution": "fast"} | terms).measure(scene)


def included(*parts, design=REFERENCE, **terms):
    return ForwardModel(design, "coarse", inclusions=parts, **terms)


def metered(protocol, **terms):
    return FourTerminalMeter(**terms).transfer_impedance(np.eye(4), protocol)


REFUSALS = [
    # instruments and meters
    (lambda: Instrument(snr_db=19.9), r"snr_db.*20 to 120 dB.*19.9"),
    (lambda: Instrument(floor=1.9), r"floor.*0 to 0.001 V.*1.9"),
    (lambda: Instrument(drift=NAN), "drift"),
    (lambda: Instrument(excitation=0.5), r"excitation.*0, 0.607, 0.121, 0.075, 0.015, got 0.5"),
    (lambda: Instrument(stray_capacitance=(1e-10, 4e-11)), "stray_capacitance.*up to 1e-09 F"),
    (lambda: Instrument(snr_db=10.0, gain=1.0, rtia=1.0), "snr_db.*gain.*rtia"),  # all at once
    (lambda: FourTerminalMeter(source=-1e-3), r"source.*0 to 1000 S"),
    (lambda: FourTerminalMeter(leaks=(0.0, NAN)), r"leaks\[1\]"),
    (lambda: FourTerminalMeter(leads=(-1.0,)), r"leads\[0\].*ohm"),
    (lambda: FourTerminalMeter(scale=0.0), "scales"),
    (lambda: FourTerminalMeter(offset=math.inf), "finite"),
    (lambda: FourTerminalMeter(saturation=-1.0, source=-1.0), "source.*saturation"),
    (lambda: metered(Protocol.pairwise(4), leaks=(0.0, 1e-6)), r"leaks.*4 electrodes, got 2"),
    (
        lambda: Instrument(meter=FourTerminalMeter(channel_scale=(1.0, 2.0))).session(
            Protocol.pairwise(3), 1.0, RNG
        ),
        r"channel_scale.*3 measurements, got 2",
    ),
    # conductivities, which may be fields and tables
    (lambda: model().impedance(-1.0), "positive"),
    (lambda: model().impedance(NAN), "positive"),
    (lambda: model().impedance(1j), "real part, positive"),
    (lambda: model().impedance("wet"), "numbers"),
    (lambda: model().impedance(np.ones(3)), "got shape"),
    (lambda: model().impedance(lambda _: np.ones(7)), "got shape"),
    (lambda: model().impedance(lambda x: np.diag([1, 1, -1.0]) + 0 * x[..., None]), "positive"),
    (
        lambda: model().impedance(lambda x: np.eye(3) + np.eye(3, k=1) / 2 + 0 * x[..., None]),
        "symmetric",
    ),
    (lambda: ColeCole(0.5, (1e3,), ()), "."),
    (lambda: ColeCole(0.5, (1e3,), (1e-6,), (1.0,)), "."),
    (lambda: ConductivityTable((1e4, 1e3), (1.0, 1.0)), "."),
    (lambda: ConductivityTable((1e3,), (-1.0 + 1j,)), "."),
    (lambda: ConductivityTable((1e3, 1e4), (1.0, 1.0)).evaluate(1e5), "."),
    (lambda: dataclasses.replace(REFERENCE, conductivity=-1.0 + 1j), "."),
    (
        lambda: model(
            dataclasses.replace(REFERENCE, conductivity=ConductivityTable((1e3, 1e4), (1.0, 1.0)))
        ).impedance(frequency=-1.0),
        ".",
    ),
    (lambda: Inclusion.box(0.05, 0.025, 0.01, 0.01, -2.0), "positive"),
    (lambda: included(dataclasses.replace(PART, low=0.004, high=0.1)), "within the layer"),
    (lambda: included(PART, cells="hexahedra"), "prisms"),
    (lambda: included(PART, PART), "0 and 1 must not cross"),
    (lambda: included(Inclusion.cylinder(0.02, 0.05, 0.03, 2.0)), "0 must lie within"),
    # materials
    *(
        (lambda law=law, mu=mu: law(mu), "shear_modulus")
        for law in (NeoHookean, lambda mu: Ogden(mu, 2.0))
        for mu in (0.0, -1.0, NAN, math.inf)
    ),
    (lambda: Ogden(1.0, 0.0), "alpha"),
    (lambda: Prony((0.1,), ()), "per amplitude"),
    (lambda: Prony((0.6, 0.4), (1.0, 2.0)), "less than 1"),
    (lambda: Prony((-0.1,), (1.0,)), "not be negative"),
    (lambda: Prony((0.1,), (0.0,)), "positive and finite"),
    # indenters, stacks and presses
    (lambda: Cylinder(-1.0), r"indenter radius.*positive.*-1"),
    (lambda: Sphere(7.5), r"1 um and 0.5 m.*7.5 m.*metres"),
    (lambda: Cylinder(edge=0.0), "edge from 0.001 to 1"),
    (lambda: Cylinder(1e-6), r"at least 0\.1 mm"),
    (lambda: Profile((0.0, 0.001), (0.0,)), "as many heights"),
    (lambda: Profile((0.001, 0.002), (0.0, 0.001)), "starts with radius 0"),
    (lambda: Profile((0.0, 0.001), (0.0, 1.7e308)), "heights up to 10 m"),
    (lambda: Profile((0.0, 0.001, 0.002), (0.0, 0.001, 0.0015)), "convex"),
    (lambda: Footprint(length=0.01), "radius"),
    (lambda: Footprint(corners=DENTED), "footprint"),
    # touches
    (lambda: Touch(0.06, 0.03, NAN), "force must be a positive number of N"),
    (lambda: Touch(0.06, 0.03, depth=-1e-3), "depth must be a positive number of m"),
    (lambda: Touch(0.06, 0.03, 3.0, depth=1e-3), "a force or a depth"),
    (lambda: Touch(0.06, 0.03, held=-1.0), "held"),
    (lambda: Touch(0.06, 0.03, released=1.0), "needs held"),
    (lambda: Touch(0.06, 0.03, held=2.0, before=((5.0, 9.0, 1.0),)), "before this touch began"),
    (lambda: Touch(0.06, 0.03, held=0.0, before=((5.0, 9.0, 0.0),)), "before this touch began"),
    (
        lambda: pressed_touches((UNFORCED,), PressedSensor(REFERENCE, Mechanics(), "tabulated")),
        "needs the force",
    ),
    (lambda: measured(Scene(touches=(Touch(50.0, 20.0),))), "metres"),
    (lambda: measured(Scene(touches=(Touch(0.05, 0.02, 100.0),))), "pressed to"),
    # In the bounding box and off the outline.
    (lambda: measured(Scene(touches=(Touch(0.005, 0.005),)), ROUND), r"0.08 x 0.08 m.*\(0.005,"),
    (lambda: measured(Scene(touches=(Touch(0.06, 0.03),)), mechanics=LOSING), "must stay positive"),
    (lambda: Simulator(REFERENCE, touch_model="guess"), r"touch_model.*tabulated"),
    # bends and supports
    (lambda: measured(Scene(bend=Bend(-90.0))), "from -40 to 90 deg"),
    (lambda: Roll(400.0), "from -360 to 360"),
    (lambda: measured(BENT_DISC, ROUND), r"rectangular outline, got Disc.*FreeArc"),
    (lambda: measured(Scene(Bend(5.0)), MEMBRANE), "free membrane"),
    (lambda: measured(Scene(Bend(5.0), support=Free())), FLAT_REFUSALS),
    (lambda: measured(Scene(twist=Twist(5.0), support=Free())), FLAT_REFUSALS),
    (lambda: measured(Scene(Bend(5.0), support=Plates(0.03))), "0.03 m apart, .* fixture 0.04 m"),
    (
        lambda: measured(Scene(Bend(5.0), support=Plates()), fixture=FreeArc(0.1)),
        "needs the clamp",
    ),
    (lambda: measured(Scene(support=Plates(0.2))), "length of 0.15 m, got 0.2 m"),
    (lambda: measured(NEAR_GAP, touch_model="tabulated"), "touches on plates are tabulated"),
    (
        lambda: measured(FAR_BENT, touch_model="tabulated"),
        "touches on plates are tabulated from -20 to 50",
    ),
    (
        lambda: measured(Scene(touches=(TOUCH,), support=Free()), touch_model="tabulated"),
        r"on Free\(\)",
    ),
    (lambda: measured(Scene(Bend(10.0)), ROUND), r"Disc.*choose a kinematic fixture"),
    (lambda: Clamp(span=-1.0), "span"),
    (lambda: Clamp(offset=math.inf), "offset"),
    (lambda: Clamp(compliance=-1.0), "compliance"),
    (lambda: Clamp(faces="top"), "'both' or 'bottom'"),
    (lambda: SensorGrid(span=0.0), "span"),
]


@pytest.mark.parametrize(("make", "says"), REFUSALS)
def test_what_cannot_be_is_refused_with_what_to_do(make, says):
    with pytest.raises(ConfigurationError, match=says):
        make()


def test_scenes_next_to_impossible_ones_are_possible(sim):
    Simulator(ROUND, "fast").check_scene(dataclasses.replace(BENT_DISC, bend=Bend(0.0)))
    Simulator(ROUND, "fast", fixture=Hinge()).check_scene(BENT_DISC)
    apart = Simulator(REFERENCE, "fast", fixture=Hinge(span=0.03))
    apart.check_scene(Scene(Bend(5.0), support=Plates(0.03)))
    on_free = Simulator(MEMBRANE, "fast")
    on_free.check_scene(Scene(Bend(5.0), support=Rigid()))
    assert on_free.design_on_support(Scene(support=Rigid())) == REFERENCE
    assert sim.solves_presses(NEAR_GAP)
    assert sim.solves_presses(FAR_BENT)
    with pytest.raises(ConfigurationError, match="default_rng"):
        sim.measure(Scene(), Instrument())
