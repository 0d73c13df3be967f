"""Tabulated corrections: symmetry, range, storage, and presses that were solved otherwise."""

import dataclasses
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from eitskin.benchmarks.world import cases
from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Plates, Polygon, Rectangle, SensorDesign, Substrate
from eitskin.geometry.deformation.fixtures import Bend
from eitskin.geometry.design.sensor import Rigid
from eitskin.simulator import Cylinder, Mechanics, Scene, Simulator, Touch
from eitskin.simulator.bends import pressed_plates
from eitskin.simulator.deformation import pressed_sensor
from eitskin.simulator.deformation import solution_store as store
from eitskin.simulator.deformation import tabled_corrections as tables
from eitskin.simulator.deformation.indentation_tables import (
    Indentations,
    solve_disc,
    solve_end,
    solve_side,
    solve_strip,
)
from eitskin.simulator.deformation.pair_corrections import pair_corrections
from eitskin.simulator.deformation.pressed_sensor import PressedSensor
from eitskin.simulator.deformation.sensor_grid import OWN_GRID, SensorGrid
from eitskin.simulator.deformation.tabled_corrections import (
    Corrections,
    correction_problems,
    corrections,
    is_tabulable,
)
from eitskin.simulator.deformation.touches import resolve_touch_model
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.mechanics.stack_mesh import Fineness

from pressed_stacks import L_SHAPE, corrected, design_on, total

DESIGN, MECHANICS, PUNCH, FLAT = SensorDesign.reference(), Mechanics(), Cylinder(), Bend(0.0)
SIZE, WIDTH, DEPTH = (0.150, 0.060), 0.060, 0.0024
POINTS = np.random.default_rng(0).uniform((0, 0, 0), (*SIZE, 0.005), (60, 3))
WIDE, ROUND = Polygon(((0, 0), (0.6, 0), (0.6, 0.3), (0, 0.3))), Disc(0.05)


@pytest.fixture(scope="module")
def shipped() -> Corrections:
    assert all(each.is_shipped for each in correction_problems(DESIGN, MECHANICS, PUNCH))
    return corrections(DESIGN, MECHANICS, PUNCH)


def pair(first, second):
    """Fields of what two presses (x, y, depth) change of each other, and their sinking."""
    found = corrected(pair_corrections(DESIGN, MECHANICS, PUNCH), first, second)
    assert len(found[0]) == 2
    return found


def assert_mirrored(correct, places, close, points=POINTS) -> None:
    """Corrections of presses that are mirrored are mirrored, by `close` of the largest."""
    here = correct(*places)
    expected = total(here, points)
    scale = np.abs(expected).max(axis=0)
    for axis, extent in enumerate(SIZE):
        there, mirrored, signs = np.array(places), points.copy(), np.ones(4)
        there[:, axis], mirrored[:, axis] = extent - there[:, axis], extent - points[:, axis]
        signs[axis] = -1.0
        image = correct(*there)
        assert image[1] == pytest.approx(here[1], rel=1e-9)
        # The meshes on which tables are solved are not quite symmetric.
        assert total(image, mirrored) / scale == pytest.approx(expected * signs / scale, abs=close)


@pytest.mark.parametrize("place", [(0.030, 0.014), (0.012, 0.048)])
def test_mirrored_presses_have_mirrored_corrections_that_end_with_the_depth(shipped, place) -> None:
    assert_mirrored(lambda at: corrected(shipped, (*at, DEPTH)), [place], 2e-5)
    deep, shallow = (
        np.abs(total(corrected(shipped, (*place, d)), POINTS)) for d in (DEPTH, 1e-3 * DEPTH)
    )
    assert np.all(shallow.max(axis=0) < 3e-3 * deep.max(axis=0))


def test_presses_far_from_both_ends_do_not_depend_on_the_length():
    """Nor on whether another press of the scene is near one."""
    fields = []
    for length, every in ((0.25, ((0.125,),)), (0.3, ((0.15,), (0.15, 0.29)))):
        outline = Rectangle(length, WIDTH)
        table, points = corrections(design_on(outline), MECHANICS, PUNCH), POINTS[:20].copy()
        points[:, 0] = 0.5 * length + 0.25 * (POINTS[:20, 0] - 0.075)
        for xs in every:
            places = np.array([[x, 0.02, DEPTH] for x in xs])
            sums = tables.rectangle_sums(table.design, len(xs), 4)
            _, extra = table.evaluate(places, np.arange(len(xs)), sums)
            field = sums.fields(table.design.thickness, table.scales)[0]
            fields.append((field.values(points[:, None])[:, 0].T, extra[0]))
    (here, sunk), *others = fields
    for there, deeper in others:
        scale = np.abs(here).max(axis=0)
        assert there / scale == pytest.approx(here / scale, abs=2e-3)
        assert deeper == pytest.approx(sunk)


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
        Indentations, "with_depths", lambda about, _: dataclasses.replace(about, dents=dents)
    )
    return Indentations(MECHANICS.stack(DESIGN), MECHANICS, Rigid(), PUNCH)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["strip", "side", "disc"])
