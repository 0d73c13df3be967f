"""Points of a mesh go back to faces, edges and corners, unless a cell were flattened."""

import numpy as np
import pytest

from eitskin.geometry.meshing.mesh import volumes
from eitskin.geometry.meshing.tetrahedra import TriangleSurface, snapped

from cut_blocks import block

pytest.importorskip("trimesh")

BOX = np.array([[x, y, z] for x in (0.0, 3.0) for y in (0.0, 2.0) for z in (0.0, 1.0)])
BOX_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)
SURFACE = TriangleSurface.of(BOX, BOX_FACES)


def prism(sides):
    """An upright prism on a regular polygon."""
    turn = 2 * np.pi * np.arange(sides) / sides
    rim = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    points = np.concatenate([rim, rim + np.array([0, 0, 1]), [[0, 0, 0], [0, 0, 1]]])
    a = np.arange(sides)
    b = (a + 1) % sides
    low, high = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    rows = [(b, a, low), (a + sides, b + sides, high), (a, b, b + sides), (a, b + sides, a + sides)]
    return TriangleSurface.of(points, np.concatenate([np.column_stack(row) for row in rows]))


def test_boxes_and_prisms_have_the_edges_and_corners_that_are_sharp():
    assert len(SURFACE.edges) == 12
    assert np.array_equal(np.sort(SURFACE.corners), np.arange(8))
    assert (np.count_nonzero(np.ptp(BOX[SURFACE.edges], axis=1), axis=1) == 1).all()
    fine = prism(48)  # sides at 7.5 degrees make an edge only with the ends
    assert len(fine.edges) == 96
    assert len(fine.corners) == 0
    coarse = prism(6)
    assert len(coarse.edges) == 18
    assert len(coarse.corners) == 12


@pytest.mark.parametrize(
    ("place", "goal"),
    [
        ((1.3, 0.7, 1.04), (1.3, 0.7, 1.0)),  # above a face
        ((1.3, 0.7, 0.96), (1.3, 0.7, 1.0)),  # below it
        ((1.3, 0.03, 0.96), (1.3, 0.0, 1.0)),  # near an edge
        ((2.97, 0.03, 0.96), (3.0, 0.0, 1.0)),  # near a corner
        ((3.07, 0.05, 0.05), (3.0, 0.05, 0.05)),  # nearer to the line of an edge than to the edge
        ((1.3, 0.7, 0.5), (1.3, 0.7, 0.5)),  # far from everything
    ],
)
def test_places_go_to_the_sharpest_feature_within_reach(place, goal):
    *_, found = SURFACE.targets(np.array([place, (0.1, 0.1, 0.5)]), 0.08)
    assert found[0] == pytest.approx(goal, abs=1e-12)


@pytest.mark.parametrize(("height", "goal"), [(0.01, 0.0), (0.04, 0.05)])
def test_the_nearest_of_several_edges_is_taken(height, goal):
    plate = TriangleSurface.of(BOX * [1, 1, 0.05], BOX_FACES)
    *_, found = plate.targets(np.array([(1.3, 0.02, height), (1.0, 1.0, height)]), 0.08)
    assert found == pytest.approx(np.array([(1.3, 0.0, goal), (1.0, 1.0, goal)]), abs=1e-12)


def test_a_dented_box_becomes_plane_again():
    points, cells = block(4, (12, 8, 4), (3, 2, 1))
    inside = ((points > 0) & (points < [3, 2, 1])).all(axis=1)
    assert volumes(points, cells).sum() == pytest.approx(6.0, rel=1e-9)
    rough = points.copy()
    rng = np.random.default_rng(3)
    away = rng.normal(size=points.shape) * (np.isclose(points, 0) | np.isclose(points, [3, 2, 1]))
    rough += 0.02 * away / np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None]
    assert abs(volumes(rough, cells).sum() / 6 - 1) > 1e-4
    smooth = snapped(rough, cells, SURFACE, 0.03)
    assert np.array_equal(smooth[inside], points[inside])
    assert smooth == pytest.approx(points, abs=1e-12)


@pytest.mark.parametrize(("depth", "goal"), [(0.4, (1.0, 0.0, 1.0)), (0.0, (1.0, 0.06, 1.0))])
def test_points_go_to_a_face_where_its_edge_would_flatten_a_cell(depth, goal):
    # The first corner is within reach of the top and of its edge, which is in the plane y = 0.
    points = np.array([[1.0, 0.06, 0.97], [0.8, 0.0, 0.6], [1.2, 0.0, 0.6], [1.0, depth, 0.3]])
    cells = np.array([[0, 2, 1, 3]])
    assert volumes(points, cells)[0] > 0
    *_, goals = SURFACE.targets(points, 0.08)
    assert goals[0] == pytest.approx([1.0, 0.0, 1.0])
    assert snapped(points, cells, SURFACE, 0.08)[0] == pytest.approx(goal)


def test_points_stay_where_moving_would_flatten_a_cell_and_only_there():
    # The apex of the first is within reach of the face that its base lies in.
    flat = [[1.0, 1.0, 1.0], [1.5, 1.0, 1.0], [1.0, 1.5, 1.0], [1.2, 1.2, 0.95]]
    tall = [[2.0, 1.0, 0.97], [2.2, 1.0, 0.6], [2.0, 1.3, 0.6], [2.1, 1.1, 0.2]]
    points = np.array([*flat, *tall])
    cells = np.array([[0, 2, 1, 3], [4, 6, 5, 7]])
    assert volumes(points, cells).min() > 0
    found = snapped(points, cells, SURFACE, 0.1)
    assert np.array_equal(found[:4], points[:4])
    assert found[4] == pytest.approx([2.0, 1.0, 1.0])
