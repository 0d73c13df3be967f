"""Scenes as VTK files: read back by pyvista, against the model and against closed forms."""

import numpy as np
import pytest
from command_line import printed_json, run

from eitskin.errors import ConfigurationError
from eitskin.geometry import Bend, SensorDesign
from eitskin.geometry.deformation.kinematics import largest_strain
from eitskin.geometry.meshing.grading import Grading
from eitskin.simulator import Scene, Simulator, Touch
from eitskin.simulator.view.scene_pictures import deformed_current_density
from eitskin.simulator.view.vtu import (
    BODY,
    ELECTRODES,
    scene_grids,
    write_grids,
)

from on_demand import OnDemand

pytestmark = pytest.mark.slow

pyvista = OnDemand("pyvista")

CELL = 0.008
BENT = Scene(bend=Bend(30.0), touches=(Touch(0.05, 0.02, force=12.0),))


@pytest.fixture(scope="module")
def sim() -> Simulator:
    """A simulator of few cells: the values compared are exact on any mesh."""
    return Simulator(SensorDesign.reference(), ((2, 1), Grading(2e-3, CELL, 1.0, layers=2)))


@pytest.fixture(scope="module")
def written(sim, tmp_path_factory):
    """Body and electrodes of a bent and pressed sensor, as pyvista reads them."""
    folder = tmp_path_factory.mktemp("vtu")
    grids = scene_grids(sim, BENT)
    write_grids(grids, folder)
    body, electrodes = pyvista.read(folder / BODY), pyvista.read(folder / ELECTRODES)
    assert grids[BODY] == body  # all arrays
    assert grids[ELECTRODES] == electrodes
    assert sorted(path.name for path in folder.iterdir()) == [BODY, ELECTRODES]
    return body, electrodes


def close(said, known, part):
    """Whether arrays differ by at most `part` of the largest value."""
    return np.abs(said - known).max() <= part * np.abs(known).max()


# Content of the files


def test_points_cells_and_fields_are_those_of_the_deformed_model(sim, written):
    body, electrodes = written
    mesh, deformation = sim.model.mesh, sim.deformation(BENT)
    assert np.array_equal(body.points, deformation.positions(mesh.points))
    assert np.array_equal(body.cells_dict[12], mesh.cells)  # hexahedra, in VTK's order
    assert body.compute_cell_sizes()["Volume"].min() > 0.0
    corners = deformation.positions(mesh.contacts.corners)
    assert np.array_equal(electrodes.points, corners.reshape(-1, 3))
    assert electrodes.regular_faces.shape == corners.shape[:2]
    assert np.array_equal(electrodes["electrode"], mesh.contacts.electrode)
    mesh, setting = sim.model.mesh, sim.deformed_layer(BENT)
    deformation = setting.deformation
    fields = setting.conductivity, setting.area_ratio
    assert np.array_equal(body["displacement_m"], body.points - mesh.points)
    assert np.array_equal(body["largest_strain_1"], largest_strain(deformation, mesh.points))
    u = sim.model.potentials(*fields)
    for plus, minus, *_ in sim.protocol.table:
        said = body[f"potential_{plus}_{minus}_V_per_A"]
        assert close(said, u[:, plus] - u[:, minus], 1e-9)
    density = deformed_current_density(sim.model, deformation, (2, 5), *fields)
    said = body["current_density_2_5_A_per_m2_per_A"]
    assert close(said, density, 1e-9)
    middles = mesh.points[mesh.cells].mean(axis=1)
    pulled_back = body["pulled_back_conductivity_S_per_m"].reshape(-1, 3, 3)
    assert close(pulled_back, setting.conductivity(middles), 1e-12)
    # Deformation moves the gel and leaves its own conductivity alone.
    own = body["conductivity_S_per_m"].reshape(-1, 3, 3)
    assert close(own, sim.design.conductivity * np.eye(3), 1e-12)
    impedance = sim.measure(BENT).impedance.real
    for value, (plus, minus, *_) in zip(impedance, sim.protocol.table, strict=True):
        ends = electrodes[f"potential_{plus}_{minus}_V_per_A"]
        of = electrodes["electrode"]
        assert ends[of == plus][0] - ends[of == minus][0] == pytest.approx(value, rel=1e-9)


# The command


def test_the_command_writes_a_scene(tmp_path) -> None:
    scene, out = tmp_path / "scene.toml", tmp_path / "out"
    scene.write_text("[bend]\nangle_deg = 20.0\n")
    words = ("export", "vtu", scene, "--out", out, "--cell", 0.01, "--drive", 0, 4)
    said = printed_json(*words)
    body = pyvista.read(out / BODY)
    assert (said["cells"], said["points"]) == (body.n_cells, body.n_points)
    assert body["displacement_m"][:, 2].min() < -0.005
    with pytest.raises(ConfigurationError, match="not empty"):
        run(*words)
