"""Tabulated corrections: symmetry, range, storage, and presses that were solved otherwise."""

import dataclasses
import json
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from eitskin.benchmarks.world import cases
from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Plates, Polygon, Rectangle, SensorDesign, Substrate
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import Rigid
from eitskin.simulator import Cylinder, Mechanics, Scene, Simulator, Touch
from eitskin.simulator.deformation import corrections as tables
from eitskin.simulator.deformation import finite_stack
from eitskin.simulator.deformation import solution_store as store
from eitskin.simulator.deformation.corrections import (
    Corrections,
    correction_problems,
    corrections,
    is_tabulable,
)
from eitskin.simulator.deformation.indentation_tables import (
    Indentations,
    _side_nodes,
    solve_disc,
    solve_end,
    solve_side,
    solve_strip,
)
from eitskin.simulator.deformation.pair_corrections import pair_corrections
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid
from eitskin.simulator.deformation.stack_mesh import Fineness
from eitskin.simulator.deformation.touches import resolve_touch_model
from eitskin.simulator.mechanics.materials import NeoHookean

DESIGN, MECHANICS, PUNCH = SensorDesign.reference(), Mechanics(), Cylinder()
LENGTH, WIDTH, DEPTH = 0.150, 0.060, 0.0024
REFERENCES = Path(__file__).parents[2] / "data" / "press_references.json"


@pytest.fixture(scope="module")
def shipped() -> Corrections:
    assert all(each.is_shipped for each in correction_problems(DESIGN, MECHANICS, PUNCH))
    return corrections(DESIGN, MECHANICS, PUNCH)


def total(found, points):
    """Displacement and mean stress of all fields at points (n, 3), (n, 4)."""
    fields, _ = found
    return sum(field.values(points[:, None])[:, 0].T for field in fields)


@pytest.mark.parametrize(("x", "y"), [(0.075, 0.030), (0.030, 0.014), (0.012, 0.048)])
@pytest.mark.parametrize("axis", [0, 1])
def test_mirrored_presses_have_mirrored_corrections(shipped, x, y, axis) -> None:
    size = (LENGTH, WIDTH)
    there = [x, y]
    there[axis] = size[axis] - there[axis]
    points = np.random.default_rng(0).uniform((0, 0, 0), (LENGTH, WIDTH, 0.005), (60, 3))
    mirrored, signs = points.copy(), np.ones(4)
    mirrored[:, axis], signs[axis] = size[axis] - points[:, axis], -1.0
    here, image = shipped.correct_press(x, y, DEPTH), shipped.correct_press(*there, DEPTH)
    assert image[1] == pytest.approx(here[1], rel=1e-9)
    expected = total(here, points) * signs
    scale = np.abs(expected).max(axis=0)
    # The meshes on which tables are solved are not quite symmetric.
    assert total(image, mirrored) / scale == pytest.approx(expected / scale, abs=2e-5)


def test_corrections_vanish_with_the_depth(shipped) -> None:
    points = np.random.default_rng(1).uniform((0, 0, 0), (LENGTH, WIDTH, 0.005), (60, 3))
    deep, shallow = (
        np.abs(total(shipped.correct_press(0.04, 0.02, d), points)) for d in (2.4e-3, 2.4e-6)
    )
    assert np.all(shallow.max(axis=0) < 3e-3 * deep.max(axis=0))


WIDE, ROUND = Polygon(((0, 0), (0.6, 0), (0.6, 0.3), (0, 0.3))), Disc(0.05)
L_SHAPE = Polygon(((0, 0), (0.1, 0), (0.1, 0.05), (0.05, 0.05), (0.05, 0.1), (0, 0.1)))


def design_on(outline) -> SensorDesign:
    return SensorDesign(outline, DESIGN.thickness, uniform(outline, 8))


@dataclasses.dataclass
class Bell:
    """Correction that is a bell about a press, whatever the outline."""

    x: float
    y: float
    depth: float

    @property
    def sunk(self):
        return np.array([0.1 * self.depth])

    def in_gel(self, points):
        away = (points[..., :2] - np.array([self.x, self.y])) / 0.03
        return self.depth * np.exp(-(away**2).sum(axis=-1))[..., None] * np.ones(4)


