"""Corrections of presses on discs: symmetry, solved positions, range, names and neighbours."""

import dataclasses
import math

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Plates, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.design.sensor import Rigid
from eitskin.simulator import Cylinder, Mechanics, Scene, Simulator, Touch
from eitskin.simulator.mechanics.materials import NeoHookean
from eitskin.simulator.presses import correction_store as store
from eitskin.simulator.presses import disc_table
from eitskin.simulator.presses.corrections import DiscCorrections
from eitskin.simulator.presses.disc_table import DiscTable, solve_disc

RADIUS, HEIGHT, DEEPEST = 0.05, 0.005, 0.003
OUTLINE, MECHANICS, PUNCH = Disc(RADIUS), Mechanics(), Cylinder()
DESIGN = SensorDesign(OUTLINE, HEIGHT, uniform(OUTLINE, 8))


def correction(points, aside, depth):
    """Correction, symmetric as any is, of a press on the x axis of a disc about the origin."""
    x, y, z = np.moveaxis(points, -1, 0) / np.array([RADIUS, RADIUS, HEIGHT])[:, None]
    r = 1.0 - aside / RADIUS
    amount = depth * (1.0 + 40.0 * depth)
    along = (x - 0.3 * r) * (1.0 + x * r) * (1.0 + z)
    across = y * (1.0 + 0.5 * x * r) * (1.0 + z)
    upward = (1.0 + r**2 + x * r - 0.2 * (x**2 + y**2)) * z**2
    return amount * np.stack([along, across, upward, 1e5 * upward], axis=-1)


@pytest.fixture(scope="module")
def table() -> DiscTable:
    """Table whose solved presses are those of `correction`."""
    aside = np.append(0.004 + 0.012 * np.array([0.0, 0.3, 0.8, 1.4, 2.2]), RADIUS)
    depths = np.array([0.0, 0.001, 0.002, DEEPEST])
    nodes = np.linspace(-1.01 * RADIUS, 1.01 * RADIUS, 13)
    fields = [
        [
            disc_table.SplineField.of(
                lambda points, a=a, d=d: correction(points.reshape(-1, 3), a, d).reshape(
                    *points.shape[:-1], 4
                ),
                (nodes, nodes),
                HEIGHT,
                2,
            ).coefficients
            for d in depths[1:]
        ]
        for a in aside
    ]
    sunk = np.outer((1.0 - aside / RADIUS) ** 2, depths[1:])
    return DiscTable(
        thickness=np.array(0.012),
        radius=np.array(RADIUS),
        height=np.array(HEIGHT),
        aside=aside,
        depths=depths,
        nodes=nodes,
        fields=np.array(fields),
        sunk=sunk,
    )


def disc_points(count=40):
    rng = np.random.default_rng(4)
    r, angle = RADIUS * np.sqrt(rng.uniform(size=count)), rng.uniform(0.0, 2.0 * math.pi, count)
    z = rng.uniform(0.0, HEIGHT, count)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)


def values(field, points):
    """Displacement and mean stress at points from the middle of the disc, (n, 4)."""
    return field.values(points[:, None] + np.array([RADIUS, RADIUS, 0.0]))[:, 0].T


def turn(angle):
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def test_a_solved_press_is_the_solved_one(table) -> None:
    points = disc_points()
    for k, aside in enumerate(table.aside):
        for j, depth in enumerate(table.depths[1:]):
            field, sunk = table.at(2.0 * RADIUS - aside, RADIUS, float(depth))
            expected = correction(points, aside, depth)
            scale = np.abs(expected).max(axis=0)
            assert values(field, points) / scale == pytest.approx(expected / scale, abs=1e-9)
            assert sunk == pytest.approx(table.sunk[k, j])


@pytest.mark.parametrize("distance", [0.0, 0.01, 0.031])
def test_a_press_between_solved_ones_is_interpolated(table, distance) -> None:
    points, depth = disc_points(), 0.0015
    field, _ = table.at(RADIUS + distance, RADIUS, depth)
    expected = correction(points, RADIUS - distance, depth)
    scale = np.abs(expected).max(axis=0)
    assert values(field, points) / scale == pytest.approx(expected / scale, abs=1e-9)


@pytest.mark.parametrize("angle", [0.4, 2.0, math.pi, 5.0])
def test_a_press_at_an_azimuth_is_one_on_the_axis_turned(table, angle) -> None:
    points, distance, Q = disc_points(), 0.034, turn(angle)
    there, sunk = table.at(RADIUS + distance, RADIUS, 0.002)
    place = RADIUS + distance * Q[:2, 0]
    turned, below = table.at(*place.tolist(), 0.002)
    expected = values(there, points)
    expected[:, :3] = expected[:, :3] @ Q.T
    assert values(turned, points @ Q.T) == pytest.approx(expected, rel=1e-6, abs=1e-12)
    assert below == pytest.approx(sunk)


def test_the_field_is_continuous_where_a_press_crosses_the_middle(table) -> None:
    points = disc_points()
    sides = [values(table.at(RADIUS + x, RADIUS, 0.002)[0], points) for x in (-1e-7, 1e-7)]
    assert sides[0] == pytest.approx(sides[1], rel=1e-4, abs=1e-8)


def test_the_whole_rim_moves(table) -> None:
    angle = np.linspace(0.0, 2.0 * math.pi, 50)
    rim = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1) * RADIUS
    columns = rim[:, None] + np.array([RADIUS, RADIUS, 0.5 * HEIGHT])
    field, _ = table.at(0.06, 0.07, 0.002)
    assert field.moved(columns)[:3, 0] == pytest.approx(field.values(columns)[:3, 0], rel=1e-6)


