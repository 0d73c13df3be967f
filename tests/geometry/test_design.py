"""Sensor designs: the reference, layers, supports, layouts, and their files."""

import dataclasses

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


def test_conductivity_is_that_of_the_layer_at_each_height(tmp_path) -> None:
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


# Layouts


def test_the_reference_electrodes_are_a_uniform_layout():
    x = (0.0225, 0.075, 0.1275, 0.150, 0.1275, 0.075, 0.0225, 0.0)
    y = (0.0, 0.0, 0.0, 0.030, 0.060, 0.060, 0.060, 0.030)
    electrodes = tuple(map(Electrode, x, y))
    assert uniform(Rectangle(0.15, 0.06), 8, start=0.0225) == electrodes
    assert REFERENCE == SensorDesign(Rectangle(0.15, 0.06), 0.005, electrodes)
    assert (REFERENCE.conductivity, REFERENCE.encapsulated_thickness) == (1.0, 0.012)
    text = REFERENCE.to_toml().replace('support = "rigid"\n', "")
    assert parse_toml(SensorDesign, text) == REFERENCE


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


def test_a_surface_is_found_beside_the_design_and_after_writing_elsewhere(tmp_path) -> None:
    design = on_a_ball(tmp_path)
    text = design.to_toml().replace(f"{tmp_path}/", "")
    assert 'file = "ball.stl"' in text
    (tmp_path / "sensor.toml").write_text(text)
    read = SensorDesign.from_toml(tmp_path / "sensor.toml")
    assert read == design
    (tmp_path / "elsewhere").mkdir()
    assert read.to_toml(tmp_path / "elsewhere" / "sensor.toml") == read.to_toml()
    assert SensorDesign.from_toml(tmp_path / "elsewhere" / "sensor.toml") == design


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


@settings(max_examples=40, derandomize=True, deadline=None, database=None)
@given(designs())
def test_every_design_is_the_same_after_writing_and_reading(design) -> None:
    assert parse_toml(SensorDesign, design.to_toml()) == design


def test_electrodes_may_be_a_layout_of_any_outline() -> None:
    text = "thickness = 0.005\noutline = { radius = 0.05 }\n[electrodes]\ncount = 16\nwidth = 0.008"
    design = parse_toml(SensorDesign, text + "\ncontact_impedance = [1e-3, -1e-4]")
    made = uniform(Disc(0.05), 16, width=0.008, contact_impedance=1e-3 - 1e-4j)
    assert design == SensorDesign(Disc(0.05), 0.005, made)
    assert design.to_toml().count("[[electrodes]]") == 16
    text = (
        text.partition("[")[0] + "[electrodes]\nrows = 3\ncolumns = 4\nsize = 0.01\non = 'bottom'"
    )
    assert parse_toml(SensorDesign, text).electrodes == grid(Disc(0.05), 3, 4, 0.01, on="bottom")