@pytest.fixture
def solved_bells(monkeypatch):
    """What is solved for tables: bells about presses of two depths."""
    dents = SimpleNamespace(depth=0.001), SimpleNamespace(depth=0.002)

    def solve(about, _outline, place, _fineness):
        return [Bell(*place, dent.depth) for dent in about.dents]

    monkeypatch.setattr(Indentations, "solve", solve)
    monkeypatch.setattr(
        Indentations, "to_depths", lambda about, _: dataclasses.replace(about, dents=dents)
    )
    return Indentations(MECHANICS.stack(DESIGN), MECHANICS, Rigid(), PUNCH)


@pytest.mark.parametrize("kind", ["strip", "side", "disc"])
def test_tables_hold_what_was_solved_about_each_press(kind, solved_bells) -> None:
    about, reports = solved_bells, []
    design, solvers, more = {
        "strip": (
            DESIGN,
            [partial(solve_strip, about, WIDTH), partial(solve_end, about, WIDTH)],
            1,
        ),
        "side": (design_on(WIDE), [partial(solve_side, about)], 0),
        "disc": (design_on(ROUND), [partial(solve_disc, about, ROUND.radius)], 0),
    }[kind]
    tables = tuple(solve(lambda *done: reports.append(done)) for solve in solvers)
    assert reports[-1][0] == reports[-1][1]
    aside = float(tables[0].nodes("distance_to_side")[2])
    x, y = {"strip": (0.075, aside), "side": (0.3, aside), "disc": (0.1 - aside, 0.05)}[kind]
    base, varied = (None, ()) if more else (tables[0], ((tables[0], 1.0),))
    found = Corrections(design, tables * more, base, varied).correct_press(x, y, 0.001)
    points = np.array([x, y, 0.0]) + np.random.default_rng(0).uniform(
        (-0.02, -min(aside, 0.02), 0.0), (0.5 * aside, 0.02, 0.005), (50, 3)
    )
    assert total(found, points) == pytest.approx(Bell(x, y, 0.001).in_gel(points), abs=2e-5)
    assert found.extra_depth == pytest.approx(1e-4)


@pytest.mark.parametrize(
    ("outline", "middle", "beside"),
    [
        (DESIGN.outline, (0.075, 0.030), [(0.001, 0.030), (0.075, 0.0595)]),
        (L_SHAPE, (0.03, 0.03), [(0.098, 0.03)]),
    ],
)
def test_presses_beyond_the_tables_are_refused(outline, middle, beside) -> None:
    found = corrections(design_on(outline), MECHANICS, PUNCH)
    deepest = float(found.first.nodes("depth")[-1])
    found.correct_press(*middle, deepest)
    with pytest.raises(ConfigurationError, match=r"tabulated to a depth .* touch_model='solved'"):
        found.correct_press(*middle, 1.05 * deepest)
    for place in beside:
        with pytest.raises(ConfigurationError, match=r"keep .* mm from the edge"):
            found.correct_press(*place, 0.001)


