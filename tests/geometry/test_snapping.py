"""Points of a mesh go back to faces, edges and corners, unless a cell were flattened."""

import numpy as np
import pytest

from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import volumes
from eitskin.geometry.meshing.tetrahedra import TriangleSurface, _sizing, snap_boundary

from cut_blocks import block
from on_demand import OnDemand

trimesh = OnDemand("trimesh")

BOX = np.array([[x, y, z] for x in (0.0, 3.0) for y in (0.0, 2.0) for z in (0.0, 1.0)])
BOX_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)
SURFACE = TriangleSurface.from_triangles(BOX, BOX_FACES)


def test_boxes_and_prisms_have_the_edges_and_corners_that_are_sharp():
    assert len(SURFACE.edges) == 12
    assert np.array_equal(np.sort(SURFACE.corners), np.arange(8))
    assert (np.count_nonzero(np.ptp(BOX[SURFACE.edges], axis=1), axis=1) == 1).all()
    for sides, edges, corners in ((48, 96, 0), (6, 18, 12)):  # at 7.5 degrees: the rims alone
        mesh = trimesh.creation.cylinder(1.0, 1.0, sections=sides)
        found = TriangleSurface.from_triangles(mesh.vertices, mesh.faces)
        assert (len(found.edges), len(found.corners)) == (edges, corners)


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


def test_a_dented_box_becomes_plane_again():
    points, cells = block(4, (12, 8, 4), (3, 2, 1))
    inside = ((points > 0) & (points < [3, 2, 1])).all(axis=1)
    assert volumes(points, cells).sum() == pytest.approx(6.0, rel=1e-9)
    rough = points.copy()
    rng = np.random.default_rng(3)
    away = rng.normal(size=points.shape) * (np.isclose(points, 0) | np.isclose(points, [3, 2, 1]))
    rough += 0.02 * away / np.maximum(np.linalg.norm(away, axis=1), 1e-9)[:, None]
    assert abs(volumes(rough, cells).sum() / 6 - 1) > 1e-4
    smooth = snap_boundary(rough, cells, SURFACE, 0.03)
    assert np.array_equal(smooth[inside], points[inside])
    assert smooth == pytest.approx(points, abs=1e-12)


def test_points_stay_where_moving_would_flatten_a_cell_and_only_there():
    # The apex of the first is within reach of the face that its base lies in.
    flat = [[1.0, 1.0, 1.0], [1.5, 1.0, 1.0], [1.0, 1.5, 1.0], [1.2, 1.2, 0.95]]
    tall = [[2.0, 1.0, 0.97], [2.2, 1.0, 0.6], [2.0, 1.3, 0.6], [2.1, 1.1, 0.2]]
    # The first corner of these is within reach of the top, and of its edge in the plane y = 0.
    free, held = (
        [[1.0, 0.06, 0.97], [0.8, 0.0, 0.6], [1.2, 0.0, 0.6], [1.0, y, 0.3]] for y in (0.4, 0.0)
    )
    points = np.array([*flat, *tall, *free, *held])
    cells = np.array([[0, 2, 1, 3]]) + 4 * np.arange(4)[:, None]
    assert volumes(points, cells).min() > 0
    found = snap_boundary(points, cells, SURFACE, 0.08)
    assert np.array_equal(found[:4], points[:4])
    assert found[[4, 8, 12]] == pytest.approx(
        np.array([[2.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 0.06, 1.0]])
    )


def test_sizes_are_those_wanted_and_no_place_but_their_own_is_near_the_edges():
    grading, edges = (
        Grading(0.1, 0.2, 0.5),
        np.random.default_rng(5).uniform(0, [3, 2, 1], (300, 3)),
    )
    places, cells, sizes = _sizing(edges, grading, BOX)
    distance = np.linalg.norm(places[:, None] - edges, axis=2).min(axis=1)
    assert np.count_nonzero(distance < 1e-11) == len(edges)
    assert distance[distance > 1e-11].min() > 2.0 * grading.finest
    assert sizes == pytest.approx(np.minimum(0.2, sizes[distance < 1e-11].max() + 0.5 * distance))
    assert sizes.min() == pytest.approx(grading.finest, rel=0.5)
    assert np.abs(volumes(places, cells)).sum() == pytest.approx(3.6 * 2.6 * 1.6, rel=0.01)
