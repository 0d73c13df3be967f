"""Specimens: spread as asked for, never an impossible sensor, and few tables of presses."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest

from eitskin.datasets import Recipe
from eitskin.datasets.generation import preparation
from eitskin.datasets.generation.shard_simulation import simulate_frames
from eitskin.datasets.recipe.frame_sampling import instrument, sample, specimen
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import MAX_DEVIATIONS, Mounts, Specimens
from eitskin.errors import ConfigurationError
from eitskin.geometry import Clamp, Electrode, Hinge, Layer, Plates, SensorDesign
from eitskin.simulator import FourTerminalMeter, Instrument, Mechanics
from eitskin.simulator.bends.pressed_plates import PlateBend
from eitskin.simulator.deformation import press_table as tables
from eitskin.simulator.deformation import solution_store
from eitskin.simulator.deformation.press_table import PressTable, press_table

DESIGN = SensorDesign.reference()
SPREAD = Specimens(
    400,
    conductivity=0.1,
    thickness=0.02,
    gel_modulus=0.1,
    encapsulation_modulus=0.15,
    contact_impedance=0.3,
    electrode_place=0.001,
    hinge_span=0.001,
    hinge_offset=0.0005,
    board_loads=3.0,
)
TERMS = ("source", "sink", "sense_plus", "sense_minus", "idle", "common_mode")
METER = FourTerminalMeter(2e-5, 1e-5, 3e-5, 1e-5, 2e-5, common_mode=0.003, scale=2.0)


def recipe(spread, **changes) -> Recipe:
    touched = SceneGroup("touch", count=spread.count, angle_deg=(0.0, 30.0), touches=(1, 2))
    board = Instrument(meter=METER)
    known = {"scenes": (touched,), "seed": 5, "specimens": spread, "instrument": board}
    return Recipe("specimens", **known | changes)


def properties(asked):
    """Everything that is spread, by the name of its spread; places as arc lengths [m]."""
    for number in range(asked.specimens.count):
        each, meter = specimen(asked, number), instrument(asked, number).meter
        outline, electrodes = each.design.outline, each.design.electrodes
        yield {
            "conductivity": [each.design.conductivity],
            "thickness": [each.design.thickness],
            "gel_modulus": [each.mechanics.gel.shear_modulus],
            "encapsulation_modulus": [each.mechanics.encapsulation.shear_modulus],
            "contact_impedance": [e.contact_impedance.real for e in electrodes],
            "board_loads": [getattr(meter, term) for term in TERMS],
            "electrode_place": [outline.locate(e.x, e.y) for e in electrodes],
            "hinge_span": [each.fixture.span],
            "hinge_offset": [each.fixture.offset],
        }


@cache
def spread_properties():
    return list(properties(recipe(SPREAD)))


(NOMINAL,) = properties(recipe(Specimens()))
RELATIVE = tuple(NOMINAL)[:6]


@pytest.mark.slow
@pytest.mark.parametrize("name", NOMINAL)
def test_spread_has_the_standard_deviation_that_was_asked_for(name):
    values = np.array([each[name] for each in spread_properties()])
    asked = getattr(SPREAD, name)
    deviation = values - np.array(NOMINAL[name])
    if name in RELATIVE:
        # (deviation / mean)^2 = exp(s^2) - 1 with s that of the logarithm, whose mean is 0.
        deviation = np.log(values / np.array(NOMINAL[name]))
        asked = math.sqrt(math.log1p(asked**2))
    # Four standard errors; cutting at three standard deviations takes 1.4 % off.
    assert deviation.std() == pytest.approx(0.986 * asked, rel=4 / math.sqrt(2 * deviation.size))
    assert abs(deviation.mean()) < 4 * asked / math.sqrt(deviation.size)
    assert np.abs(deviation).max() <= MAX_DEVIATIONS * asked * (1 + 1e-9)
    if deviation.shape[1] > 1:  # electrodes and terms of a board by themselves
        together = np.corrcoef(deviation.T) - np.eye(deviation.shape[1])
        assert np.abs(together).max() < 0.2


@pytest.mark.parametrize("name", NOMINAL)
def test_each_property_has_draws_of_its_own(name):
    """Switching one off changes nothing else."""
    few = dataclasses.replace(SPREAD, count=2)
    asked, without = recipe(few), recipe(dataclasses.replace(few, **{name: 0.0}))
    for one, other in zip(properties(asked), properties(without), strict=True):
        for key, values in other.items():
            assert values == pytest.approx(NOMINAL[key] if key == name else one[key], rel=1e-12)
    assert instrument(asked, 1).meter.scale == METER.scale


def test_a_thicker_sensor_is_thicker_in_everything():
    pads = (
        Electrode(0.02, 0.0, z=0.002, height=0.002),
        Electrode(0.12, 0.03, z=0.001, on="inside"),
    )
    layers = (Layer(0.002, 0.5), Layer(0.003, 2.0))
    design = dataclasses.replace(DESIGN, electrodes=pads, layers=layers)
    each = specimen(recipe(Specimens(1, thickness=0.05, conductivity=0.1), sensor=design), 0)
    factor = each.design.thickness / 0.005
    assert factor != 1.0
    first, second = (layer.conductivity for layer in each.design.layers)
    assert second / first == pytest.approx(4.0)
    assert 0.05 < abs(np.log(first / 0.5)) < 0.4
    assert each.design.encapsulated_thickness == pytest.approx(0.012 * factor)
    assert [x.thickness for x in each.design.layers] == pytest.approx(
        [0.002 * factor, 0.003 * factor]
    )
    side, inside = each.design.electrodes
    assert (side.z, side.height) == pytest.approx((0.002 * factor, 0.002 * factor))
    assert inside.z == pytest.approx(0.001 * factor)
    assert inside.height is None
    assert each.grid.thickness == 0.005


def test_the_electrodes_that_cannot_move_are_named():
    """Those at a corner, around it, or beside each other."""
    spread = Specimens(electrode_place=0.0005)
    for x, culprits in ((0.0735, "electrodes 0 and 2"), (0.147, "electrode 2 and a corner")):
        pads = (Electrode(0.068, 0.0), Electrode(0.05, 0.03, on="top"), Electrode(x, 0.0))
        design = dataclasses.replace(DESIGN, electrodes=pads)
        (problem,) = spread.problems(design, Clamp())
        assert culprits in problem
    around = dataclasses.replace(DESIGN, electrodes=(Electrode(0.03, 0.0), Electrode(0.149, 0.0)))
    (problem,) = spread.problems(around, Clamp())
    assert "at most 0 m" in problem
    assert "electrode 1 and a corner" in problem


# Presses


def missing_presses(asked):
    return {path for path in preparation.missing_tables(asked) if not path.name.startswith("bend-")}


@pytest.mark.slow
def test_many_specimens_share_what_is_solved_and_few_decide_what_is_needed(monkeypatch, tmp_path):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    monkeypatch.setattr(solution_store, "LIBRARY", tmp_path / "none")
    # Dents, their corrections on a strip and at its end, pairs, and what sides add to those.
    assert len(missing_presses(recipe(Specimens(30)))) == 5
    # Dents of three thicknesses, and strips of as many.
    assert len(missing_presses(recipe(Specimens(30, thickness=0.03)))) == 3 + 4 + 3
    # Stiffness ratios of 1.4 times 0.66 to 1.53 lie within one step of half an octave, or two:
    # four tables of dents about each place, from two or three below to three above.
    assert len(missing_presses(recipe(Specimens(30, gel_modulus=0.1)))) - 7 in (5, 6, 7)
    both = Specimens(30, gel_modulus=0.1, thickness=0.03)
    assert len(missing_presses(recipe(both))) <= 3 * 7 + 6 + 3
    untouched = Recipe("flat", scenes=(SceneGroup("idle", count=1),), specimens=MANY.specimens)
    assert missing_presses(untouched) == set()
    few = dataclasses.replace(MANY, specimens=dataclasses.replace(MANY.specimens, count=2))
    assert preparation.deciding_specimens(few) == (0, 1)
    chosen = preparation.deciding_specimens(MANY)
    assert len(chosen) <= 48
    made = [specimen(MANY, number) for number in range(400)]
    thickness = np.array([each.design.thickness for each in made])
    gel = np.array([each.mechanics.gel.shear_modulus for each in made])
    around = np.array([each.mechanics.encapsulation.shear_modulus for each in made])
    # Depths over the thickness follow from force over modulus times thickness squared.
    forces = gel * thickness**2, around * thickness**2, gel * around * thickness**4
    for values in (thickness, around / gel, *forces):
        assert {int(np.argmin(values)), int(np.argmax(values))} <= set(chosen)
    wider = dataclasses.replace(MANY, specimens=dataclasses.replace(MANY.specimens, count=1000))
    assert len(preparation.deciding_specimens(wider)) <= 48


def law(stack, _indenter) -> PressTable:
    """Presses whose dents grow with thickness t in mm as polynomials of log t, and knots with t."""
    t = 1e3 * stack.sheets[1].thickness
    depths = 1e-3 * t * np.linspace(0.0, 0.6, 6)
    knots = 1e-3 * t * np.linspace(0.0, 12.0, 200)
    shape = (knots / knots[-1] - 1.0) ** 4 * (1.0 + 2.0 * np.log(t) ** 2)
    moved = depths[:, None, None, None] * shape[:, None, None] * np.ones((1, 1, 6, 2))
    return PressTable(
        depths=depths,
        forces=np.linspace(0.0, 40.0, 6) * (1.0 + np.log(t)),
        contact_radii=np.full(6, 0.0075),
        peak_pressures=np.linspace(0.0, 1e5, 6),
        thinnings=np.linspace(0.0, 0.9, 6),
        energies=np.linspace(0.0, 1.0, 12).reshape(6, 2) * t,
        thickness=np.array(stack.sheets[1].thickness),
        knots=knots,
        moved=moved,
        stressed=moved[..., 0],
    )


@pytest.fixture
def presses_by_law(monkeypatch):
    """Press tables by `law`, which need not be solved."""
    monkeypatch.setattr(tables, "load_press_table", law)
    monkeypatch.setattr(preparation, "solve_missing", lambda *_: None)
    press_table.cache_clear()
    yield
    press_table.cache_clear()


@pytest.mark.usefixtures("presses_by_law")
def test_forces_must_be_within_reach_of_every_specimen():
    """Here a table reaches 104 N at the nominal 5 mm, and less on thinner sensors."""
    group = SceneGroup("touch", count=20, force=(100.0, 103.0))
    one = Recipe("force", scenes=(group,), seed=4)  # the thinnest is not the first
    preparation.prepare(one)
    with pytest.raises(ConfigurationError, match=r"force.*above 0"):
        preparation.prepare(dataclasses.replace(one, specimens=Specimens(20, thickness=0.04)))


@pytest.mark.usefixtures("presses_by_law")
def test_touches_on_plates_must_be_within_reach_at_the_middle_of_the_gap(monkeypatch):
    places = []
    monkeypatch.setattr(PlateBend, "check", lambda _, __, x, ___: places.append(x))
    group = SceneGroup("touch", count=2, force=(1.0, 5.0), support=Plates(0.04))
    preparation.prepare(Recipe("plates", scenes=(group,)))
    assert set(places) == {0.075}


# Sets of many specimens: what a shard solves and holds, and which tables are needed


MANY = Recipe(
    "many specimens",
    seed=4,
    frames_per_shard=6,
    specimens=Specimens(count=400, conductivity=0.05, thickness=0.03, gel_modulus=0.05),
    scenes=(SceneGroup("bend", count=1200, angle_deg=(-20.0, 30.0)),),
)


# Mounts: clamps that fill their ranges evenly, shared by specimens, and never impossible


MOUNTS = Mounts(12, (0.025, 0.060), (0.004, 0.014), (0.5, 2.0), ("both", "bottom"))


def test_the_mounts_fill_their_ranges_evenly():
    many = dataclasses.replace(MOUNTS, count=64)
    clamps = [many.clamp(number) for number in range(64)]
    ratios = [
        many.mechanics(number, Mechanics()).encapsulation.shear_modulus for number in range(64)
    ]
    for values, (low, high) in (
        ([clamp.span for clamp in clamps], many.span),
        ([clamp.offset for clamp in clamps], many.offset),
        (np.log2(ratios), tuple(np.log2(28e3 * np.array(many.stiffness)))),
    ):
        counts, _ = np.histogram(values, 8, (low, high))
        assert counts.sum() == 64
        assert counts.min() >= 5
    places = np.array([[clamp.span, clamp.offset] for clamp in clamps])
    assert abs(np.corrcoef(places.T)[0, 1]) < 0.1
    assert {clamp.faces for clamp in clamps} == {"both", "bottom"}
    assert Mounts(64).mechanics(63, Mechanics()) == Mechanics()


IDLE, ON_PLATES = SceneGroup("idle", count=4), SceneGroup("idle", count=4, support=Plates())
CARRIED = dataclasses.replace(DESIGN, support=Plates(0.040))


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"mounts": MOUNTS, "specimens": Specimens(12, conductivity=0.1)},
        {"scenes": (IDLE, ON_PLATES), "specimens": Specimens(4, hinge_span=0.002)},
        {"sensor": CARRIED, "specimens": Specimens(4, hinge_span=0.002)},
        {"scenes": (dataclasses.replace(IDLE, support=Plates(0.030)),)},
        {"fixture": Hinge()},
    ],
    ids=["clamps", "plates of scenes", "plates of sensors", "plates of their own", "hinge"],
)
def test_frames_say_how_their_specimen_is_held(changes):
    """Plates hold the lower face of a clamped sensor, as far apart as its own clamp."""
    usual = {"scenes": (dataclasses.replace(IDLE, count=12),), "resolution": "fast", "seed": 2}
    asked = Recipe("held", **usual | changes)
    data = simulate_frames(asked, range(asked.frames))
    columns = data.clamp_span, data.clamp_offset, data.clamp_faces
    for index, number in enumerate(data.specimen_number[data.specimen].tolist()):
        each, own = specimen(asked, number), sample(asked, index).scene.support
        support = own or each.design.support
        on_plates, gap, held = isinstance(support, Plates), 0.0, (np.nan, np.nan, np.nan)
        if on_plates:
            gap = support.span
            if "specimens" in changes:
                assert gap == pytest.approx(each.fixture.span, abs=1e-12)
        if isinstance(each.fixture, Clamp):
            faces = 1 if on_plates or each.fixture.faces == "bottom" else 2
            held = each.fixture.span, each.fixture.offset, faces
            moduli = each.mechanics.encapsulation.shear_modulus, each.mechanics.gel.shear_modulus
            assert data.clamp_stiffness[index] == np.float32(moduli[0] / moduli[1])
        assert data.support_gap[index] == np.float32(gap)
        np.testing.assert_equal([column[index] for column in columns], list(np.float32(held)))
    if "mounts" in changes:
        assert set(data.clamp_faces) == {1, 2}
    if "specimens" in changes:
        assert len(set(data.clamp_span)) == asked.specimens.count
