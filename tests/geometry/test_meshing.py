"""Structured meshes: they fill the layer, fit the electrodes, and are numbered along x."""

import dataclasses

import numpy as np
import pytest

from eitskin.errors import ConfigurationError
from eitskin.geometry import Electrode, SensorDesign, structured_mesh
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh_design import layer_heights

GRADING = Grading(finest=1e-3, coarsest=4e-3, growth=0.5, layers=2)


def test_cells_fill_the_layer_with_right_handed_boxes() -> None:
    mesh = structured_mesh(SensorDesign.reference(), GRADING)
    corners = mesh.points[mesh.cells]
    edges = corners[:, [1, 3, 4]] - corners[:, :1]
    volumes = np.linalg.det(edges)
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(0.150 * 0.060 * 0.005, rel=1e-12)
    upwards_then_along_y_then_x = np.lexsort(mesh.points[:, ::-1].T)
    assert np.array_equal(upwards_then_along_y_then_x, np.arange(len(mesh.points)))


def test_electrode_facets_have_the_electrodes_area_and_place() -> None:
    design = SensorDesign.reference()
    mesh = structured_mesh(design, GRADING)
    for electrode, facets in zip(design.electrodes, mesh.electrode_facets, strict=True):
        corners = mesh.points[facets]
        across, along = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
        areas = np.linalg.norm(np.cross(across, along), axis=1)
        assert areas.sum() == pytest.approx(electrode.width * design.thickness, rel=1e-12)
        centre = (corners.mean(axis=1) * areas[:, None]).sum(axis=0) / areas.sum()
        assert centre == pytest.approx([electrode.x, electrode.y, design.thickness / 2], abs=1e-12)


def test_cells_are_fine_at_the_electrode_edges_and_coarse_elsewhere_and_end_at_breaks() -> None:
    mesh = structured_mesh(SensorDesign.reference(), GRADING, breaks=(0.0531, 0.0969))
    x = np.unique(mesh.points[:, 0])
    assert np.abs(x[:, None] - [0.0531, 0.0969]).min(axis=0).max() < 1e-12
    sizes = np.diff(x)
    at_edge = sizes[np.searchsorted(x, 0.020 + 1e-9) - 1]
    assert at_edge < 1.3 * GRADING.finest
    assert 0.7 * GRADING.coarsest < sizes.max() <= GRADING.coarsest * (1 + 1e-9)


def test_layers_are_kept_where_electrodes_have_level_edges() -> None:
    electrodes = (*SensorDesign.reference().electrodes, Electrode(0.05, 0.03, on="top"))
    design = dataclasses.replace(SensorDesign.reference(), electrodes=electrodes)
    coarse = Grading(finest=2e-3, coarsest=8e-3, growth=1.0, layers=4)
    assert len(layer_heights(design, coarse)) > 2
    fine = layer_heights(design, dataclasses.replace(coarse, finest=1e-4))
    assert np.diff(fine).max() < 1.01 * 0.005 / 4
    assert np.diff(fine)[-1] < 3e-4 < np.diff(fine)[0]


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        ((2e-3, 1e-3, 0.5), r"finest <= coarsest.*growth.*finest=0.002"),
        ((1e-3, 2e-3, 0.0), "growth=0.0"),
        ((np.nan, 2e-3, 0.5), "finest=nan"),
        ((1e-3, 2e-3, 0.5, 0), r"layer.*0"),
        ((1e-5, 1e-5, 1.0, 300), r"2.7e\+10 points.*4.2e\+04 GB"),
        ((1e-9, 1e-9, 1.0), r"points.*1e-09 to 1e-09 m"),
    ],
)
def test_gradings_that_cannot_be_or_that_no_memory_holds_are_refused(numbers, says):
    with pytest.raises(ConfigurationError, match=says):
        structured_mesh(SensorDesign.reference(), Grading(*numbers))
