"""Prisms: extruded triangulations that carry electrodes of every kind."""

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Disc, Electrode, Layer, Polygon, Rectangle, SensorDesign, Surface
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import volumes
from eitskin.geometry.meshing.mesh_design import triangulated_mesh

from cut_blocks import covered

GRADING = Grading(finest=1e-3, coarsest=5e-3, growth=0.5, layers=2)
BENT = Polygon(((0, 0), (0.1, 0), (0.1, 0.03), (0.03, 0.03), (0.03, 0.1), (0, 0.1)))


@pytest.fixture(scope="module")
def slab():
    return triangulated_mesh(SensorDesign.reference(), GRADING)


def test_prisms_fill_the_slab_stand_upright_and_are_numbered_upwards_then_along_x(slab):
    assert volumes(slab.points, slab.cells).min() > 0
    assert volumes(slab.points, slab.cells).sum() == pytest.approx(0.15 * 0.06 * 0.005, rel=1e-12)
    columns = slab.points.reshape(-1, len(slab.heights), 3)
    assert np.array_equal(columns[0, :, 2], [0.0, 0.0025, 0.005])
    assert (columns[:, :, 2] == slab.heights).all()
    assert (np.ptp(columns[:, :, :2], axis=1) == 0).all()
    assert (np.diff(columns[:, 0, 0]) >= 0).all()


def test_electrodes_on_the_side_are_fitted_by_whole_faces(slab):
    assert slab.contacts.corners.shape[1] == 4
    assert covered(slab, 8) == pytest.approx(np.full(8, 25e-6), rel=1e-9)
    electrodes = SensorDesign.reference().electrodes
    for electrode, facets in zip(electrodes, slab.electrode_facets, strict=True):
        places = slab.points[facets].reshape(-1, 3)
        middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
        assert middle == pytest.approx([electrode.x, electrode.y, 0.0025], abs=1e-12)


def test_every_kind_of_electrode_finds_its_area():
    electrodes = (
        Electrode(0.02, 0.015, 0.008, on="top", shape="round"),
        Electrode(0.02, 0.015, 0.008, height=0.004, on="bottom"),
        Electrode(0.02, 0.06, 0.01, height=0.006, on="inside", z=0.0013),
        Electrode(0.0, 0.06, 0.01, height=0.001, z=0.002),
        Electrode(0.1, 0.0, 0.012),  # around a corner
    )
    layers = (Layer(0.001, 1.0), Layer(0.004, 0.1))
    design = SensorDesign(BENT, 0.005, electrodes, layers=layers)
    mesh = triangulated_mesh(design, GRADING)
    assert volumes(mesh.points, mesh.cells).sum() == pytest.approx(0.0051 * 0.005, rel=1e-12)
    expected = [patch.area for patch in design.patches()]
    assert covered(mesh, 5) == pytest.approx(expected, rel=1e-9)
    # Interfaces, sheets and the ends of electrodes are layers of points.
    for z in (0.001, 0.0013, 0.0015, 0.0025):
        assert np.abs(mesh.heights - z).min() < 1e-12


def test_triangles_are_fine_around_pads_and_coarse_elsewhere():
    pads = (Electrode(0.03, 0.03, 0.01, on="top"), Electrode(0.12, 0.03, 0.01, on="top"))
    mesh = triangulated_mesh(SensorDesign(Rectangle(0.15, 0.06), 0.005, pads), GRADING)
    lower = mesh.points[mesh.cells[:, :3]]
    longest = np.linalg.norm(lower - np.roll(lower, 1, axis=1), axis=2).max(axis=1)
    at = lower.mean(axis=1)
    on_rim = np.abs(np.maximum(*np.abs(at[:, :2] - [0.03, 0.03]).T) - 0.005) < 5e-4
    far = np.abs(at[:, 0] - 0.075) < 0.02
    assert longest[on_rim].max() < 1.3 * GRADING.finest
    assert 0.5 * GRADING.coarsest < longest[far].mean() < GRADING.coarsest


@pytest.mark.slow
def test_arcs_are_approached_by_chords_and_weighed_by_their_true_area():
    disc = Disc(0.115)
    design = SensorDesign(disc, 0.07, uniform(disc, 32, width=0.0125), encapsulated_thickness=0.1)
    mesh = triangulated_mesh(design, GRADING)
    true = np.bincount(mesh.contacts.electrode, mesh.contacts.areas)
    assert true == pytest.approx(np.full(32, 0.0125 * 0.07), rel=1e-12)
    sides = mesh.contacts.corners[:, [1, -1]] - mesh.contacts.corners[:, :1]
    longest = np.linalg.norm(sides[..., :2], axis=2).max()
    # A chord c of radius R is shorter than its arc by (c / R)^2 / 24.
    missing = 1 - covered(mesh, 32) / (0.0125 * 0.07)
    assert missing.min() > 0
    bound = (longest / disc.radius) ** 2 / 24
    assert 0.1 * bound < missing.max() < 1.001 * bound
    assert mesh.contacts.corners.shape[1] == 4


def test_surfaces_are_refused(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    file = tmp_path / "box.stl"
    trimesh.creation.box((0.05, 0.04, 0.01)).export(file)
    ends = tuple(Electrode(x, 0, 0.004, on="surface", z=0) for x in (0.025, -0.025))
    design = SensorDesign(Surface(file), 0.01, ends)
    with pytest.raises(ConfigurationError, match=r"plane.*tetrahedra"):
        triangulated_mesh(design, GRADING)
