"""Pictures of the live page: the bent and pressed sensor, and changes of its channels."""

import base64
import dataclasses
import math
import struct

import numpy as np
import pytest

from eitskin.cli.page.commands import stage_commands
from eitskin.cli.page.drawing import (
    FACE,
    INSIDE,
    DrawnBody,
    GelDrawing,
    GelShape,
    Region,
    grid_spacing,
    plan_outline,
)
from eitskin.cli.page.live_page import fill_bad_channels, relative_change
from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, Clamp, Disc, Electrode, Hinge, Polygon, SensorDesign, Surface
from eitskin.geometry.design.contact_areas import Pad, contact_areas
from eitskin.geometry.design.patches import area_vectors
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import Frame, Mechanics, Touch
from eitskin.simulator.bends import bend_table
from eitskin.simulator.deformation.press_table import sketched_dents

from page_fakes import DESIGN, PROTOCOL, staged_board

pytestmark = pytest.mark.slow


def decoded(text, unit):
    steps = np.array(struct.unpack(f"<{len(text) // 2}h", text)) * unit
    return steps.reshape(-1, 3)


def areas(body, which):
    """Area vectors (k, 3) [m2] and middles (k, 3) [m] of some faces of a body."""
    corners = body.points[body.vertices[body.faces[which]]]
    return area_vectors(corners), corners.mean(axis=1)


def of_electrode(body, number):
    """Area vectors and middles of an electrode's faces, and which faces these are."""
    first, count = body.electrodes[number]
    mine = (body.faces[:, 0] >= first) & (body.faces[:, 0] < first + count)
    return (*areas(body, mine), mine)


def with_outline(outline, electrodes):
    return dataclasses.replace(DESIGN, outline=outline, electrodes=electrodes)


DISC, L_SHAPE = (
    Disc(0.05),
    Polygon(((0, 0), (0.09, 0), (0.09, 0.03), (0.04, 0.03), (0.04, 0.06), (0, 0.06))),
)
PADS = (
    Electrode(0.04, 0.05, on="top", width=0.008, height=0.008, shape="round"),
    Electrode(0.07, 0.05, on="inside", z=0.002, width=0.008, height=0.006),
    Electrode(0.05, 0.03, on="bottom", width=0.008, height=0.008),
    Electrode(0.1, 0.05, width=0.03, height=0.002),
)
DESIGNS = {
    "rectangle": (DESIGN, 0.15 * 0.06),
    "disc": (with_outline(DISC, PADS), math.pi * 0.05**2),
    "polygon": (with_outline(L_SHAPE, uniform(L_SHAPE, 12)), 0.0039),
}


@pytest.mark.parametrize("name", DESIGNS)
def test_a_drawn_layer_is_closed_and_its_electrodes_lie_where_they_are(name) -> None:
    design, area = DESIGNS[name]
    body = DrawnBody.from_design(design)
    kinds = body.kinds[body.faces[:, 0]]
    vectors, middles = areas(body, kinds <= FACE)
    assert np.abs(vectors.sum(axis=0)).max() < 1e-12 * area
    volume = (vectors * middles).sum() / 3.0
    assert volume == pytest.approx(area * 0.005, rel=2e-3)  # a disc is drawn with chords
    upper, _ = areas(body, kinds == FACE)
    assert upper[:, 2].sum() == pytest.approx(area, rel=2e-3)
    contacts = contact_areas(design.electrodes, design.outline, design.thickness)
    for number, (patch, contact) in enumerate(zip(design.patches(), contacts, strict=True)):
        vectors, middles, mine = of_electrode(body, number)
        assert (kinds[mine] == INSIDE).all() == (design.electrodes[number].on == "inside")
        sizes = np.linalg.norm(vectors, axis=1)
        assert sizes.sum() == pytest.approx(patch.area, rel=1e-3)
        if isinstance(contact, Pad):
            assert np.allclose(vectors / sizes[:, None], contact.normal)
            assert np.allclose(sizes @ middles / sizes.sum(), contact.centre, atol=1e-9)
        else:
            _, depth = design.outline.nearest((middles + vectors / sizes[:, None] * 1e-3)[:, :2])
            assert (depth < 0.0).all()  # each face looks out of the layer
            assert np.ptp(middles[:, 2]) < contact.high - contact.low
    assert (kinds[body.opaque :] == INSIDE).all()
    assert not (kinds[: body.opaque] == INSIDE).any()


