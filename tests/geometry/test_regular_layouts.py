"""Layouts: equal arc lengths on any outline, and grids of pads."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Electrode, Polygon, Rectangle, SensorDesign, Surface
from eitskin.geometry.design.regular_layouts import grid, uniform

L_SHAPE = Polygon(((0, 0), (0.09, 0), (0.09, 0.03), (0.04, 0.03), (0.04, 0.06), (0, 0.06)))


def test_the_reference_electrodes_are_a_uniform_layout():
    x = (0.0225, 0.075, 0.1275, 0.150, 0.1275, 0.075, 0.0225, 0.0)
    y = (0.0, 0.0, 0.0, 0.030, 0.060, 0.060, 0.060, 0.030)
    electrodes = tuple(map(Electrode, x, y))
    assert uniform(Rectangle(0.15, 0.06), 8, start=0.0225) == electrodes
    assert SensorDesign.reference().electrodes == electrodes


@pytest.mark.parametrize("outline", [Rectangle(0.15, 0.06), Disc(0.05), L_SHAPE])
@pytest.mark.parametrize("count", [2, 7, 32])
@pytest.mark.parametrize("start", [None, 0.0, 0.123, -0.02])
def test_any_count_stands_at_equal_arc_lengths(outline, count, start):
    made = uniform(outline, count, 0.004, start, 2e-3 + 1e-4j, height=0.002, z=0.003)
    pitch = outline.perimeter / count
    s = np.array([outline.locate(e.x, e.y) for e in made])
    first = pitch / 2 if start is None else start
    expected = first + pitch * np.arange(count)
    assert np.cos(2 * np.pi * (s - expected) / outline.perimeter) == pytest.approx(np.ones(count))
    assert {(e.width, e.contact_impedance, e.height, e.z, e.on) for e in made} == {
        (0.004, 2e-3 + 1e-4j, 0.002, 0.003, "side")
    }
    SensorDesign(outline, 0.005, made)


def test_a_grid_is_numbered_along_x_then_y():
    pads = grid(Rectangle(0.15, 0.06), rows=2, columns=3, size=0.01, on="bottom", shape="round")
    expected = [(x, y) for y in (0.015, 0.045) for x in (0.025, 0.075, 0.125)]
    assert [(p.x, p.y) for p in pads] == expected
    assert {(p.width, p.on, p.shape) for p in pads} == {(0.01, "bottom", "round")}


@pytest.mark.parametrize("outline", [Disc(0.05), L_SHAPE])
def test_a_grid_leaves_out_the_pads_that_do_not_fit(outline):
    pads = grid(outline, rows=9, columns=9, size=0.004, on="inside", z=0.002)
    assert 9 < len(pads) < 81
    for x in (np.arange(9) + 0.5) / 9 * outline.length:
        for y in (np.arange(9) + 0.5) / 9 * outline.width:
            corners = np.array([[x, y]]) + 0.002 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            fits = bool(outline.contains(corners).all())
            assert fits == any(np.allclose([p.x, p.y], [x, y]) for p in pads)
    SensorDesign(outline, 0.005, pads)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda o: uniform(o, 1), r"count.*2 to 1024.*1"),
        (lambda o: uniform(o, 8, start=float("nan")), r"start.*finite"),
        (lambda o: uniform(o, 8, width=-1.0), r"electrode width.*positive"),
        (lambda o: grid(o, 0, 3, 0.001), r"rows.*1 to 1024.*0"),
        (lambda o: grid(o, 100, 11, 0.001), r"100 rows.*1 to 10.*11"),
        (lambda o: grid(o, 2, 3, 0.04), r"0.03 m.*0.04 m"),
        (lambda _: grid(Disc(0.01), 1, 1, 0.019), "no pad"),
    ],
)
def test_layouts_that_cannot_be_are_refused(make, message):
    with pytest.raises(ConfigurationError, match=message):
        make(Rectangle(0.15, 0.06))


def test_layouts_want_a_plane_outline(tmp_path):
    import trimesh

    trimesh.creation.box(extents=[0.1, 0.1, 0.1]).export(tmp_path / "box.stl")
    for layout in (lambda s: uniform(s, 8), lambda s: grid(s, 2, 2, 0.001)):
        with pytest.raises(ConfigurationError, match="surface"):
            layout(Surface(tmp_path / "box.stl"))
