"""Quality of cells, against VTK's own measures, and what the gate refuses."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Contacts, Mesh, SensorDesign, structured_mesh
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import check_quality, quality
from eitskin.geometry.meshing.mesh_body import MeshOutline

HALF = np.sqrt(0.75)
SQUARE, TRIANGLE = [[0.0, 0], [1, 0], [1, 1], [0, 1]], [[0, 0], [1, 0], [0.5, HALF]]
CUBE, PRISM = (
    np.concatenate([np.pad(plane, ((0, 0), (0, 1)), constant_values=z) for z in (0.0, 1.0)])
    for plane in (SQUARE, TRIANGLE)
)
TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, -1, 1], [-1, 1, -1]], float)
IDEAL = [CUBE, PRISM, TETRAHEDRON]


def mesh_of(points, cells=None):
    if cells is None:
        cells = np.arange(len(points))[None]
    empty = np.zeros(0, dtype=int)
    return Mesh(points, cells, Contacts(empty, empty, np.zeros((0, 3, 3)), np.zeros(0), ()), None)


def crooked(ideal, count, amount):
    """`count` separate cells, each an ideal one with its corners moved at random."""
    rng = np.random.default_rng(1)
    points = ideal + amount * rng.uniform(-1, 1, (count, *ideal.shape))
    return mesh_of(points.reshape(-1, 3), np.arange(count * len(ideal)).reshape(count, -1))


@pytest.mark.parametrize(
    ("ideal", "volume", "angles"),
    [
        (CUBE, 1.0, (90, 90)),
        (PRISM, HALF / 2, (60, 90)),
        (TETRAHEDRON, 8 / 3, [np.degrees(np.arccos(1 / 3))] * 2),
    ],
)
def test_ideal_cells_and_those_that_are_stretched(ideal, volume, angles):
    found = quality(mesh_of(ideal))
    assert (found.scaled_jacobian, found.aspect_ratio) == pytest.approx((1, 1))
    assert found.volume == pytest.approx(volume)
    assert (found.smallest_angle, found.largest_angle) == pytest.approx(angles)
    assert (found.cells, found.points) == (1, len(ideal))
    apart = ideal[:, None] - ideal
    lengths = np.linalg.norm(apart, axis=2)
    stretched = np.linalg.norm(apart * [1, 1, 3], axis=2)[np.isclose(lengths, lengths[0, 1])]
    expected = stretched.max() / stretched.min()
    cells = np.arange(2 * len(ideal)).reshape(2, -1)
    both = quality(mesh_of(np.concatenate([ideal, ideal * [1, 1, 3]]), cells))
    assert both.aspect_ratio == pytest.approx(expected)
    assert both.median_aspect_ratio == pytest.approx(0.5 * (1 + expected))


@pytest.mark.parametrize("ideal", IDEAL)
def test_the_gate_names_the_worst_cell(ideal):
    good, count = crooked(ideal, 5, 0.05), len(ideal)
    check_quality(good)
    points = good.points.copy()
    # The top of cell 3 goes through its bottom.
    points[3 * count : 4 * count, 2] *= -1
    place = ", ".join(f"{c:.6g}" for c in points[3 * count : 4 * count].mean(axis=0))
    with pytest.raises(ConfigurationError, match=r"cell 3 at \(.*inverted") as error:
        check_quality(mesh_of(points, good.cells))
    assert f"({place}) m" in str(error.value)
    points[3 * count : 4 * count] = [1.0, 2.0, 3.0]  # all corners in one place
    with pytest.raises(ConfigurationError, match=r"cell 3 .* is degenerate"):
        check_quality(mesh_of(points, good.cells))
    points[6, 1] = np.nan
    with pytest.raises(ConfigurationError, match=r"point 6 .*finite"):
        check_quality(mesh_of(points, good.cells))


def test_a_mesh_seen_from_above_contains_what_its_triangles_cover():
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    points = np.random.default_rng(0).uniform(-0.2, 1.2, (600, 2))
    inside = ((points > 0.0) & (points < 1.0)).all(axis=1)
    found = MeshOutline(corners, np.array([[0, 1, 2], [0, 3, 2]])).contains(points)
    assert np.array_equal(found, inside)


def test_slivers_are_degenerate_and_thin_boxes_are_not():
    flat = mesh_of(TETRAHEDRON * [1, 1, 1e-4])
    with pytest.raises(ConfigurationError, match=r"1 of 1 cells .* degenerate"):
        check_quality(flat)
    check_quality(flat, quality=1e-5)
    thin = structured_mesh(SensorDesign.reference(), Grading(5e-6, 5e-3, 0.7))
    check_quality(thin)
    assert quality(thin).aspect_ratio > 500
