"""Where electrodes touch their body, which of them may be neighbours, and their edges."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Electrode, Polygon, Rectangle, SensorDesign, Surface
from eitskin.geometry.design.regular_layouts import uniform

SLAB = Rectangle(0.1, 0.05)
TRIANGLE = Polygon(((0.02, 0.0), (0.06, 0.03), (0.0, 0.04)))
# Two walls of 2 mm with a gap of 3 mm: parallel sides that look the same way.
HALF = [(0.0, 0.0), (0.0, 0.05), (0.002, 0.05), (0.002, 0.01)]
FORK = Polygon((*HALF, *((0.007 - x, y) for x, y in HALF[::-1])))
THICKNESS = 0.004


def within(patch, points, normals):
    """Which places (n, 3) of a boundary with these normals belong to a patch."""
    return np.any(
        [
            (points @ r.planes[:, :3].T <= r.planes[:, 3] + 1e-12).all(axis=1)
            & (normals @ r.normal > 0.5)
            for r in patch.regions
        ],
        axis=0,
    )


def side_of(outline, count=3000):
    """Random places on the side: arc length, height, place, outward normal."""
    rng = np.random.default_rng(0)
    s, z = rng.uniform(0, outline.perimeter, count), rng.uniform(0, THICKNESS, count)
    ahead, behind = outline.rim_points(s + 1e-9), outline.rim_points(s - 1e-9)
    along = (ahead - behind) / np.linalg.norm(ahead - behind, axis=1)[:, None]
    normals = np.column_stack([along[:, 1], -along[:, 0], np.zeros(count)])
    return s, z, np.column_stack([outline.rim_points(s), z]), normals


@pytest.mark.parametrize("outline", [SLAB, TRIANGLE, FORK, Disc(0.02)])
@pytest.mark.parametrize(("count", "height"), [(2, None), (5, 0.001)])
def test_a_side_patch_is_its_arc_times_its_height(outline, count, height):
    pitch = outline.perimeter / count
    z = None if height is None else 0.0012
    design = SensorDesign(
        outline, THICKNESS, uniform(outline, count, 0.7 * pitch, 0.1 * pitch, height=height, z=z)
    )
    s, heights, points, normals = side_of(outline)
    upright = np.ones(len(s), bool) if height is None else np.abs(heights - 0.0012) < height / 2
    for number, patch in enumerate(design.patches()):
        from_centre = (s - (0.1 + number) * pitch + outline.perimeter / 2) % outline.perimeter
        expected = (np.abs(from_centre - outline.perimeter / 2) < 0.35 * pitch) & upright
        assert expected.sum() > 50
        assert np.array_equal(within(patch, points, normals), expected)
        assert patch.area == pytest.approx(0.7 * pitch * (height or THICKNESS))
        lids = points * [1, 1, 0]
        assert not within(patch, lids, np.tile([0.0, 0.0, -1.0], (len(s), 1))).any()


@pytest.mark.parametrize(("on", "shape"), [("top", "rectangle"), ("bottom", "round")])
def test_a_pad_is_its_shape_on_its_face(on, shape):
    pad = Electrode(0.03, 0.02, width=0.02, height=0.01, on=on, shape=shape)
    other = Electrode(0.08, 0.02, on="top")
    patch = SensorDesign(SLAB, THICKNESS, (pad, other)).patches()[0]
    x, y = np.random.default_rng(0).uniform([0, 0], [0.1, 0.05], size=(5000, 2)).T
    u, v = np.abs((x - 0.03) / 0.01), np.abs((y - 0.02) / 0.005)
    expected = (u < 1) & (v < 1) if shape == "rectangle" else np.hypot(u, v) < 1
    clear = np.abs(np.hypot(u, v) - 1) > 0.01 if shape == "round" else np.ones_like(expected)
    for face, z in (("top", THICKNESS), ("bottom", 0.0)):
        points = np.column_stack([x, y, np.full_like(x, z)])
        normals = np.tile([0.0, 0.0, 1.0 if face == "top" else -1.0], (len(x), 1))
        found = within(patch, points, normals)
        assert np.array_equal(found[clear], expected[clear] & (face == on))
    area = 0.02 * 0.01 * (math.pi / 4 if shape == "round" else 1.0)
    assert patch.area == pytest.approx(area, rel=1e-12)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    import trimesh

    path = tmp_path_factory.mktemp("ball") / "ball.stl"
    trimesh.creation.icosphere(subdivisions=5, radius=0.05).export(path)
    return Surface(path)


def on_ball(ball, *pads):
    return SensorDesign(ball, 0.1, pads, encapsulated_thickness=0.1)


def test_a_pad_on_a_surface_covers_what_lies_under_it(ball):
    """A disc of radius a over a sphere of radius R covers a cap of 2 pi R (R - sqrt(R2 - a2))."""
    R, a = 0.05, 0.02
    design = on_ball(
        ball,
        Electrode(0.051, 0.0, 2 * a, z=0.0, on="surface", shape="round"),
        Electrode(-0.02, 0.01, 0.01, height=0.02, z=-0.05, on="surface"),
    )
    cap = 2 * math.pi * R * (R - math.sqrt(R**2 - a**2))
    first, second = design.patches()
    # The 32 sides and the facets of the sphere make up for the rest.
    assert first.area == pytest.approx(cap, rel=2e-3)
    assert 1.0 < second.area / (0.01 * 0.02) < 1.05
    assert within(first, np.array([[R, 0, 0], [R * 0.95, 0, 0.015]]), np.eye(3)[[0, 0]]).all()
    assert not within(first, np.array([[-R, 0, 0], [R * 0.9, 0, 0.021]]), -np.eye(3)[[0, 0]]).any()


def test_width_on_a_surface_is_horizontal_as_on_the_side_and_along_x_on_top(ball):
    pads = [(0.05, 0.0, 0.0), (0.0, -0.05, 0.0), (0.0, 0.0, 0.05)]
    design = on_ball(ball, *(Electrode(x, y, 0.01, 1e-3, 0.004, z, "surface") for x, y, z in pads))
    extents = []
    for patch in design.patches():
        (region,) = patch.regions
        room = region.planes[:, 3] - region.planes[:, :3] @ (0.05 * region.normal)
        extents.append(np.abs(region.planes[np.abs(room - 0.005) < 1e-4, :3]).max(axis=0))
    assert np.array(extents) == pytest.approx(np.eye(3)[[1, 0, 0]], abs=2e-2)


def test_pads_on_a_surface_are_kept_apart(ball):
    """Pads 10 mm wide on a ball of 50 mm radius meet where they are 0.2 rad apart."""
    first, fits, overlaps = (
        Electrode(0.05 * math.cos(a), 0.05 * math.sin(a), 0.01, z=0.0, on="surface")
        for a in (0.0, 0.25, 0.19)
    )
    on_ball(ball, first, fits)
    with pytest.raises(ConfigurationError, match="0 and 1 overlap"):
        on_ball(ball, first, overlaps)


def test_edges_have_both_ends_however_wide_the_spacing():
    round_the_corner = Electrode(0.0, 0.002, 0.01, height=0.002)
    pad = Electrode(0.03, 0.025, 0.01, height=0.02, on="top")
    edges = SensorDesign(SLAB, THICKNESS, (round_the_corner, pad)).edges(spacing=1.0)
    corners = [(x, y, THICKNESS) for x in (0.025, 0.035) for y in (0.015, 0.035)]
    corners += [(x, y, z) for x, y in ((0, 0.007), (0, 0), (0.003, 0)) for z in (0.001, 0.003)]
    assert {tuple(p) for p in (edges + 0.0).round(9).tolist()} == set(corners)


def test_edges_run_around_what_lies_within_a_face():
    part = Electrode(0.03, 0.0, height=0.002, z=0.002)
    standing = Electrode(0.06, 0.0, height=0.002, z=0.001)
    pad = Electrode(0.03, 0.025, 0.01, on="top", shape="round")
    x, y, z = SensorDesign(SLAB, THICKNESS, (part, standing, pad)).edges(spacing=2e-4).T
    upright = y == 0.0
    for at, heights in ((0.03, [0.001, 0.003]), (0.06, [0.002])):
        under = upright & (np.abs(x - at) < 0.002)
        assert np.unique(z[under].round(9)) == pytest.approx(heights)
        assert np.diff(np.sort(x[under & np.isclose(z, heights[0])])).max() <= 2e-4 * 1.001
    assert z[~upright] == pytest.approx(THICKNESS)
    assert np.hypot(x - 0.03, y - 0.025)[~upright] == pytest.approx(0.005, rel=0.005)


def part(x, z):
    return Electrode(x, 0.0, height=0.001, z=z)


@pytest.mark.parametrize(
    "electrodes",
    [
        (Electrode(0.02, 0.0), Electrode(0.025, 0.0)),
        (Electrode(0.0025, 0.0), Electrode(0.0, 0.0025)),
        (part(0.02, 0.001), part(0.021, 0.002)),
        (Electrode(0.02, 0.02, on="top"), Electrode(0.02, 0.02, on="bottom")),
        (Electrode(0.02, 0.0025, on="top"), Electrode(0.02, 0.0)),
        [Electrode(0.02, 0.02, z=z, on="inside") for z in (0.001, 0.002)],
    ],
)
def test_electrodes_may_touch_or_lie_over_each_other(electrodes):
    SensorDesign(SLAB, THICKNESS, tuple(electrodes))


SIZES = st.floats(0.004, 0.02)


@settings(max_examples=40, derandomize=True, deadline=None, database=None)
@given(st.lists(SIZES, min_size=4, max_size=4), st.floats(0, 6.3), st.floats(0.0, 0.02))
def test_pads_overlap_where_a_place_is_in_both(sizes, turn, apart):
    """Ellipses, as polygons, against many places tried one by one."""
    x, y = 0.05 + apart * math.cos(turn), 0.025 + apart * math.sin(turn)
    first = Electrode(0.05, 0.025, sizes[0], height=sizes[1], on="top", shape="round")
    second = Electrode(x, y, sizes[2], height=sizes[3], on="top", shape="round")
    assume(0.01 < y < 0.04)
    places = np.random.default_rng(0).uniform(-0.01, 0.01, size=(4000, 2))
    common = [
        np.hypot((places[:, 0] + 0.05 - e.x) / e.width, (places[:, 1] + 0.025 - e.y) / e.height)
        for e in (first, second)
    ]
    depth = 0.5 - np.maximum(*common).min()
    assume(abs(depth) > 0.02)
    if depth < 0:
        SensorDesign(SLAB, THICKNESS, (first, second))
        return
    with pytest.raises(ConfigurationError, match="electrodes 0 and 1 overlap"):
        SensorDesign(SLAB, THICKNESS, (first, second))
