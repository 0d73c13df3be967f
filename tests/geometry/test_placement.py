"""Electrodes: the patches that they cover on outlines, surfaces and meshes."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Electrode, Polygon, Rectangle, SensorDesign, Surface
from eitskin.geometry.design.patches import FACES, Patch, Region, electrode_contacts
from eitskin.geometry.design.regular_layouts import uniform

import cut_blocks

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


@pytest.mark.slow
def test_pads_on_a_surface_cover_what_lies_under_them_along_x_and_apart(ball):
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
    pads = [(0.05, 0.0, 0.0), (0.0, -0.05, 0.0), (0.0, 0.0, 0.05)]
    design = on_ball(ball, *(Electrode(x, y, 0.01, 1e-3, 0.004, z, "surface") for x, y, z in pads))
    extents = []
    for patch in design.patches():
        (region,) = patch.regions
        room = region.planes[:, 3] - region.planes[:, :3] @ (0.05 * region.normal)
        extents.append(np.abs(region.planes[np.abs(room - 0.005) < 1e-4, :3]).max(axis=0))
    assert np.array(extents) == pytest.approx(np.eye(3)[[1, 0, 0]], abs=2e-2)
    # Pads 10 mm wide on a ball of 50 mm radius meet where they are 0.2 rad apart.
    first, fits, overlaps = (
        Electrode(0.05 * math.cos(a), 0.05 * math.sin(a), 0.01, z=0.0, on="surface")
        for a in (0.0, 0.25, 0.19)
    )
    on_ball(ball, first, fits)
    with pytest.raises(ConfigurationError, match="0 and 1 overlap"):
        on_ball(ball, first, overlaps)


def test_edges_have_both_ends_and_run_around_what_lies_within_a_face():
    round_the_corner = Electrode(0.0, 0.002, 0.01, height=0.002)
    pad = Electrode(0.03, 0.025, 0.01, height=0.02, on="top")
    edges = SensorDesign(SLAB, THICKNESS, (round_the_corner, pad)).edges(spacing=1.0)
    corners = [(x, y, THICKNESS) for x in (0.025, 0.035) for y in (0.015, 0.035)]
    corners += [(x, y, z) for x, y in ((0, 0.007), (0, 0), (0.003, 0)) for z in (0.001, 0.003)]
    assert {tuple(p) for p in (edges + 0.0).round(9).tolist()} == set(corners)
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


@settings(max_examples=40, derandomize=True, database=None)
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


# Patches of meshes


COUNTS = (7, 5, 3)
SIZE = np.array([0.03, 0.02, 0.006])
KINDS = [8, 6, 4]


def box_region(low, high, normal):
    eye = np.eye(3)
    return Region(
        np.vstack([np.column_stack([eye, high]), np.column_stack([-eye, -np.asarray(low)])]),
        np.asarray(normal, dtype=float),
    )


def moments(corners):
    """Area, centroid and mean square distance from the origin of a set of polygons."""
    fans = [corners[:, [0, i, i + 1]] for i in range(1, corners.shape[1] - 1)]
    a, b, c = np.moveaxis(np.concatenate(fans), 1, 0)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # The mid-side rule is exact for quadratics.
    mids = [0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)]
    square = sum(areas @ (m**2).sum(axis=1) for m in mids) / 3 / areas.sum()
    return areas.sum(), areas @ (a + b + c) / 3 / areas.sum(), square


def assert_within_cells(points, cells, contacts):
    faces = points[cells[contacts.cell][:, FACES[cells.shape[1]]]]
    outward = np.cross(faces[:, :, 1] - faces[:, :, 0], faces[:, :, 2] - faces[:, :, 0])
    reach = np.einsum("nfi,nci->nfc", outward, contacts.corners)
    limit = np.einsum("nfi,nfi->nf", outward, faces[:, :, 0])
    assert (reach <= limit[..., None] + 1e-14).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("low", "high", "normal"),
    [
        ((0.0041, -0.001, 0.0017), (0.0163, 0.001, 0.0049), (0, -1, 0)),  # on a side
        ((0.029, 0.0033, 0.0), (0.031, 0.0157, 0.006), (1, 0, 0)),  # over the full height
    ],
)
def test_pieces_make_up_the_electrode_on_any_cells(kind, low, high, normal):
    points, cells = cut_blocks.block(kind, COUNTS, SIZE)
    extent = np.clip(high, 0, SIZE) - np.clip(low, 0, SIZE)
    low, high, normal = np.array(low), np.array(high), np.array(normal)
    area = np.prod(extent[normal == 0])
    contacts = electrode_contacts(points, cells, [Patch((box_region(low, high, normal),), area)])
    centre = 0.5 * (np.clip(high, 0, SIZE) + np.clip(low, 0, SIZE))
    centre[normal != 0] = np.where(normal.sum() > 0, SIZE, 0.0)[normal != 0]
    side = extent * (normal == 0)
    found = moments(contacts.corners)
    assert (found[0], contacts.areas.sum()) == pytest.approx((area, area), rel=1e-9)
    assert found[1] == pytest.approx(centre, abs=1e-12)
    assert found[2] == pytest.approx(centre @ centre + side @ side / 12, rel=1e-9)
    assert_within_cells(points, cells, contacts)
    a, b, c = np.moveaxis(contacts.corners[:, :3], 1, 0)
    assert (np.cross(b - a, c - b) @ normal > 0).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("corner", "a", "b"),
    [
        # On cell faces (three layers), between them, and tilted.
        *(((4.1e-3, 3.3e-3, z), (16.9e-3, 0, 0), (0, 11.7e-3, 0)) for z in (0.002, 0.0033)),
        ((0.008, 0.004, 0.001), (0.013, 0.002, 0.003), (-0.004, 0.009, 0.0)),
    ],
)
def test_sheets_are_counted_once_wherever_they_lie(kind, corner, a, b):
    points, cells = cut_blocks.block(kind, COUNTS, SIZE)
    sheet = np.array(corner) + np.array([(0, 0, 0), a, np.add(a, b), b])
    area = np.linalg.norm(np.cross(a, b))
    contacts = electrode_contacts(points, cells, [Patch((), area, sheet)])
    assert moments(contacts.corners)[0] == pytest.approx(area, rel=1e-9)
    assert moments(contacts.corners)[1] == pytest.approx(sheet.mean(axis=0), abs=1e-12)
    assert_within_cells(points, cells, contacts)
    bottom = points[cells[contacts.cell]][:, :, 2].min(axis=1)
    assert (bottom < sheet[:, 2].max() - 1e-9).all()
    assert len(contacts.facets[0]) == 0


def test_electrodes_off_the_body_are_named():
    points, cells = cut_blocks.block(8, COUNTS, SIZE)
    good = Patch((box_region((0, -1e-3, 0), (0.004, 1e-3, 1), (0, -1, 0)),), 0.004 * SIZE[2])
    half_off = Patch((box_region((-0.002, -1e-3, 0), (0.002, 1e-3, 1), (0, -1, 0)),), good.area)
    with pytest.raises(ConfigurationError, match=r"electrode 1 .*12 of its 24 mm2"):
        electrode_contacts(points, cells, [good, half_off])
    outside = Patch((), 1e-4, np.array([[0, 0, 1.0], [0.01, 0, 1.0], [0.01, 0.01, 1.0]]))
    with pytest.raises(ConfigurationError, match="electrode 0 covers 0 of"):
        electrode_contacts(points, cells, [outside])
