"""Contacts are cut exactly, whatever cells lie under the electrodes."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry.design.patches import FACES, Patch, Region, boundary_faces, electrode_contacts

import cut_blocks

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
def test_boundary_faces_enclose_the_body(kind):
    points, cells = cut_blocks.block(kind, COUNTS, SIZE)
    faces, owners = boundary_faces(cells)
    corners = points[faces]
    spokes = corners[:, 1:] - corners[:, :1]
    vectors = 0.5 * np.cross(spokes[:, :-1], spokes[:, 1:]).sum(axis=1)
    a, b, c = SIZE
    assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(2 * (a * b + b * c + c * a))
    volume = np.einsum("ni,ni->", vectors, corners.mean(axis=1)) / 3
    assert volume == pytest.approx(a * b * c)
    assert all(np.isin(face, cells[owner]).all() for face, owner in zip(faces, owners, strict=True))


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