def test_tables_hold_what_was_solved_about_each_press(kind, solved_bells) -> None:
    about, reports = solved_bells, []
    strip = [partial(solve_strip, about, WIDTH), partial(solve_end, about, WIDTH)]
    design, solvers, place = {
        "strip": (DESIGN, strip, lambda aside: (0.075, aside)),
        "side": (design_on(WIDE), [partial(solve_side, about)], lambda aside: (0.3, aside)),
        "disc": (
            design_on(ROUND),
            [partial(solve_disc, about, ROUND.radius)],
            lambda aside: (0.1 - aside, 0.05),
        ),
    }[kind]
    made = tuple(solve(lambda *done: reports.append(done)) for solve in solvers)
    assert reports[-1][0] == reports[-1][1]
    if kind == "side":
        assert made[0].sizes["along"] == pytest.approx(-made[0].sizes["along"][::-1])
    aside = float(made[0].nodes("distance_to_side")[2])
    x, y = place(aside)
    summed = (made, None, ()) if kind == "strip" else ((), made[0], ((made[0], 1.0),))
    found = corrected(Corrections(design, *summed), (x, y, 0.001))
    points = np.array([x, y, 0.0]) + np.random.default_rng(0).uniform(
        (-0.02, -min(aside, 0.02), 0.0), (0.5 * aside, 0.02, 0.005), (50, 3)
    )
    assert total(found, points) == pytest.approx(Bell(x, y, 0.001).in_gel(points), abs=2e-5)
    assert found[1] == pytest.approx(1e-4)


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
    corrected(found, (*middle, deepest))
    with pytest.raises(ConfigurationError, match="tabulated to a depth"):
        corrected(found, (*middle, 1.05 * deepest))
    for place in beside:
        with pytest.raises(ConfigurationError, match="from the edge"):
            corrected(found, (*place, 0.001))


# Pairs


def test_pairs_and_presses_on_other_outlines_and_bases_are_those_of_wide_stacks():
    """At the same distance the changes are those of the reference but for what its sides add."""
    touches = (0.04, 0.05, DEPTH), (0.065, 0.05, DEPTH)
    table = pair_corrections(design_on(ROUND), MECHANICS, PUNCH)
    wide, reference = corrected(table, *touches), pair(*touches)
    assert len(wide[0]) == 1
    assert total(wide, POINTS) == pytest.approx(total((reference[0][:1], 0.0), POINTS))
    assert wide[1] == reference[1]
    far = 0.01 + float(table.wide.nodes("axis_distance")[-1])
    assert corrected(table, (0.01, 0.03, DEPTH), (far, 0.03, DEPTH)) == ([], 0.0)
    flat = [DESIGN, design_on(Polygon(((0.0, 0.0), (0.2, 0.0), (0.1, 0.1)))), design_on(ROUND)]
    on = [dataclasses.replace(DESIGN, support=each) for each in (Substrate(0.01, 5e3), Plates())]
    assert all(map(is_tabulable, (*flat, *on)))
    loose = dataclasses.replace(flat[2], support=Plates())
    thick = dataclasses.replace(flat[1], encapsulated_thickness=0.06)
    assert not any(map(is_tabulable, (loose, thick, design_on(Disc(0.010)))))
    about = Indentations(MECHANICS.stack(DESIGN), MECHANICS, Rigid(), Cylinder(0.052))
    with pytest.raises(ConfigurationError, match="no room"):
        solve_disc(about, ROUND.radius, lambda *_: None)
    for radius, model in ((0.0075, "tabulated"), (0.006, "solved")):
        touch = Touch(0.075, 0.030, indenter=Cylinder(radius))
        assert resolve_touch_model((touch,), PressedSensor(DESIGN, MECHANICS)) == model


@pytest.mark.parametrize("second", [(0.085, 0.03), (0.068, 0.047), (0.06, 0.045), (0.075, 0.012)])
def test_pairs_are_the_same_seen_from_either_press_and_in_a_mirror(second) -> None:
    points = np.random.default_rng(3).uniform((0.03, 0, 0), (0.12, WIDTH, 0.005), (60, 3))
    places = (0.07, 0.03, 0.003), (*second, 0.0012)
    found, swapped = pair(*places), pair(*places[::-1])
    scale = np.abs(total(found, points)).max(axis=0)
    assert swapped[1] == pytest.approx(found[1])
    assert total(swapped, points) / scale == pytest.approx(total(found, points) / scale, abs=0.03)
    assert_mirrored(pair, places, 0.03, points)


# Neighbouring stacks


def needed(thickness, modulus):
    design = dataclasses.replace(DESIGN, thickness=thickness)
    mechanics = Mechanics(encapsulation=NeoHookean(modulus))
    return tables.TabledSensor(design, mechanics, PUNCH).stacks(SensorGrid(thickness=0.005))