def test_nodes_along_a_side_are_as_close_before_a_press_as_behind_it() -> None:
    (along, _), _ = _side_nodes(0.012)
    assert along == pytest.approx(-along[::-1], abs=1e-12)
    assert 0.0 < np.diff(along).min() == pytest.approx(np.diff(along)[len(along) // 2])


def test_a_disc_without_room_for_an_indenter_has_no_table() -> None:
    about = Indentations(MECHANICS.stack(DESIGN), MECHANICS, Rigid(), Cylinder(0.052))
    with pytest.raises(ConfigurationError, match=r"no room .* touch_model='solved'"):
        solve_disc(about, ROUND.radius, lambda *_: None)


def pair(first, second):
    """Fields of what two presses (x, y, depth) change of each other, and their sinking."""
    found = pair_corrections(DESIGN, MECHANICS, PUNCH).correct_pair(first, second)
    assert len(found[0]) == 2
    return found


def test_pairs_feel_each_other_less_farther_apart() -> None:
    points = np.random.default_rng(2).uniform((0.05, 0, 0), (0.1, WIDTH, 0.005), (60, 3))
    sizes = []
    for half in (0.009, 0.0125, 0.0175):
        found = pair((0.075 - half, 0.03, DEPTH), (0.075 + half, 0.03, DEPTH))
        sizes.append(np.abs(total(found, points)[:, :3]).max())
    assert sizes[0] > sizes[1] > sizes[2]
    table = pair_corrections(DESIGN, MECHANICS, PUNCH)
    far = float(table.wide.nodes("axis_distance")[-1])
    assert table.correct_pair((0.01, 0.03, DEPTH), (0.01 + far, 0.03, DEPTH)) == ([], 0.0)


def test_pairs_on_other_outlines_are_those_of_a_wide_stack() -> None:
    """At the same distance the changes are those of the reference but for what its sides add."""
    outline = Disc(0.05)
    disc = SensorDesign(outline, 0.005, uniform(outline, 8))
    touches = (0.04, 0.05, DEPTH), (0.065, 0.05, DEPTH)
    wide = pair_corrections(disc, MECHANICS, PUNCH).correct_pair(*touches)
    reference = pair_corrections(DESIGN, MECHANICS, PUNCH).correct_pair(*touches)
    points = np.random.default_rng(2).uniform((0, 0, 0), (0.1, 0.1, 0.005), (60, 3))
    assert len(wide[0]) == 1
    assert total(wide, points) == pytest.approx(total((reference[0][:1], 0.0), points))
    assert wide[1] == reference[1]


@pytest.mark.parametrize("second", [(0.085, 0.03), (0.068, 0.047), (0.06, 0.045), (0.075, 0.012)])
def test_pairs_are_the_same_seen_from_either_press_and_in_a_mirror(second) -> None:
    points = np.random.default_rng(3).uniform((0.03, 0, 0), (0.12, WIDTH, 0.005), (60, 3))
    places = np.array([(0.07, 0.03), second])
    found = pair((*places[0], 0.003), (*places[1], 0.0012))
    expected = total(found, points)
    scale = np.abs(expected).max(axis=0)
    swapped = pair((*places[1], 0.003), (*places[0], 0.0012))
    assert swapped[1] == pytest.approx(found[1])
    assert total(swapped, points) / scale == pytest.approx(expected / scale, abs=0.03)
    for axis, extent in ((0, LENGTH), (1, WIDTH)):
        there, mirrored, signs = places.copy(), points.copy(), np.ones(4)
        there[:, axis], mirrored[:, axis] = extent - places[:, axis], extent - points[:, axis]
        signs[axis] = -1.0
        image = pair((*there[0], 0.003), (*there[1], 0.0012))
        # The meshes on which pairs are solved are not quite symmetric.
        assert total(image, mirrored) / scale == pytest.approx(expected * signs / scale, abs=0.03)


# Neighbouring stacks


@pytest.mark.parametrize("thickness", [0.0040, 0.0047, 0.005, 0.0054, 0.0063])
@pytest.mark.parametrize("modulus", [14e3, 18e3, 28e3, 33e3, 56e3, 65e3])
def test_weights_of_neighbours_are_those_of_a_quadratic(thickness, modulus) -> None:
    base, weights = needed(thickness, modulus)

    def quadratic(stack):
        t = np.log(stack.sheets[1].thickness / 0.005)
        s = np.log(stack.sheets[0].law.shear_modulus / 28e3)
        return 1.0 + 2.0 * t - 3.0 * t**2 + 0.5 * s + 4.0 * s**2

    found = quadratic(base) + sum(weight * quadratic(stack) for stack, weight in weights.items())
    t, s = np.log(thickness / 0.005), np.log(modulus / 28e3)
    assert found == pytest.approx(1.0 + 2.0 * t - 3.0 * t**2 + 0.5 * s + 4.0 * s**2)
    assert sum(weights.values()) == pytest.approx(0.0, abs=1e-12)


def needed(thickness, modulus):
    design = dataclasses.replace(DESIGN, thickness=thickness)
    mechanics = Mechanics(encapsulation=NeoHookean(modulus))
    return tables.TabledSensor(design, mechanics, PUNCH).stacks(SensorGrid(thickness=0.005))


@pytest.mark.parametrize("side", [-1, 1])
def test_weights_are_continuous_where_the_neighbours_change(side) -> None:
    """A step from the base the stack there has the whole weight, from either side."""
    before, after = (needed(0.005, 28e3 * 2.0 ** (0.5 * side * t))[1] for t in (1 - 1e-6, 1 + 1e-6))
    assert set(before) != set(after)
    for stack in before.keys() | after.keys():
        assert before.get(stack, 0.0) == pytest.approx(after.get(stack, 0.0), abs=1e-5)


# Largest changes by 5 N at (15, 30) mm, with `touch_model="solved"` and resolution `fast`, by
# measurement, 24 Nov 2026: heights of the stack, or the modulus of its encapsulation, times a
# factor.
BESIDE_AN_END = {
    ("thicker", 0.95): {26: 0.0038121, 12: 0.0038121, 24: 0.0029869, 17: 0.0029869},
    ("thicker", 1.05): {26: 0.0055446, 12: 0.0055446, 27: 0.0049534, 6: 0.0049534},
    ("stiffer", 0.5): {6: 0.0090282, 27: 0.0090282, 12: 0.009011, 26: 0.009011},
    ("stiffer", 2.0): {12: 0.0019803, 26: 0.0019803, 24: 0.0015507, 17: 0.0015507},
}


@pytest.mark.parametrize(("what", "factor"), BESIDE_AN_END)
def test_specimens_are_pressed_near_an_end_as_if_they_were_solved(what, factor) -> None:
    heights = {
        "thickness": DESIGN.thickness,
        "encapsulated_thickness": DESIGN.encapsulated_thickness,
    }
    thicker, stiffer = (factor, 1.0) if what == "thicker" else (1.0, factor)
    design = dataclasses.replace(DESIGN, **{name: thicker * h for name, h in heights.items()})
    mechanics = Mechanics(encapsulation=NeoHookean(stiffer * MECHANICS.encapsulation.shear_modulus))
    grid = SensorGrid(thickness=DESIGN.thickness)
    sim = Simulator(design, "fast", None, None, mechanics, "tabulated", grid=grid)
    flat, pressed = (
        sim.measure(each).impedance
        for each in (Scene(), Scene(touches=(Touch(0.015, 0.030, 5.0),)))
    )
    found = (pressed / flat - 1.0).real
    for number, change in BESIDE_AN_END[what, factor].items():
        assert found[number] == pytest.approx(change, rel=0.03 if what == "thicker" else 0.07)


def test_presses_on_an_even_base_are_tabulated_on_outlines_of_some_size() -> None:
    triangle = Polygon(((0.0, 0.0), (0.2, 0.0), (0.1, 0.1)))
    flat = [DESIGN, design_on(triangle), design_on(ROUND)]
    flat.append(dataclasses.replace(DESIGN, support=Substrate(0.01, 5e3)))
    assert all(map(is_tabulable, flat))
    assert is_tabulable(dataclasses.replace(DESIGN, support=Plates()))
    loose = dataclasses.replace(flat[2], support=Plates())
    thick = dataclasses.replace(flat[1], encapsulated_thickness=0.06)
    assert not any(map(is_tabulable, (loose, thick, design_on(Disc(0.010)))))
    for radius, model in ((0.0075, "tabulated"), (0.006, "solved")):
        touch = Touch(0.075, 0.030, indenter=Cylinder(radius))
        assert resolve_touch_model((touch,), PressedSensor(DESIGN, MECHANICS)) == model


# Files


def test_names_of_files_depend_on_everything() -> None:
    harder = dataclasses.replace(MECHANICS, encapsulation=NeoHookean(40e3))
    wider = Rectangle(0.150, 0.070)
    cases = [
        (DESIGN, MECHANICS, PUNCH),
        (SensorDesign(wider, 0.005, uniform(wider, 8)), MECHANICS, PUNCH),
        (DESIGN, Mechanics(margin=0.004), PUNCH),
        (DESIGN, harder, PUNCH),
        (DESIGN, Mechanics(bulk_ratio=1e3), PUNCH),
        (DESIGN, MECHANICS, Cylinder(0.006)),
        (DESIGN, MECHANICS, Cylinder(rough=False)),
    ]
    kinds = "strip", "end", "pair", "pair-sides"
    every = [{p.kind: p.name for p in correction_problems(*case, OWN_GRID)} for case in cases]
    # A pair on a wide stack has neither width nor margin. A harder encapsulation is two steps away.
    expected = {"strip": 6, "end": 6, "pair": 4, "pair-sides": 6}
    assert {kind: len({each[kind] for each in every}) for kind in kinds} == expected
    assert every[0] == {
        p.kind: p.name for p in correction_problems(DESIGN, Mechanics(), Cylinder())
    }
    assert store.missing(correction_problems(DESIGN, MECHANICS, PUNCH)) == {}


def test_specimens_share_tables_and_outlines_of_straight_sides_have_one() -> None:
    def names(design, mechanics=MECHANICS, *grid):
        return {p.name for p in correction_problems(design, mechanics, PUNCH, *grid, pairs=False)}

    for outline, others in ((L_SHAPE, [WIDE, Rectangle(0.08, 0.05)]), (ROUND, [])):
        (own,) = names(design_on(outline))
        assert all(names(design_on(other)) == {own} for other in others)
        thicker = dataclasses.replace(
            design_on(outline), thickness=0.0052, encapsulated_thickness=0.01248
        )
        softer, grid = Mechanics(encapsulation=NeoHookean(26e3)), SensorGrid(thickness=0.005)
        shared = names(thicker, softer, grid)
        assert len(shared) == 5
        assert own in shared
    assert not names(design_on(ROUND)) & names(design_on(Disc(0.06)))


def test_stresses_go_with_the_modulus_of_the_gel() -> None:
    soft = Mechanics(gel=NeoHookean(10e3), encapsulation=NeoHookean(14e3))
    points = np.random.default_rng(1).uniform((0, 0, 0), (LENGTH, WIDTH, 0.005), (60, 3))
    expected, found = (
        total(corrections(DESIGN, each, PUNCH).correct_press(0.04, 0.02, DEPTH), points)
        for each in (MECHANICS, soft)
    )
    assert found[:, :3] == pytest.approx(expected[:, :3])
    assert found[:, 3] == pytest.approx(0.5 * expected[:, 3])


# Independent solutions


def changes(sim: Simulator, *touches: Touch):
    flat = sim.measure(Scene()).impedance.real
    return sim.measure(Scene(touches=touches)).impedance.real / flat - 1.0


@pytest.mark.slow
def test_tables_give_the_signals_of_solved_presses(monkeypatch) -> None:
    """On cells that grow faster away from the press: a third of the time, 1 % of the signals."""
    coarser = partial(finite_stack.stack_mesh, fineness=Fineness(ends=0.0, growth=2.0))
    monkeypatch.setattr(finite_stack, "stack_mesh", coarser)
    touch = Touch(0.062, 0.022, 4.0)
    found, solved = (
        changes(Simulator(DESIGN, "fast", touch_model=model), touch)
        for model in ("tabulated", "solved")
    )
    assert np.linalg.norm(found - solved) < 0.02 * np.linalg.norm(solved)


@pytest.fixture(scope="module")
def standard() -> Simulator:
    return Simulator(DESIGN, "standard")


@pytest.mark.slow
def test_presses_give_the_signals_of_an_independent_solution(standard) -> None:
    for name, x in (("75_30", 0.075), ("60_30", 0.060)):
        expected = np.array(json.loads(REFERENCES.read_text())[name])
        found = changes(standard, Touch(x, 0.030, 10.0))
        assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected), name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "limit"),
    [("two_65_30_85_30", 0.055), ("two_60_30_90_30", 0.03), ("four_30", 0.025), ("15_15", 0.025)],
)
def test_presses_side_by_side_give_the_signals_of_the_reference(standard, name, limit) -> None:
    (case,) = (case for case in cases() if case.name == name)
    found = changes(standard, *case.scene.touches)
    assert np.linalg.norm(found - case.changes) < limit * np.linalg.norm(case.changes)
    (pressed, *_) = standard.presses(case.scene)
    assert pressed.depth == pytest.approx(case.depth[0], rel=0.01)
