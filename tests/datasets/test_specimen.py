"""Specimens: spread as asked for, never an impossible sensor, and few tables of presses."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest

from eitskin.datasets import Recipe
from eitskin.datasets.generation import preparation
from eitskin.datasets.generation.shard_simulation import simulate_frames
from eitskin.datasets.recipe.frame_sampling import instrument, specimen
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
)


def recipe(spread, **changes) -> Recipe:
    touched = SceneGroup("touch", count=spread.count, angle_deg=(0.0, 30.0), touches=(1, 2))
    scenes = (touched,)
    return Recipe("specimens", scenes=scenes, seed=5, specimens=spread, **changes)


@cache
def made(spread, **changes):
    asked = recipe(spread, **changes)
    return [specimen(asked, number) for number in range(spread.count)]


def properties(each):
    """Everything that is spread, by the name of its spread; places as arc lengths [m]."""
    outline = each.design.outline
    electrodes = each.design.electrodes
    return {
        "conductivity": [each.design.conductivity],
        "thickness": [each.design.thickness],
        "gel_modulus": [each.mechanics.gel.shear_modulus],
        "encapsulation_modulus": [each.mechanics.encapsulation.shear_modulus],
        "contact_impedance": [e.contact_impedance.real for e in electrodes],
        "electrode_place": [outline.locate(e.x, e.y) for e in electrodes],
        "hinge_span": [each.fixture.span],
        "hinge_offset": [each.fixture.offset],
    }


@cache
def spread_properties():
    return [properties(each) for each in made(SPREAD)]


NOMINAL = properties(made(Specimens())[0])
RELATIVE = tuple(NOMINAL)[:5]


@pytest.mark.slow
@pytest.mark.parametrize("name", NOMINAL)
def test_spread_has_the_standard_deviation_that_was_asked_for(name):
    values = np.array([each[name] for each in spread_properties()])
    asked = getattr(SPREAD, name)
    deviation = values - NOMINAL[name]
    if name in RELATIVE:
        # (deviation / mean)^2 = exp(s^2) - 1 with s that of the logarithm, whose mean is 0.
        deviation = np.log(values / NOMINAL[name])
        asked = math.sqrt(math.log1p(asked**2))
    # Four standard errors; cutting at three standard deviations takes 1.4 % off.
    assert deviation.std() == pytest.approx(0.986 * asked, rel=4 / math.sqrt(2 * deviation.size))
    assert abs(deviation.mean()) < 4 * asked / math.sqrt(deviation.size)
    assert np.abs(deviation).max() <= MAX_DEVIATIONS * asked * (1 + 1e-9)
    if deviation.shape[1] > 1:  # electrodes by themselves
        assert abs(np.corrcoef(deviation[:, 0], deviation[:, 1])[0, 1]) < 0.2


@pytest.mark.parametrize("name", NOMINAL)
def test_each_property_has_draws_of_its_own(name):
    """Switching one off changes nothing else."""
    without = dataclasses.replace(SPREAD, count=2, **{name: 0.0})
    for one, other in zip(made(dataclasses.replace(SPREAD, count=2)), made(without), strict=True):
        for key, values in properties(other).items():
            expected = NOMINAL[key] if key == name else properties(one)[key]
            assert values == pytest.approx(expected, rel=1e-12)


def test_a_thicker_sensor_is_thicker_in_everything():
    pads = (
        Electrode(0.02, 0.0, z=0.002, height=0.002),
        Electrode(0.12, 0.03, z=0.001, on="inside"),
    )
    layers = (Layer(0.002, 0.5), Layer(0.003, 2.0))
    design = dataclasses.replace(DESIGN, electrodes=pads, layers=layers)
    (each,) = made(Specimens(1, thickness=0.05, conductivity=0.1), sensor=design)
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
    untouched = Recipe("flat", scenes=(SceneGroup("idle", count=1),), specimens=SPREAD)
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


@pytest.mark.slow
def test_frames_say_the_clamp_of_their_specimen():
    flat, made = (SceneGroup("idle", count=12),), Specimens(12, conductivity=0.1)
    asked = Recipe("mounts", scenes=flat, specimens=made, mounts=MOUNTS, resolution="fast")
    data = simulate_frames(asked, range(12))
    made = [specimen(asked, number) for number in data.specimen_number[data.specimen].tolist()]
    ratios = [
        each.mechanics.encapsulation.shear_modulus / each.mechanics.gel.shear_modulus
        for each in made
    ]
    assert np.array_equal(data.clamp_span, np.float32([each.fixture.span for each in made]))
    assert np.array_equal(data.clamp_offset, np.float32([each.fixture.offset for each in made]))
    held = [1 if each.fixture.faces == "bottom" else 2 for each in made]
    assert np.array_equal(data.clamp_faces, held)
    assert set(held) == {1, 2}
    assert np.array_equal(data.clamp_stiffness, np.float32(ratios))


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "faces"), [({"support": Plates(0.030)}, 1), ({}, np.nan)])
def test_plates_under_a_clamped_sensor_hold_its_lower_face_and_hinges_none(changes, faces):
    """Sensors on plates are clamped here, others hinged."""
    group = SceneGroup("idle", count=1, **changes)
    fixture = Clamp() if changes else Hinge()
    recipe = Recipe("held", scenes=(group,), fixture=fixture, resolution="fast")
    data = simulate_frames(recipe, range(1))
    np.testing.assert_equal(float(data.clamp_faces[0]), faces)
    np.testing.assert_equal(np.isnan(data.clamp_span), np.isnan(data.clamp_faces))
    assert data.support_gap[0] == np.float32(0.030 if changes else 0.0)


@pytest.mark.slow
def test_the_gap_between_plates_is_that_of_each_specimen():
    design = dataclasses.replace(SensorDesign.reference(), support=Plates(0.040))
    spread = Specimens(count=4, hinge_span=0.002)
    recipe = Recipe(
        "gaps", scenes=(SceneGroup("idle", count=4),), sensor=design, specimens=spread, seed=2
    )
    data = simulate_frames(dataclasses.replace(recipe, resolution="fast"), range(4))
    drawn = [specimen(recipe, n) for n in data.specimen_number[data.specimen].tolist()]
    assert np.array_equal(
        data.support_gap, np.float32([each.design.support.span for each in drawn])
    )
    assert len(set(data.support_gap.tolist())) == 4


# Boards of specimens: loads that differ as asked for, in frames and references of each


TERMS = ("source", "sink", "sense_plus", "sense_minus", "idle", "common_mode")
METER = FourTerminalMeter(2e-5, 1e-5, 3e-5, 1e-5, 2e-5, common_mode=0.003, scale=2.0)


def boarded(loads, count=3, meter=METER) -> Recipe:
    return Recipe(
        "boards",
        scenes=(SceneGroup("idle", count=count),),
        seed=3,
        instrument=Instrument(snr_db=0.0, gain=0.002, meter=meter),
        specimens=Specimens(count, conductivity=0.2, board_loads=loads),
        resolution="coarse",
    )


def test_every_load_has_the_spread_that_was_asked_for():
    asked = boarded(3.0, 400)
    meters = [instrument(asked, number).meter for number in range(400)]
    ratios = np.log([[getattr(m, t) / getattr(METER, t) for t in TERMS] for m in meters])
    sd = np.sqrt(np.log1p(3.0**2))  # of a lognormal factor
    np.testing.assert_allclose(ratios.std(axis=0), 0.986 * sd, rtol=4 / np.sqrt(800))
    assert np.abs(ratios.mean(axis=0)).max() < 4 * sd / np.sqrt(400)
    assert np.abs(ratios).max() <= MAX_DEVIATIONS * sd * (1 + 1e-9)
    apart = np.corrcoef(ratios.T) - np.eye(len(TERMS))
    assert np.abs(apart).max() < 0.2
    assert {each.scale for each in meters} == {2.0}