@pytest.mark.parametrize("thickness", [0.0040, 0.005, 0.0054, 0.0063])
@pytest.mark.parametrize("modulus", [14e3, 18e3, 33e3, 65e3])
def test_weights_of_neighbours_are_those_of_a_quadratic(thickness, modulus) -> None:
    base, weights = needed(thickness, modulus)

    def quadratic(t, s):
        return 1.0 + 2.0 * t - 3.0 * t**2 + 0.5 * s + 4.0 * s**2

    def of(stack):
        t = np.log(stack.sheets[1].thickness / 0.005)
        return quadratic(t, np.log(stack.sheets[0].law.shear_modulus / 28e3))

    found = of(base) + sum(weight * of(stack) for stack, weight in weights.items())
    assert found == pytest.approx(quadratic(np.log(thickness / 0.005), np.log(modulus / 28e3)))
    assert sum(weights.values()) == pytest.approx(0.0, abs=1e-12)


# Files


def test_names_of_files_depend_on_everything_and_stresses_on_the_modulus(shipped):
    harder = dataclasses.replace(MECHANICS, encapsulation=NeoHookean(40e3))
    varied = [
        (DESIGN, MECHANICS, PUNCH),
        (design_on(Rectangle(0.150, 0.070)), MECHANICS, PUNCH),
        (DESIGN, Mechanics(margin=0.004), PUNCH),
        (DESIGN, harder, PUNCH),
        (DESIGN, Mechanics(bulk_ratio=1e3), PUNCH),
        (DESIGN, MECHANICS, Cylinder(0.006)),
        (DESIGN, MECHANICS, Cylinder(rough=False)),
    ]
    every = [{p.kind: p.name for p in correction_problems(*case, OWN_GRID)} for case in varied]
    # A pair on a wide stack has neither width nor margin. A harder encapsulation is two steps away.
    expected = {"strip": 6, "end": 6, "pair": 4, "pair-sides": 6}
    assert {kind: len({each[kind] for each in every}) for kind in expected} == expected
    problems = correction_problems(DESIGN, MECHANICS, PUNCH)
    assert every[0] == {p.kind: p.name for p in problems}
    assert store.missing(problems) == {}
    soft = Mechanics(gel=NeoHookean(10e3), encapsulation=NeoHookean(14e3))
    expected, found = (
        total(corrected(each, (0.04, 0.02, DEPTH)), POINTS)
        for each in (shipped, corrections(DESIGN, soft, PUNCH))
    )
    assert found == pytest.approx(expected * [1.0, 1.0, 1.0, 0.5])


# Independent solutions


def changes(sim: Simulator, *touches: Touch, bend: Bend = FLAT):
    """Changes of the impedances by touches, at the bend."""
    flat, pressed = (sim.measure(Scene(bend, each)).impedance.real for each in ((), touches))
    return (pressed - flat) / sim.measure(Scene()).impedance.real


@pytest.mark.slow
@pytest.mark.parametrize(
    ("support", "fineness", "bend", "touch", "limit"),
    [
        (Rigid(), Fineness(ends=0.0, growth=2.0), FLAT, Touch(0.062, 0.022, 4.0), 0.02),
        # Over the gap, between solved places and angles.
        (Plates(0.040), pressed_plates._FINENESS, Bend(35.0), Touch(0.0675, 0.0105, 2.0), 0.06),
    ],
    ids=["base", "gap"],
)
def test_tables_give_the_signals_of_solved_presses(
    support, fineness, bend, touch, limit, monkeypatch
) -> None:
    """On cells as coarse as the signals allow to 1 %, or as those of the table."""
    coarser = partial(pressed_sensor.stack_mesh, fineness=fineness)
    monkeypatch.setattr(pressed_sensor, "stack_mesh", coarser)
    design = dataclasses.replace(DESIGN, support=support)
    found, solved = (
        changes(Simulator(design, "fast", touch_model=model), touch, bend=bend)
        for model in ("tabulated", "solved")
    )
    assert np.linalg.norm(found - solved) < limit * np.linalg.norm(solved)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "limit"),
    [
        *(("independent_75_30", 0.02), ("independent_60_30", 0.02), ("15_15", 0.025)),
        *(("two_65_30_85_30", 0.055), ("two_60_30_90_30", 0.03), ("four_30", 0.025)),
    ],
)
def test_presses_give_the_signals_of_an_independent_solution(name, limit) -> None:
    (case,) = (case for case in cases() if case.name == name)
    sim = Simulator(DESIGN, "standard")
    found = changes(sim, *case.scene.touches)
    assert np.linalg.norm(found - case.changes) < limit * np.linalg.norm(case.changes)
    (pressed, *_) = sim.presses(case.scene)
    assert pressed.depth == pytest.approx(case.depth[0], rel=0.01)