def test_a_body_from_a_file_is_drawn_with_its_electrodes(tmp_path) -> None:
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(4, 0.03)  # more points than are drawn
    ball.apply_scale([1.0, 1.0, 0.3])
    ball.apply_translation([0.2, 0.1, 0.0])
    ball.export(tmp_path / "ball.stl")
    surface = Surface(tmp_path / "ball.stl")
    size = {"on": "surface", "z": 0.0078, "width": 0.01, "height": 0.01}
    ring = [(0.2 + 0.015 * math.cos(a), 0.1 + 0.015 * math.sin(a)) for a in (0.0, 2.0, 4.0)]
    electrodes = tuple(Electrode(x, y, **size) for x, y in ring)
    design = SensorDesign(surface, surface.height, electrodes, encapsulated_thickness=0.018)
    shape = GelShape.from_design(design)
    body = shape.body
    assert len(body.points) < 4000
    kinds = body.kinds[body.faces[:, 0]]
    vectors, middles = areas(body, kinds <= FACE)
    assert np.abs(vectors.sum(axis=0)).max() < 1e-8
    assert (vectors * middles).sum() / 3.0 == pytest.approx(0.4 * math.pi * 0.03**3, rel=0.02)
    sizes = [np.linalg.norm(of_electrode(body, n)[0], axis=1).sum() for n in range(3)]
    assert sizes == pytest.approx([1e-4] * 3, rel=0.03)
    assert np.array_equal(shape.bend_points(0.0, [(0.2, 0.1, 5.0)]), body.points)  # no dents
    region = Region.from_design(design)
    assert np.allclose([region.low, region.high], [(0.17, 0.07), (0.23, 0.13)], atol=1e-4)
    beside = b'{"touches": [{"x": 0.172, "y": 0.072, "force": 5}]}'  # in the rectangle's corner
    with pytest.raises(ConfigurationError, match="above the body"):
        stage_commands(staged_board(), design)["/scene"](beside)
    points = decoded(
        base64.b64decode(GelDrawing.from_design(design).as_dict()["points"]), 2 * 0.06 / 32000
    )
    assert points.min() == pytest.approx(0.0, abs=1e-3)  # counted from its least corner
    assert points.max() == pytest.approx(0.06, abs=1e-3)


def test_the_drawn_sensor_is_bent_and_dented_as_the_simulated_one() -> None:
    shape = GelShape.from_design(DESIGN)
    points = shape.body.points
    flat = shape.bend_points(0.0, [])
    assert np.array_equal(flat, points)
    layer = bend_table.bend(DESIGN, Clamp(), Mechanics(), Bend(30.0))
    assert np.allclose(shape.bend_points(30.0, []), layer.positions(points))
    upper = np.flatnonzero(points[:, 2] == 0.005)
    at = points[upper[np.hypot(*(points[upper, :2] - (0.075, 0.03)).T).argmin()]]
    dented = shape.bend_points(0.0, [(at[0], at[1], 10.0)])
    dents = sketched_dents((Touch(at[0], at[1], 10.0),), DESIGN)
    assert np.allclose(dented, dents.positions(points))
    assert 0.3 < 1.0 - np.ptp(dents.positions(at * [[1, 1, 0], [1, 1, 1]])[:, 2]) / 0.005 < 0.5
    assert np.array_equal(shape.bend_points(500.0, []), shape.bend_points(shape.most, []))
    assert np.array_equal(shape.bend_points(float("nan"), []), flat)
    disc = GelShape.from_design(DESIGNS["disc"][0])
    bent = Hinge().flexure(disc.design, Bend(30.0)).positions(disc.body.points)
    assert np.allclose(disc.bend_points(30.0, []), bent)
    short = Disc(0.015)  # too short for it
    assert GelShape.from_design(with_outline(short, uniform(short, 4))).most == 0.0


def test_noise_is_not_drawn_again_and_a_bad_channel_begins_with_its_first_good_value():
    drawing = GelDrawing.from_design(DESIGN)
    first = drawing.points(10.0, [(0.05, 0.03, float("nan"))])
    assert drawing.points(10.1, [(0.0505, 0.03, float("nan"))]) is first
    moved = drawing.points(10.5, [(0.05, 0.03, float("nan"))])
    assert moved != first
    assert drawing.points(10.5, []) != moved
    places = decoded(base64.b64decode(drawing.points(0.0, [])), drawing.unit)
    assert np.allclose(places, drawing.shape.body.points, atol=drawing.unit)
    status = np.zeros(28, np.uint8)
    status[3] = 8
    values = np.full(28, 500.0)
    first = Frame(np.where(status, 1e5, values), PROTOCOL, status=status)
    later = Frame(values * 1.01, PROTOCOL, number=1)
    reference = fill_bad_channels(first, later)
    assert not reference.status.any()
    change = relative_change(Frame(values * 1.02, PROTOCOL, number=2), reference)
    assert change[3] == pytest.approx(100 * (1.02 / 1.01 - 1), abs=1e-3)
    assert change[4] == pytest.approx(2.0)


def test_the_outline_and_the_grid_seen_from_above() -> None:
    assert len(plan_outline(DESIGNS["disc"][0])) > 50
    assert np.array_equal(plan_outline(DESIGNS["polygon"][0]), L_SHAPE.vertices)
    spacings = [grid_spacing(0.15, 0.06), grid_spacing(0.1, 0.1), grid_spacing(0.9, 2.1)]
    assert spacings == pytest.approx([0.015, 0.01, 0.2])
