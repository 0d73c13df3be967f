"""Designs, their layouts, outlines and bodies."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.config import parse_toml
from eitskin.geometry import (
    Disc,
    Electrode,
    Free,
    Layer,
    Plates,
    Polygon,
    Rectangle,
    Rigid,
    SensorDesign,
    Substrate,
    Surface,
)
from eitskin.geometry.design.regular_layouts import grid, uniform

from on_demand import OnDemand

trimesh = OnDemand("trimesh")
REFERENCE = SensorDesign.reference()
L_SHAPE = Polygon(((0, 0), (0.09, 0), (0.09, 0.03), (0.04, 0.03), (0.04, 0.06), (0, 0.06)))


def on_a_ball(folder, **options):
    trimesh.creation.icosphere(subdivisions=3, radius=50.0).export(folder / "ball.stl")
    surface = Surface(folder / "ball.stl", scale=1e-3)
    pads = (
        Electrode(0.05, 0.0, 0.006, z=0.0, on="surface"),
        Electrode(0.0, 0.03, 0.008, z=0.04, on="surface", shape="round"),
    )
    return SensorDesign(surface, 0.1, pads, encapsulated_thickness=0.1, **options)


# Layers and supports


@pytest.mark.slow
def test_layers_conduct_by_height_and_surfaces_are_found_beside_the_design(tmp_path):
    layers = (Layer(0.001, 0.5), Layer(0.003, 2.0), Layer(0.001, 10.0))
    design = dataclasses.replace(REFERENCE, layers=layers)
    z = np.array([[-0.001, 0.0, 0.0009], [0.0011, 0.0039, 0.0041], [0.005, 0.006, 0.0025]])
    points = np.stack([np.full_like(z, 0.03), np.full_like(z, 0.02), z], axis=-1)
    expected = [[0.5, 0.5, 0.5], [2.0, 2.0, 10.0], [10.0, 10.0, 2.0]]
    assert np.array_equal(design.evaluate_conductivity(points), expected)
    plain = dataclasses.replace(design, layers=(), conductivity=0.7)
    assert np.array_equal(plain.evaluate_conductivity(points), np.full((3, 3), 0.7))
    assert Plates(0.03).gap(Rectangle(0.15, 0.06)) == pytest.approx((0.06, 0.09))
    # Those of a surface start at its lowest point.
    ball = on_a_ball(tmp_path, layers=(Layer(0.04, 1.0), Layer(0.06, 3.0)))
    assert np.array_equal(ball.evaluate_conductivity([[0, 0, -0.011], [0, 0, -0.009]]), [1.0, 3.0])
    design = on_a_ball(tmp_path)
    text = design.to_toml().replace(f"{tmp_path}/", "")
    assert 'file = "ball.stl"' in text
    (tmp_path / "sensor.toml").write_text(text)
    read = SensorDesign.from_toml(tmp_path / "sensor.toml")
    assert read == design
    (tmp_path / "elsewhere").mkdir()
    assert read.to_toml(tmp_path / "elsewhere" / "sensor.toml") == read.to_toml()
    assert SensorDesign.from_toml(tmp_path / "elsewhere" / "sensor.toml") == design


# Layouts


def test_layouts_are_uniform_and_of_any_outline():
    x = (0.0225, 0.075, 0.1275, 0.150, 0.1275, 0.075, 0.0225, 0.0)
    y = (0.0, 0.0, 0.0, 0.030, 0.060, 0.060, 0.060, 0.030)
    electrodes = tuple(map(Electrode, x, y))
    assert uniform(Rectangle(0.15, 0.06), 8, start=0.0225) == electrodes
    assert REFERENCE == SensorDesign(Rectangle(0.15, 0.06), 0.005, electrodes)
    assert (REFERENCE.conductivity, REFERENCE.encapsulated_thickness) == (1.0, 0.012)
    text = REFERENCE.to_toml().replace('support = "rigid"\n', "")
    assert parse_toml(SensorDesign, text) == REFERENCE
    text = "thickness = 0.005\noutline = { radius = 0.05 }\n[electrodes]\ncount = 16\nwidth = 0.008"
    design = parse_toml(SensorDesign, text + "\ncontact_impedance = [1e-3, -1e-4]")
    made = uniform(Disc(0.05), 16, width=0.008, contact_impedance=1e-3 - 1e-4j)
    assert design == SensorDesign(Disc(0.05), 0.005, made)
    assert design.to_toml().count("[[electrodes]]") == 16
    text = (
        text.partition("[")[0] + "[electrodes]\nrows = 3\ncolumns = 4\nsize = 0.01\non = 'bottom'"
    )
    assert parse_toml(SensorDesign, text).electrodes == grid(Disc(0.05), 3, 4, 0.01, on="bottom")


@pytest.mark.parametrize("outline", [Rectangle(0.15, 0.06), Disc(0.05), L_SHAPE])
@pytest.mark.parametrize(("count", "start"), [(7, None), (32, -0.02)])
def test_any_count_stands_at_equal_arc_lengths(outline, count, start):
    made = uniform(outline, count, 0.004, start, 2e-3 + 1e-4j, height=0.002, z=0.003)
    pitch = outline.perimeter / count
    s = np.array([outline.locate(e.x, e.y) for e in made])
    expected = (pitch / 2 if start is None else start) + pitch * np.arange(count)
    assert np.cos(2 * np.pi * (s - expected) / outline.perimeter) == pytest.approx(np.ones(count))
    assert {(e.width, e.contact_impedance, e.height, e.z, e.on) for e in made} == {
        (0.004, 2e-3 + 1e-4j, 0.002, 0.003, "side")
    }


@pytest.mark.parametrize("outline", [Rectangle(0.15, 0.06), Disc(0.05), L_SHAPE])
def test_a_grid_is_numbered_along_x_then_y_without_the_pads_that_do_not_fit(outline):
    pads = grid(outline, rows=9, columns=8, size=0.004, on="inside", z=0.002)
    fitting = []
    for y in (np.arange(9) + 0.5) / 9 * outline.width:
        for x in (np.arange(8) + 0.5) / 8 * outline.length:
            corners = np.array([[x, y]]) + 0.002 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            fitting += [(x, y)] if outline.contains(corners).all() else []
    assert np.array([(p.x, p.y) for p in pads]) == pytest.approx(np.array(fitting), abs=1e-12)
    assert (len(pads) == 72) == isinstance(outline, Rectangle)


# Files


@st.composite
def designs(draw):
    a, b = draw(st.floats(0.05, 0.5)), draw(st.floats(0.05, 0.5))
    corner = ((0.0, 0.0), (a, 0.0), (a, b / 2), (a / 2, b / 2), (a / 2, b), (0.0, b))
    outline = draw(st.sampled_from([Rectangle(a, b), Disc(a), Polygon(corner)]))
    thickness, z = draw(st.floats(1e-3, 1e-2)), draw(st.floats(1e-9, 1e3))
    z = draw(st.sampled_from([z, complex(z, draw(st.floats(-1e3, 1e3)))]))
    count, part = draw(st.integers(2, 9)), draw(st.sampled_from([None, 0.5]))
    height, middle = part and part * thickness, part and 0.4 * thickness
    width, start = outline.perimeter / count * 0.7, draw(st.floats(0.0, 1.0))
    side = uniform(outline, count, width, start, z, height, middle)
    on = draw(st.sampled_from(["top", "bottom", "inside"]))
    shape = draw(st.sampled_from(["rectangle", "round"]))
    inside = 0.3 * thickness if on == "inside" else None
    pads = grid(outline, 4, 4, 0.008, on, z, inside, shape)
    share, sigma = draw(st.floats(0.1, 0.9)), draw(st.floats(1e-6, 1e6))
    sheets = (Layer(share * thickness, sigma), Layer(thickness - share * thickness, 1.0))
    supports = (Rigid(), Plates(0.03), Substrate(0.01, 5e3), Free())
    return SensorDesign(
        outline,
        thickness,
        draw(st.sampled_from([side, pads, side + pads])),
        layers=draw(st.sampled_from([(), sheets])),
        encapsulated_thickness=draw(st.floats(0.01, 0.1)),
        support=draw(st.sampled_from(supports)),
    )


@pytest.mark.slow
@settings(max_examples=40, derandomize=True, database=None)
@given(designs())
def test_every_design_is_the_same_after_writing_and_reading(design) -> None:
    assert parse_toml(SensorDesign, design.to_toml()) == design


# Outlines and bodies


TRIANGLE = Polygon(((0.02, 0.0), (0.06, 0.03), (0.0, 0.04)))
OUTLINES = [Rectangle(0.15, 0.06), Disc(0.05), L_SHAPE, TRIANGLE]


@pytest.mark.parametrize(
    ("outline", "perimeter", "extent"),
    [
        (Rectangle(0.15, 0.06), 0.42, (0.15, 0.06)),
        (Disc(0.05), 0.1 * math.pi, (0.1, 0.1)),
        (TRIANGLE, 0.05 + math.hypot(0.06, 0.01) + math.hypot(0.02, 0.04), (0.06, 0.04)),
    ],
)
def test_extents_and_perimeter(outline, perimeter, extent):
    assert outline.perimeter == pytest.approx(perimeter, rel=1e-14)
    assert (outline.length, outline.width) == pytest.approx(extent, rel=1e-14)


def test_arc_length_runs_counter_clockwise_from_where_it_is_said_to():
    x, y = Rectangle(0.15, 0.06).rim_points([0.0, 0.15, 0.18, 0.21, 0.36, 0.39, 0.42]).T
    assert x == pytest.approx([0, 0.15, 0.15, 0.15, 0, 0, 0])
    assert y == pytest.approx([0, 0, 0.03, 0.06, 0.06, 0.03, 0])
    assert Disc(0.05).rim_points([0.0, 0.025 * math.pi]) == pytest.approx(
        np.array([[0.1, 0.05], [0.05, 0.1]])
    )
    assert L_SHAPE.rim_points(L_SHAPE.corners) == pytest.approx(np.array(L_SHAPE.points))
    assert Polygon(L_SHAPE.points[::-1]).points == (*L_SHAPE.points[-1:], *L_SHAPE.points[:-1])


@pytest.mark.parametrize("outline", OUTLINES)
def test_places_are_unit_speed_and_found_again_even_if_rounded(outline):
    s = np.linspace(0.0, outline.perimeter, 301)[:-1] + 1e-6
    places = outline.rim_points(s)
    turns = np.searchsorted(outline.corners, s)
    straight = turns[1:] == turns[:-1]
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(s)
    assert speed[straight] == pytest.approx(np.ones(straight.sum()), rel=1e-4)
    for digits in (5, 15):
        located = [outline.locate(x, y) for x, y in np.round(places, digits)]
        apart = np.abs(located - s)
        turned = outline.perimeter - apart  # rounding may go past the first corner
        assert np.minimum(apart, turned).max() < 10.0**-digits + 1e-12
    assert outline.rim_points(s + 2 * outline.perimeter) == pytest.approx(places, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("outline", OUTLINES)
@pytest.mark.parametrize("margin", [0.004, -0.004])
def test_margin_is_the_distance_from_the_rim_and_the_inside_has_greens_area(outline, margin):
    rng = np.random.default_rng(0)
    extent = 0.02 + max(outline.length, outline.width)
    points = rng.uniform(-0.01, extent - 0.01, size=(2000, 2))
    rim = outline.rim_points(np.linspace(0.0, outline.perimeter, 1001))
    distance = np.linalg.norm(points[:, None] - rim, axis=-1).min(axis=1)
    inside = outline.contains(points)
    x, y = rim.T
    area = 0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])
    assert inside.mean() * extent**2 == pytest.approx(area, rel=0.1)
    expected = inside & (distance > margin) if margin > 0 else inside | (distance < -margin)
    clear = np.abs(distance - abs(margin)) > 1e-4
    assert 10 < expected.sum() < 1900
    assert (outline.contains(points, margin) == expected)[clear].all()
    assert outline.contains(rim).all()


def surface(mesh, path, scale=1.0):
    mesh.export(path)
    return Surface(path, scale)


def volume(body):
    points, faces = body.triangles()
    return np.linalg.det(points[faces]).sum() / 6


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "off"])
def test_extents_and_volume_are_in_metres(tmp_path, ending):
    bounds = np.array([[1, 2, 3], [21, 12, 9]])
    body = surface(trimesh.creation.box(bounds=bounds), tmp_path / f"box.{ending}", 1e-3)
    assert (body.length, body.width, body.height) == pytest.approx((0.02, 0.01, 0.006))
    assert body.bounds == pytest.approx(bounds * 1e-3)
    assert volume(body) == pytest.approx(0.02 * 0.01 * 0.006, rel=1e-6)


def test_a_body_has_nearest_places_normals_and_cavities_and_is_read_again_when_changed(tmp_path):
    body = surface(trimesh.creation.box(extents=[2, 2, 2]), tmp_path / "box.stl")
    for point, place, normal in (
        ((0.3, 0.2, 5.0), (0.3, 0.2, 1.0), (0, 0, 1)),
        ((0.3, 0.2, 0.9), (0.3, 0.2, 1.0), (0, 0, 1)),
        ((-1.5, 0.2, 0.1), (-1.0, 0.2, 0.1), (-1, 0, 0)),
    ):
        found = body.nearest(np.array(point))
        assert found[0] == pytest.approx(np.array(place))
        assert found[1] == pytest.approx(np.array(normal))
    assert body.nearest(np.array([3.0, 4.0, 5.0]))[0] == pytest.approx(np.ones(3))
    box, hole = trimesh.creation.box(extents=[1, 1, 1]), trimesh.creation.icosphere(radius=0.3)
    body = surface(box, tmp_path / "box.stl")
    assert volume(body) == pytest.approx(1.0, rel=1e-6)
    hole.invert()
    surface(trimesh.util.concatenate([box, hole]), tmp_path / "box.stl")
    assert volume(body) == pytest.approx(1.0 + hole.volume, rel=1e-5)
