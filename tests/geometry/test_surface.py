"""Bodies from surface files, and files that bound none."""

import os

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Surface

from on_demand import OnDemand

trimesh = OnDemand("trimesh")


def save(mesh, path):
    mesh.export(path)
    return path


def ball(radius=1.0):
    return trimesh.creation.icosphere(subdivisions=3, radius=radius)


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "off"])
def test_extents_and_volume_are_in_metres(tmp_path, ending):
    box = trimesh.creation.box(bounds=[[1, 2, 3], [21, 12, 9]])
    surface = Surface(save(box, tmp_path / f"box.{ending}"), scale=1e-3)
    assert (surface.length, surface.width, surface.height) == pytest.approx((0.02, 0.01, 0.006))
    assert surface.bounds == pytest.approx(np.array([[1, 2, 3], [21, 12, 9]]) * 1e-3)
    points, faces = surface.triangles()
    volume = np.linalg.det(points[faces]).sum() / 6
    assert volume == pytest.approx(0.02 * 0.01 * 0.006, rel=1e-6)


def test_nearest_place_and_normal_on_a_box(tmp_path):
    surface = Surface(save(trimesh.creation.box(extents=[2, 2, 2]), tmp_path / "box.stl"))
    for given, place, normal in (
        ((0.3, 0.2, 5.0), (0.3, 0.2, 1.0), (0, 0, 1)),
        ((0.3, 0.2, 0.9), (0.3, 0.2, 1.0), (0, 0, 1)),
        ((-1.5, 0.2, 0.1), (-1.0, 0.2, 0.1), (-1, 0, 0)),
    ):
        found = surface.nearest(np.array(given))
        assert found[0] == pytest.approx(np.array(place))
        assert found[1] == pytest.approx(np.array(normal))
    corner, _ = surface.nearest(np.array([3.0, 4.0, 5.0]))
    assert corner == pytest.approx(np.ones(3))


def test_a_cavity_is_part_of_the_body(tmp_path):
    hole = ball(0.3)
    hole.invert()
    both = trimesh.util.concatenate([trimesh.creation.box(extents=[1, 1, 1]), hole])
    points, faces = Surface(save(both, tmp_path / "hollow.stl")).triangles()
    volume = np.linalg.det(points[faces]).sum() / 6
    assert volume == pytest.approx(1.0 - hole.volume * -1, rel=1e-5)


def test_a_changed_file_is_read_again(tmp_path):
    path = save(ball(1.0), tmp_path / "ball.stl")
    assert Surface(path).height == pytest.approx(2.0)
    save(ball(2.0), path)
    assert Surface(path).height == pytest.approx(4.0)


def ball_of(faces):
    """The ball with other faces, as `faces` makes them from its own."""
    mesh = ball()
    return trimesh.Trimesh(mesh.vertices, faces(mesh.faces), process=False)


def inside_out():
    return ball_of(lambda f: f[:, ::-1])


def beside(mesh):
    return trimesh.util.concatenate([ball(), mesh.apply_translation((5, 0, 0))])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ball_of(lambda f: f[1:]), "open: 3 of its edges"),
        (lambda: ball_of(lambda f: np.vstack([f[:1, ::-1], f[1:]])), "look both ways"),
        (inside_out, "inside out"),
        (lambda: beside(ball()), "holds 2 bodies"),
        (lambda: beside(inside_out()), "cavity"),
        (lambda: ball(20.0), r"length.*bad.stl.*metres"),
    ],
)
def test_surfaces_that_bound_no_body_say_what_to_do(tmp_path, make, message):
    with pytest.raises(ConfigurationError, match=message):
        Surface(save(make(), tmp_path / "bad.stl"))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("none.stl", None, "none.stl: No such file"),
        ("text.stl", "hello", "holds no triangles"),
        ("empty.ply", "ply\n", "empty.ply"),
        ("part.step", "ISO-10303-21;", r"triangle.*STL"),
    ],
)
def test_files_that_hold_no_surface_are_refused(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(ConfigurationError, match=message):
        Surface(tmp_path / name)
    for scale in (0.0, float("nan")):
        with pytest.raises(ConfigurationError, match=r"outline\.scale.*positive"):
            Surface(tmp_path / name, scale)


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.stl")
    with pytest.raises(ConfigurationError, match=r"expected a file.*pipe"):
        Surface(tmp_path / "pipe.stl")


def test_a_head_that_tells_of_a_billion_points_is_one_error(tmp_path):
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\n"
    (tmp_path / "bomb.ply").write_text(head + "end_header\n")
    with pytest.raises(ConfigurationError, match=r"bomb\.ply as a surface"):
        Surface(tmp_path / "bomb.ply")
