"""VTK files of a scene's deformed sensor and its fields, for ParaView."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.files import atomic_file
from eitskin.geometry.deformation.kinematics import Deformation, largest_strain
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.mesh_design import natural_cells
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.resolution import Discretisation, discretisation
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Simulator
from eitskin.simulator.view import drawing

Array = NDArray[np.float64]
Drive = tuple[int, int]

BODY, ELECTRODES = "body.vtu", "electrodes.vtp"
_CELLS = 60  # along the longer side: dents are visible, impedances within 2e-4 of converged


def field_resolution(design: SensorDesign, cell: float | None = None) -> Discretisation:
    """Standard resolution with cells small enough for fields drawn cell by cell.

    Args:
        design: the sensor.
        cell: largest cell [m]; a sixtieth of the longer side when omitted.
    """
    longer = max(design.outline.length, design.outline.width)
    size = longer / _CELLS if cell is None else cell
    if not 0.0 < size <= longer:
        raise ConfigurationError(
            f"the largest cell must be above 0 and at most {longer:g} m, got {size:g} m; are the "
            "units metres?"
        )
    order, grading = discretisation("standard", design, natural_cells(design))
    finest, coarsest = min(grading.finest, size), min(grading.coarsest, size)
    layers = max(grading.layers, 2)
    return order, dataclasses.replace(grading, finest=finest, coarsest=coarsest, layers=layers)


def scene_grids(
    sim: Simulator, scene: Scene, drives: Sequence[Drive] | None = None
) -> dict[str, Any]:
    """Grids of the deformed body and electrodes with their fields, by file name.

    Positions are deformed ones, in SI units; names of fields end in their unit, with `1` for
    dimensionless ones. Potentials and current densities are for a current of 1 A; potentials are
    relative to the mean of the electrode potentials; the real part stands for complex values.

    body.vtu, at points: `displacement_m`; `largest_strain_1`, logarithmic, see
    `kinematics.largest_strain`; `thinning_1`, see `thinning`; `potential_A_B_V_per_A`. In cells:
    `conductivity_S_per_m`, F K F^T / J of the deformed body, and
    `pulled_back_conductivity_S_per_m`, K = J F^-1 sigma F^-T of the flat body of the solution, both
    (3, 3) row by row; `current_density_A_B_A_per_m2_per_A`, the mean.

    electrodes.vtp, in the pieces of cell faces that electrodes cover: `electrode`, the number;
    `contact_impedance_ohm_m2`; `potential_A_B_V_per_A` of the electrode.

    Args:
        sim: the sensor; see `field_resolution`.
        scene: bend, touches and the like.
        drives: pairs of electrodes where a current enters and leaves; those of `sim.protocol` when
            omitted.

    Returns pyvista grids under "body.vtu" and "electrodes.vtp".

    Raises ImportError, naming the extra, where pyvista is missing, and ConfigurationError for
    electrodes that do not exist.
    """
    pairs = _pairs(sim, drives)
    layer, mesh, model = sim.deformed_layer(scene), sim.model.mesh, sim.model
    deformation, electrode = layer.deformation, mesh.contacts.electrode
    fields = model.fields(layer.conductivity, layer.area_ratio)
    middles = mesh.points[mesh.cells].mean(axis=1)
    points, corners, F = mesh.points, mesh.contacts.corners, np.broadcast_to(np.eye(3), (1, 3, 3))
    if deformation is not None:
        points, corners = deformation.positions(points), deformation.positions(corners)
        F = deformation.gradient(middles)
    forward, pulled_back = F / np.linalg.det(F)[:, None, None], layer.conductivity(middles)
    spatial = forward @ pulled_back @ np.swapaxes(F, -1, -2)
    body = drawing.volume(dataclasses.replace(mesh, points=points))
    body["displacement_m"] = points - mesh.points
    body["largest_strain_1"] = largest_strain(deformation, mesh.points)
    body["thinning_1"] = thinning(sim, deformation, mesh.points)
    body.point_data.update(_values_by_drive("potential_{}_{}_V_per_A", fields.potentials, pairs))
    body["conductivity_S_per_m"] = spatial.reshape(-1, 9)
    body["pulled_back_conductivity_S_per_m"] = pulled_back.reshape(-1, 9)
    densities, name = forward @ fields.current_densities, "current_density_{}_{}_A_per_m2_per_A"
    body.cell_data.update(_values_by_drive(name, densities, pairs))
    electrodes = drawing.polygons(corners)
    electrodes["electrode"] = electrode
    electrodes["contact_impedance_ohm_m2"] = np.real(model.contact_impedance)[electrode]
    potentials = fields.electrode_potentials[electrode]
    electrodes.cell_data.update(_values_by_drive("potential_{}_{}_V_per_A", potentials, pairs))
    return {BODY: body, ELECTRODES: electrodes}


def write_grids(grids: Mapping[str, Any], folder: str | Path) -> None:
    """Write grids as binary VTK files; raises ConfigurationError where a file cannot be written."""
    for name, grid in grids.items():
        with atomic_file(Path(folder) / name) as temporary:
            grid.save(temporary, binary=True)


def thinning(sim: Simulator, deformation: Deformation | None, points: Array) -> Array:
    """Relative loss of thickness at flat `points` (n, 3) [m], (n,).

    The deformed thickness is the distance of lower and upper face at the x and y of a point.
    """
    if deformation is None:
        return np.zeros(len(points))
    flat = sim.design.thickness
    faces = [np.column_stack([points[:, :2], np.full(len(points), z)]) for z in (0.0, flat)]
    low, high = (deformation.positions(face) for face in faces)
    thinner: Array = 1.0 - np.linalg.norm(high - low, axis=1) / flat
    return thinner


def _pairs(sim: Simulator, drives: Sequence[Drive] | None) -> list[Drive]:
    if drives is None:
        return list(dict.fromkeys((plus, minus) for plus, minus, *_ in sim.protocol.table))
    for drive in drives:
        Protocol(((*drive, *drive),), len(sim.design.electrodes))
    return list(drives)


def _values_by_drive(
    name: str, values: NDArray[np.inexact], drives: Sequence[Drive]
) -> dict[str, NDArray[Any]]:
    """Values for each drive from those of the electrodes, (..., electrodes), by their names."""
    real = np.real(values)
    return {name.format(a, b): real[..., a] - real[..., b] for a, b in drives}