def test_presses_beyond_the_table_are_refused(table) -> None:
    found = DiscCorrections(HEIGHT, table, ((table, 1.0),))
    found.at(0.08, 0.07, DEEPEST)
    with pytest.raises(ConfigurationError, match=r"tabulated to a depth .* touch_model='solved'"):
        found.at(0.08, 0.07, 1.05 * DEEPEST)
    with pytest.raises(ConfigurationError, match=r"keep 4.0 mm from the edge"):
        found.at(0.09, 0.08, 0.001)


def test_a_thicker_gel_has_the_field_of_a_press_as_deep_in_proportion(table) -> None:
    points, taller = disc_points(), 1.1
    (field,), sunk = DiscCorrections(taller * HEIGHT, table, ((table, 1.0),)).at(
        0.07, 0.06, taller * 0.002
    )
    own, below = table.at(0.07, 0.06, 0.002)
    expected = values(own, points) * np.array([1.0, 1.0, taller, 1.0])
    assert values(field, points * np.array([1.0, 1.0, taller])) == pytest.approx(expected)
    assert sunk == pytest.approx(taller * below)


def test_weighted_tables_add_up(table) -> None:
    points = disc_points()
    whole = DiscCorrections(HEIGHT, table, ((table, 1.0),)).at(0.07, 0.06, 0.002)
    parts = DiscCorrections(HEIGHT, table, ((table, 1.3), (table, -0.3))).at(0.07, 0.06, 0.002)
    expected = values(whole[0][0], points)
    assert sum(values(each, points) for each in parts[0]) == pytest.approx(expected)
    assert parts[1] == pytest.approx(whole[1])


# Which discs, and which tables


def test_discs_on_supports_that_are_alike_everywhere_are_tabulated() -> None:
    small = Disc(0.010)
    assert store.tabulable(DESIGN)
    assert not store.tabulable(dataclasses.replace(DESIGN, support=Plates()))
    assert not store.tabulable(SensorDesign(small, HEIGHT, uniform(small, 4)))


def test_specimens_share_tables_and_differ_in_their_weights() -> None:
    thicker = dataclasses.replace(DESIGN, thickness=0.0052, encapsulated_thickness=0.01248)
    softer = Mechanics(solved_thickness=HEIGHT, encapsulation=NeoHookean(26e3))
    base, weights = store._needed(thicker, softer)
    assert sum(weights.values()) == pytest.approx(1.0)
    assert len(weights) == 5
    assert base in weights
    names = {store._name(thicker, stack, softer, PUNCH) for stack in weights}
    assert len(names) == 5
    assert set(store._names(DESIGN, MECHANICS, PUNCH)) < names
    larger = SensorDesign(Disc(0.06), HEIGHT, uniform(Disc(0.06), 8))
    assert not names & set(store._names(larger, MECHANICS, PUNCH))


def test_a_stored_table_takes_the_place_of_solving(table, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    calls = []
    monkeypatch.setattr(store, "solve_disc", lambda *given: calls.append(given) or table)
    assert len(store.missing(DESIGN, MECHANICS, PUNCH)) == 1  # pairs are shipped
    store.corrections.cache_clear()
    try:
        store.prepare(DESIGN, MECHANICS, PUNCH)
        assert not store.missing(DESIGN, MECHANICS, PUNCH)
        found = store.corrections(DESIGN, MECHANICS, PUNCH)
        touch = Scene(touches=(Touch(0.07, 0.06, 2.0),))
        impedance = Simulator(DESIGN, "coarse", touch_model="tabulated").measure(touch).impedance
    finally:
        store.corrections.cache_clear()
    assert len(calls) == 1
    assert np.isfinite(impedance).all()
    assert found.base.fields == pytest.approx(table.fields, abs=1e-3 * np.abs(table.fields).max())


# Solved presses


def test_presses_are_solved_from_the_rim_to_the_middle(monkeypatch) -> None:
    monkeypatch.setattr(disc_table, "DEPTHS", (0.1, 0.2))
    monkeypatch.setattr(disc_table, "dents_to", lambda *_: [Dent(0.001), Dent(0.002)])
    seen = []

    def solved(_body, x, y, _indenter, dents):
        seen.append((x, y))
        return [Found(x, dent.depth) for dent in dents]

    monkeypatch.setattr(disc_table, "rising_corrections", solved)
    reports = []
    stack = MECHANICS.stack(DESIGN)
    found = solve_disc(
        OUTLINE, stack, MECHANICS, Rigid(), PUNCH, lambda *done: reports.append(done)
    )
    assert reports == [(k + 1, len(seen)) for k in range(len(seen))]
    assert [x for x, _ in seen] == pytest.approx(2.0 * RADIUS - found.aside)
    assert seen[-1] == pytest.approx((RADIUS, RADIUS))
    points, aside = disc_points(), float(found.aside[1])
    field, _ = found.at(2.0 * RADIUS - aside, RADIUS, 0.002)
    assert values(field, points) == pytest.approx(correction(points, aside, 0.002), abs=1e-9)


def test_an_indenter_too_large_for_the_disc_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"no room .* touch_model='solved'"):
        solve_disc(OUTLINE, MECHANICS.stack(DESIGN), MECHANICS, Rigid(), Cylinder(0.052))


@dataclasses.dataclass
class Dent:
    depth: float


@dataclasses.dataclass
class Found:
    """Correction of `correction` on a disc that lies in the first quadrant."""

    x: float
    depth: float

    @property
    def sunk(self):
        return np.array([0.1 * self.depth])

    def in_gel(self, points):
        flat = points.reshape(-1, 3) - np.array([RADIUS, RADIUS, 0.0])
        found = correction(flat, 2.0 * RADIUS - self.x, self.depth)
        return found.reshape(*points.shape[:-1], 4)
