"""Sensor designs: the reference, layers, TOML in and out, and what is refused."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eitskin.config import parse_toml
from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Electrode, Layer, Polygon, Rectangle, SensorDesign, Surface
from eitskin.geometry.design.regular_layouts import grid, uniform

PAGE = Path(__file__).resolve().parents[2] / "docs" / "sensor-design.md"
SLAB = Rectangle(0.1, 0.05)
LEFT, RIGHT = Electrode(0.0, 0.025), Electrode(0.1, 0.025)


# Layers


@pytest.mark.parametrize("spacing", [float("nan"), float("inf"), 0.0, -1.0, 5e-324, 1e-12])
def test_edges_have_points_at_a_spacing_that_can_be(spacing):
    with pytest.raises(ConfigurationError, match="spacing"):
        SensorDesign.reference().edges(spacing)


def test_conductivity_is_that_of_the_layer_at_each_height() -> None:
    layers = (Layer(0.001, 0.5), Layer(0.003, 2.0), Layer(0.001, 10.0))
    design = SensorDesign(SLAB, 0.005, (LEFT, RIGHT), layers=layers)
    z = np.array([[-0.001, 0.0, 0.0009], [0.0011, 0.0039, 0.0041], [0.005, 0.006, 0.0025]])
    points = np.stack([np.full_like(z, 0.03), np.full_like(z, 0.02), z], axis=-1)
    expected = [[0.5, 0.5, 0.5], [2.0, 2.0, 10.0], [10.0, 10.0, 2.0]]
    assert np.array_equal(design.conductivity_at(points), expected)
    plain = dataclasses.replace(design, layers=(), conductivity=0.7)
    assert np.array_equal(plain.conductivity_at(points), np.full((3, 3), 0.7))


def test_layers_of_a_surface_start_at_its_lowest_point(tmp_path) -> None:
    design = on_a_ball(tmp_path, layers=(Layer(0.04, 1.0), Layer(0.06, 3.0)))
    points = np.array([[0.0, 0.0, -0.011], [0.0, 0.0, -0.009]])
    assert np.array_equal(design.conductivity_at(points), [1.0, 3.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *(({"thickness": t}, r"thickness.*positive") for t in (0.0, -1.0, math.nan, math.inf)),
        ({"layers": (Layer(0.002, 1.0), Layer(0.002, 1.0))}, r"0.005 m.*0.004 m"),
        ({"layers": (Layer(0.005, 1.0),), "conductivity": 2.0}, "conductivity or lay"),
        ({"conductivity": 0.0}, r"conductivity.*positive.*S/m"),
        ({"thickness": 0.013}, r"encapsulated_thickness.*least"),
        ({"thickness": 5.0}, r"encapsulated_thickness.*least"),
        ({"encapsulated_thickness": 12.0}, r"1 um and 10 m.*12 m"),
    ],
)
def test_materials_that_cannot_be_or_contradict_each_other_are_refused(changes, message) -> None:
    with pytest.raises(ConfigurationError, match=message):
        dataclasses.replace(SensorDesign.reference(), **changes)
    for thickness, conductivity in ((0.0, 1.0), (0.001, -1.0)):
        with pytest.raises(ConfigurationError, match=r"layer .*positive"):
            Layer(thickness, conductivity)


# TOML


def on_a_ball(folder, **options):
    import trimesh

    trimesh.creation.icosphere(subdivisions=3, radius=50.0).export(folder / "ball.stl")
    surface = Surface(folder / "ball.stl", scale=1e-3)
    pads = (
        Electrode(0.05, 0.0, 0.006, z=0.0, on="surface"),
        Electrode(0.0, 0.03, 0.008, z=0.04, on="surface", shape="round"),
    )
    return SensorDesign(surface, 0.1, pads, encapsulated_thickness=0.1, **options)


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


LENGTHS = st.floats(0.05, 0.5)
Z = st.one_of(
    st.floats(1e-9, 1e3),
    st.builds(complex, st.floats(1e-9, 1e3), st.floats(-1e3, 1e3)),
)


@st.composite
def outlines(draw):
    a, b = draw(LENGTHS), draw(LENGTHS)
    corner = ((0.0, 0.0), (a, 0.0), (a, b / 2), (a / 2, b / 2), (a / 2, b), (0.0, b))
    return draw(st.sampled_from([Rectangle(a, b), Disc(a), Polygon(corner)]))


@st.composite
def designs(draw):
    outline, thickness = draw(outlines()), draw(st.floats(1e-3, 1e-2))
    count, z = draw(st.integers(2, 9)), draw(Z)
    part = draw(st.sampled_from([None, 0.5]))
    side = uniform(
        outline, count, outline.perimeter / count * 0.7, draw(st.floats(0.0, 1.0)), z,
        height=part and part * thickness, z=part and 0.4 * thickness,
    )  # fmt: skip
    on = draw(st.sampled_from(["top", "bottom", "inside"]))
    shape = draw(st.sampled_from(["rectangle", "round"]))
    inside = 0.3 * thickness if on == "inside" else None
    pads = grid(outline, 4, 4, 0.008, on, z, inside, shape)
    share, sigma = draw(st.floats(0.1, 0.9)), draw(st.floats(1e-6, 1e6))
    sheets = (Layer(share * thickness, sigma), Layer(thickness - share * thickness, 1.0))
    return SensorDesign(
        outline,
        thickness,
        draw(st.sampled_from([side, pads, side + pads])),
        layers=draw(st.sampled_from([(), sheets])),
        encapsulated_thickness=draw(st.floats(0.01, 0.1)),
    )


@pytest.mark.slow
@settings(max_examples=60, derandomize=True, deadline=None, database=None)
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


EXAMPLES = re.findall("```toml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_examples_of_the_page_are_designs(tmp_path, number) -> None:
    import trimesh

    capsule = trimesh.creation.capsule(height=40.0, radius=8.0).apply_translation((0, 0, 20))
    capsule.export(tmp_path / "fingertip.stl")
    (tmp_path / "sensor.toml").write_text(EXAMPLES[number], encoding="utf-8")
    design = SensorDesign.from_toml(tmp_path / "sensor.toml")
    assert len(design.electrodes) == [8, 32, 12, 3, 8, 8, 4, 3, 2, 12][number]
    if number == 0:
        assert design == SensorDesign.reference()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("thickness = 0.005", "`outline`"),
        ("thicknes = 0.005", "did you mean 'thickness'"),
        ("thickness = ", "not valid TOML"),
        ("outline = { radus = 1 }", r"outline.*Disc \(radius\).*'radius'"),
        ("electrodes = { count = 8 }", r"`outline`.*layout"),
        ("outline = { radius = 0.1 }\nelectrodes = { cuont = 8 }", "did you mean 'count'"),
        ("outline = { radius = 0.1 }\nelectrodes = { count = 8, rows = 2 }", r"uniform \(count, "),
        ("outline = { radius = 0.1 }\nelectrodes = { count = 1 }", "electrodes: .*count"),
        ("electrodes = [{ x = 0, y = 0, width = -1 }]", r"electrodes\[0\].*width"),
        ("electrodes = [{ x = 0, y = 0, on = 'up' }]", r"electrodes\[0\].on.*'side' or 'top'"),
    ],
)
def test_unreadable_designs_say_why(tmp_path, text, message) -> None:
    path = tmp_path / "sensor.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=message):
        SensorDesign.from_toml(path)
    with pytest.raises(ConfigurationError, match=r"none\.toml"):
        SensorDesign.from_toml(tmp_path / "none.toml")


def test_lists_of_electrodes_and_layers_make_the_same_design() -> None:
    reference = SensorDesign.reference()
    listed = dataclasses.replace(reference, electrodes=list(reference.electrodes), layers=[])
    assert listed == reference
    assert hash(listed) == hash(reference)
