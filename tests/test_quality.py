"""Cell quality against known shapes and pyvista's measures; the gate."""

import dataclasses

import numpy as np
import pytest

from eitskin.geometry import ConfigurationError, Contacts, Disc, Mesh, SensorDesign
from eitskin.geometry.grading import Grading
from eitskin.geometry.layouts import uniform
from eitskin.geometry.meshing import mesh_of
from eitskin.geometry.quality import check_quality, quality, scaled_jacobian

DESIGN = SensorDesign.reference()
GRADING = Grading(finest=1e-3, coarsest=6e-3, growth=1.0)
NOWHERE = Contacts(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3, 3)), ())
ROOT = np.sqrt(3.0)
SHAPES = {
    "box": [[0, 0, 0], [9, 0, 0], [9, 2, 0], [0, 2, 0], [0, 0, 1], [9, 0, 1], [9, 2, 1], [0, 2, 1]],
    "prism": [[0, 0, 0], [1, 0, 0], [0.5, ROOT / 2, 0], [0, 0, 5], [1, 0, 5], [0.5, ROOT / 2, 5]],
    "tetrahedron": [[1, 1, 1], [1, -1, -1], [-1, -1, 1], [-1, 1, -1]],
}


def single(points) -> Mesh:
    points = np.asarray(points, dtype=float)
    return Mesh(points, np.arange(len(points))[None], NOWHERE, None)


@pytest.mark.parametrize("name", SHAPES)
def test_ideal_cells_have_one_and_mirrored_cells_minus_one(name) -> None:
    points = np.array(SHAPES[name], dtype=float)
    assert scaled_jacobian(single(points)) == pytest.approx([1.0])
    assert scaled_jacobian(single(points * [1, 1, -1])) == pytest.approx([-1.0])


@pytest.mark.parametrize("cells", ["hexahedra", "prisms"])
def test_volume_and_counts_of_a_mesh(cells) -> None:
    mesh = mesh_of(DESIGN, GRADING, cells)
    found = quality(mesh)
    assert (found.cells, found.points) == (len(mesh.cells), len(mesh.points))
    assert found.volume == pytest.approx(0.150 * 0.060 * 0.005, rel=1e-12)
    assert found.scaled_jacobian <= found.median_scaled_jacobian <= 1.0 + 1e-12
    assert found.aspect_ratio >= found.median_aspect_ratio >= 1.0
    assert scaled_jacobian(mesh)[found.worst] == found.scaled_jacobian
    check_quality(mesh)


@pytest.mark.parametrize("kind", ["box", "prism", "tetrahedron"])
def test_agrees_with_pyvista_on_distorted_cells(kind) -> None:
    pv = pytest.importorskip("pyvista")
    rng = np.random.default_rng(4)
    cell_type = {"box": 12, "prism": 13, "tetrahedron": 10}[kind]
    for _ in range(20):
        base = np.array(SHAPES[kind], dtype=float)
        points = base + 0.15 * rng.standard_normal(base.shape)
        grid = pv.UnstructuredGrid(
            np.append(len(points), np.arange(len(points))), [cell_type], points
        )
        theirs = grid.cell_quality("scaled_jacobian")["scaled_jacobian"]
        ours = scaled_jacobian(single(points))
        # VTK's box also looks at its middle, which is worst only in twisted boxes.
        assert ours == pytest.approx(theirs, rel=1e-9)


def test_prisms_of_a_disc_fill_it() -> None:
    outline = Disc(0.05)
    design = SensorDesign(outline, 0.005, uniform(outline, 6, width=0.008))
    found = quality(mesh_of(design, GRADING))
    assert found.volume == pytest.approx(np.pi * 0.05**2 * 0.005, rel=5e-3)
    assert found.scaled_jacobian > 0.3


def test_the_gate_names_the_worst_cell() -> None:
    mesh = mesh_of(DESIGN, GRADING)
    points = mesh.points.copy()
    inner = mesh.cells[100, 0]
    points[inner, 0] += 0.02
    moved = dataclasses.replace(mesh, points=points)
    with pytest.raises(ConfigurationError, match=r"inside out; the worst, cell \d+ at"):
        check_quality(moved)
    points[inner] = np.nan
    with pytest.raises(ConfigurationError, match="not finite"):
        check_quality(dataclasses.replace(mesh, points=points))
    points[inner] = points[mesh.cells[100, 1]]
    with pytest.raises(ConfigurationError, match="flat or inside out"):
        check_quality(dataclasses.replace(mesh, points=points))
