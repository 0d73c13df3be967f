"""Tetrahedra: exact bodies and electrodes, fine at the electrodes' edges."""

import sys
from pathlib import Path

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Electrode, Polygon, SensorDesign, Surface
from eitskin.geometry.design.patches import boundary_faces
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import quality, volumes
from eitskin.geometry.meshing.tetrahedra import tetrahedral_mesh

from cut_blocks import covered
from on_demand import OnDemand

GRADING = Grading(finest=3e-3, coarsest=12e-3, growth=0.7)
BENT = Polygon(((0, 0), (0.1, 0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.1), (0, 0.1)))

OnDemand("pytetwild")


@pytest.fixture(scope="module")
def slab():
    return tetrahedral_mesh(SensorDesign.reference(), GRADING)


@pytest.mark.slow
def test_slab_and_electrodes_are_exact_and_shapes_are_good(slab):
    assert volumes(slab.points, slab.cells).min() > 0
    assert quality(slab).volume == pytest.approx(0.15 * 0.06 * 0.005, rel=1e-12)
    assert covered(slab, 8) == pytest.approx(np.full(8, 25e-6), rel=1e-9)
    assert slab.heights is None
    found = quality(slab)
    assert found.scaled_jacobian > 0.05
    assert found.smallest_angle > 5
    assert (np.diff(slab.points[:, 0]) >= 0).all()
    assert np.array_equal(np.unique(slab.cells), np.arange(len(slab.points)))
    rim = slab.points[np.unique(boundary_faces(slab.cells)[0])]
    size = np.array([0.15, 0.06, 0.005])
    assert np.minimum(np.abs(rim), np.abs(rim - size)).min(axis=1).max() < 1e-15
    corners = np.array([[x, y, z] for x in (0, 0.15) for y in (0, 0.06) for z in (0, 0.005)])
    assert np.linalg.norm(rim[:, None] - corners, axis=2).min(axis=0).max() < 1e-15


@pytest.mark.slow
def test_cells_are_fine_at_the_electrode_edges(slab):
    corners = slab.points[slab.cells]
    pairs = np.array([[i, j] for j in range(4) for i in range(j)])
    edges = np.linalg.norm(corners[:, pairs[:, 0]] - corners[:, pairs[:, 1]], axis=2).mean(axis=1)
    places = SensorDesign.reference().edges(1e-3)
    distance = np.linalg.norm(corners.mean(axis=1)[:, None] - places, axis=2).min(axis=1)
    near, far = distance < GRADING.finest, distance > 15e-3
    assert np.median(edges[near]) < 2 * GRADING.finest
    assert np.median(edges[far]) > 2.5 * GRADING.finest
    assert np.median(edges / GRADING.size(distance)) < 1.2


@pytest.mark.slow
def test_a_disc_has_its_rim_on_the_circle():
    disc = Disc(0.05)
    design = SensorDesign(disc, 0.01, uniform(disc, 4, width=0.02))
    mesh = tetrahedral_mesh(design, Grading(6e-3, 20e-3, 0.7))
    rim = mesh.points[np.unique(boundary_faces(mesh.cells)[0])]
    upright = (rim[:, 2] > 1e-3) & (rim[:, 2] < 9e-3)
    distance = np.hypot(*(rim[upright, :2] - disc.radius).T)
    assert np.abs(distance - disc.radius).max() < 1e-15
    assert 0 < 1 - quality(mesh).volume / (np.pi * 0.05**2 * 0.01) < 0.02
    assert covered(mesh, 4) == pytest.approx(np.full(4, 2e-4), rel=0.02)


@pytest.mark.slow
def test_outlines_that_are_not_convex_with_every_kind_of_electrode():
    electrodes = (
        Electrode(0.015, 0.015, 0.015, on="top", shape="round"),
        Electrode(0.015, 0.06, 0.015, on="bottom"),
        Electrode(0.06, 0.015, 0.02, height=0.015, on="inside", z=0.004),
        Electrode(0.1, 0.0, 0.02),  # around a corner
    )
    design = SensorDesign(BENT, 0.01, electrodes)
    mesh = tetrahedral_mesh(design, Grading(4e-3, 12e-3, 0.7))
    assert quality(mesh).volume == pytest.approx(0.0051 * 0.01, rel=1e-6)
    expected = [patch.area for patch in design.patches()]
    assert covered(mesh, 4) == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_surfaces_from_files(tmp_path, monkeypatch):
    trimesh = pytest.importorskip("trimesh")
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


@pytest.mark.parametrize("grading", [Grading(1e-5, 5e-3, 1.0), Grading(1e-3, 1e-3, 0.5)])
def test_what_would_take_hours_is_refused(grading):
    with pytest.raises(ConfigurationError, match="larger sizes"):
        tetrahedral_mesh(SensorDesign.reference(), grading)


def test_the_extra_is_named_where_pytetwild_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "pytetwild", None)
    with pytest.raises(ImportError, match=r"eitskin\[mesh\]"):
        tetrahedral_mesh(SensorDesign.reference(), GRADING)
