"""Meshes of each kind of cell: they fill the body, fit the electrodes, are fine at their edges."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Electrode, Layer, Polygon, SensorDesign, Surface, structured_mesh
from eitskin.geometry.design.patches import boundary_faces
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading, graded_lines
from eitskin.geometry.meshing.mesh import quality, volumes
from eitskin.geometry.meshing.mesh_design import layer_heights, triangulated_mesh
from eitskin.geometry.meshing.tetrahedra import tetrahedral_mesh

from cut_blocks import covered
from on_demand import OnDemand

pytestmark = pytest.mark.slow

REFERENCE = SensorDesign.reference()
FINE, COARSE = Grading(1e-3, 4e-3, 0.5, layers=2), Grading(3e-3, 12e-3, 0.7)
SIZE = np.array([0.15, 0.06, 0.005])
BENT = Polygon(((0, 0), (0.1, 0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.1), (0, 0.1)))
MESHERS = {
    "hexahedra": (structured_mesh, FINE),
    "prisms": (triangulated_mesh, FINE),
    "tetrahedra": (tetrahedral_mesh, COARSE),
}


@pytest.fixture(scope="module", params=["hexahedra", "prisms", "tetrahedra"])
def slab(request):
    """The reference sensor, with its kind of cells and their sizes."""
    if request.param == "tetrahedra":
        OnDemand("pytetwild")
    make, grading = MESHERS[request.param]
    return request.param, make(REFERENCE, grading), grading


def test_cells_fill_the_slab_and_are_fine_at_the_electrode_edges(slab):
    kind, mesh, _ = slab
    assert volumes(mesh.points, mesh.cells).min() > 0
    assert quality(mesh).volume == pytest.approx(SIZE.prod(), rel=1e-12)
    assert quality(mesh).scaled_jacobian > 0.05
    assert covered(mesh, 8) == pytest.approx(np.full(8, 25e-6), rel=1e-9)
    assert (np.diff(mesh.points[:, 0]) >= 0).all()
    assert np.array_equal(np.unique(mesh.cells), np.arange(len(mesh.points)))
    for electrode, facets in zip(REFERENCE.electrodes, mesh.electrode_facets, strict=True):
        places = mesh.points[facets].reshape(-1, 3)
        middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
        near = 1e-12 if kind != "tetrahedra" else 5e-3  # their faces are not cut at electrodes
        assert middle == pytest.approx([electrode.x, electrode.y, 0.0025], abs=near)
    if kind != "tetrahedra":
        assert np.array_equal(mesh.heights, [0.0, 0.0025, 0.005])
        assert (mesh.points.reshape(-1, 3, 3)[:, :, 2] == mesh.heights).all()
    rim = mesh.points[np.unique(boundary_faces(mesh.cells)[0])]
    assert np.minimum(np.abs(rim), np.abs(rim - SIZE)).min(axis=1).max() < 1e-15
    _, mesh, grading = slab
    corners = mesh.points[mesh.cells]
    size = np.ptp(corners[..., :2], axis=1).mean(axis=1)
    edges = REFERENCE.edges(1e-3)
    distance = np.linalg.norm((corners.mean(axis=1)[:, None] - edges)[..., :2], axis=2).min(axis=1)
    near, far = distance < grading.finest, distance > 15e-3
    assert np.median(size[near]) < 2 * grading.finest
    assert np.median(size[far]) > 0.2 * grading.coarsest
    assert np.median(size[far]) > 1.5 * np.median(size[near])


@pytest.mark.parametrize("edge", [0.0, 0.05, 0.15])
def test_lines_have_the_size_wanted_at_every_distance_from_an_edge(edge) -> None:
    grading = Grading(2e-6, 5e-3, 0.2)
    lines = graded_lines(0.15, {edge}, (), grading)
    sizes = grading.size(np.abs(0.5 * (lines[1:] + lines[:-1]) - edge))
    assert np.diff(lines) == pytest.approx(sizes, rel=0.04)


@pytest.mark.parametrize(
    ("grading", "count"),
    [(Grading(4e-4, 4e-4, 1.0), "6e+06"), (Grading(1e-6, 12e-3, 0.5), "4.3e+06")],
)
def test_tetrahedra_are_counted_before_any_are_made(grading, count) -> None:
    """8.5 V / s^3 where all have one size; 8.5 pi l / (2 growth^2 finest) at edges, 0.08 m long."""
    OnDemand("pytetwild")
    with pytest.raises(ConfigurationError, match=re.escape(f"about {count} tetrahedra")):
        tetrahedral_mesh(REFERENCE, grading)


def test_hexahedra_and_prisms_meet_breaks_electrodes_and_layers():
    x = structured_mesh(REFERENCE, FINE, breaks=(0.0531, 0.0969)).points[:, 0]
    assert np.abs(x[:, None] - [0.0531, 0.0969]).min(axis=0).max() < 1e-12
    electrodes = (*REFERENCE.electrodes, Electrode(0.05, 0.03, on="top"))
    design = dataclasses.replace(REFERENCE, electrodes=electrodes)
    fine = layer_heights(design, Grading(finest=1e-4, coarsest=8e-3, growth=1.0, layers=4))
    assert np.diff(fine).max() < 1.01 * 0.005 / 4
    assert np.diff(fine)[-1] < 3e-4 < np.diff(fine)[0]
    layers = (Layer(0.001, 1.0), Layer(0.004, 0.1))
    design = SensorDesign(BENT, 0.005, ELECTRODES, layers=layers)
    mesh = triangulated_mesh(design, FINE)
    assert quality(mesh).volume == pytest.approx(0.0051 * 0.005, rel=1e-12)
    expected = [patch.area for patch in design.patches()]
    assert covered(mesh, 5) == pytest.approx(expected, rel=1e-9)
    # Interfaces, sheets and the ends of electrodes are layers of points.
    for z in (0.001, 0.0013, 0.0015, 0.0025):
        assert np.abs(mesh.heights - z).min() < 1e-12


ELECTRODES = (
    Electrode(0.015, 0.015, 0.01, on="top", shape="round"),
    Electrode(0.015, 0.06, 0.01, height=0.006, on="bottom"),
    Electrode(0.06, 0.015, 0.02, height=0.012, on="inside", z=0.0013),
    Electrode(0.0, 0.06, 0.01, height=0.001, z=0.002),
    Electrode(0.1, 0.0, 0.012),  # around a corner
)


def test_surfaces_from_files(tmp_path, monkeypatch):
    trimesh = OnDemand("trimesh")
    box = trimesh.creation.box((0.05, 0.04, 0.01))
    box.apply_translation((0.3, 0.2, 0.1))
    box.export(tmp_path / "box.stl")
    monkeypatch.chdir(tmp_path)
    ends = tuple(Electrode(x, 0.2, 0.006, on="surface", z=0.1) for x in (0.275, 0.325))
    design = SensorDesign(Surface(Path("box.stl")), 0.01, ends)
    mesh = tetrahedral_mesh(design, Grading(3e-3, 10e-3, 0.7))
    assert quality(mesh).volume == pytest.approx(2e-5, rel=1e-4)
    assert covered(mesh, 2) == pytest.approx(np.full(2, 36e-6), rel=1e-4)
    assert mesh.points.min(axis=0) == pytest.approx([0.275, 0.18, 0.095])
    # Other files that fTetWild writes are not left in the working directory.
    assert [path.name for path in tmp_path.iterdir()] == ["box.stl"]


@pytest.mark.parametrize("kind", ["prisms", "tetrahedra"])
def test_rims_of_discs_are_on_the_circle_and_contacts_have_their_true_area(kind):
    if kind == "tetrahedra":
        OnDemand("pytetwild")
    disc = Disc(0.05)
    design = SensorDesign(disc, 0.01, uniform(disc, 4, width=0.02))
    mesh = MESHERS[kind][0](design, Grading(6e-3, 20e-3, 0.7))
    true = np.bincount(mesh.contacts.electrode, mesh.contacts.areas)
    assert true == pytest.approx(np.full(4, 2e-4), rel=1e-12)
    rim = mesh.points[np.unique(boundary_faces(mesh.cells)[0])]
    distance = np.hypot(*(rim[:, :2] - disc.radius).T)
    wall = np.abs(distance - disc.radius) < 1e-15
    assert wall.sum() > 40
    assert distance.max() < disc.radius + 1e-15
    # A chord c of radius R is shorter than its arc by (c / R)^2 / 24.
    angle = np.sort(np.arctan2(*(rim[wall, :2] - disc.radius).T).round(9))
    longest = np.diff(np.unique(angle)).max()
    missing = 1 - covered(mesh, 4) / 2e-4
    assert 0 < missing.min() <= missing.max() < 1.01 * longest**2 / 24
    assert 0 < 1 - quality(mesh).volume / (np.pi * 0.05**2 * 0.01) < 0.02
