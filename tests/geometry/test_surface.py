"""Bodies from surface files."""

import numpy as np
import pytest

from eitskin.geometry import Surface

from on_demand import OnDemand

trimesh = OnDemand("trimesh")


def surface(mesh, path, scale=1.0):
    mesh.export(path)
    return Surface(path, scale)


def volume(body):
    points, faces = body.triangles()
    return np.linalg.det(points[faces]).sum() / 6


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "off"])
def test_extents_and_volume_are_in_metres(tmp_path, ending):
    bounds = np.array([[1, 2, 3], [21, 12, 9]])
    body = surface(trimesh.creation.box(bounds=bounds), tmp_path / f"box.{ending}", 1e-3)
    assert (body.length, body.width, body.height) == pytest.approx((0.02, 0.01, 0.006))
    assert body.bounds == pytest.approx(bounds * 1e-3)
    assert volume(body) == pytest.approx(0.02 * 0.01 * 0.006, rel=1e-6)


def test_nearest_place_and_normal_on_a_box(tmp_path):
    body = surface(trimesh.creation.box(extents=[2, 2, 2]), tmp_path / "box.stl")
    for given, place, normal in (
        ((0.3, 0.2, 5.0), (0.3, 0.2, 1.0), (0, 0, 1)),
        ((0.3, 0.2, 0.9), (0.3, 0.2, 1.0), (0, 0, 1)),
        ((-1.5, 0.2, 0.1), (-1.0, 0.2, 0.1), (-1, 0, 0)),
    ):
        found = body.nearest(np.array(given))
        assert found[0] == pytest.approx(np.array(place))
        assert found[1] == pytest.approx(np.array(normal))
    assert body.nearest(np.array([3.0, 4.0, 5.0]))[0] == pytest.approx(np.ones(3))


def test_a_cavity_is_part_of_the_body_and_a_changed_file_is_read_again(tmp_path):
    box, hole = trimesh.creation.box(extents=[1, 1, 1]), trimesh.creation.icosphere(radius=0.3)
    body = surface(box, tmp_path / "box.stl")
    assert volume(body) == pytest.approx(1.0, rel=1e-6)
    hole.invert()
    surface(trimesh.util.concatenate([box, hole]), tmp_path / "box.stl")
    assert volume(body) == pytest.approx(1.0 + hole.volume, rel=1e-5)
