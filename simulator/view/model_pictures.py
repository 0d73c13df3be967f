"""Pictures of a forward model: sensor, mesh, potential and lines of current."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.geometry.meshing.mesh_design import CellKind, natural_cells
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.forward_model import ForwardModel
from eitskin.simulator.view import shapes
from eitskin.simulator.view.render import DIRECTION, TRUE, Panel, colour_scale, render

Array = NDArray[np.float64]

_LINES = 60  # of current
_CONTOURS = 29


def model_for_pictures(design: SensorDesign, cells: CellKind | None = None) -> ForwardModel:
    """Forward model of low order with dense points, for smooth colours; a few per cent off."""
    kind = cells or natural_cells(design)
    shorter = min(design.outline.length, design.outline.width)
    smallest = min(min(e.width, e.height or e.width) for e in design.electrodes)
    if kind == "tetrahedra":
        coarsest = shorter / 16.0
        grading = Grading(min(smallest / 6.0, coarsest), coarsest, 0.3)
        return ForwardModel(design, ((1,), grading), cells=kind)
    # Edges of electrodes at some height ask for many layers of cells.
    flat = all(e.on == "side" and e.height is None for e in design.electrodes)
    coarsest = shorter / (24.0 if not flat else 50.0 if kind == "hexahedra" else 32.0)
    layers = max(1, math.ceil(design.thickness / (4.0 * coarsest)))
    finest, growth = (smallest / 16.0, 0.5) if flat else (smallest / 8.0, 0.8)
    grading = Grading(min(finest, coarsest), coarsest, growth, layers)
    return ForwardModel(design, ((1, 1), grading), cells=kind)


def draw_mesh(mesh: Mesh, path: str | Path) -> None:
    """Draw the sensor with numbered electrodes, all cells, and the cells at electrode 0."""
    render([_sensor(mesh), _cells(mesh), _cells_at(mesh, 0)], path)


def draw_drive(
    model: ForwardModel, drive: tuple[int, int], path: str | Path, mesh: Mesh | None = None
) -> None:
    """Draw sensor, cells, potential and current of a drive pair, and the plus electrode enlarged.

    The real part is drawn where potential and current are complex.

    Args:
        model: to be solved. Colours vary linearly between its points, which should be dense: see
            `model_for_pictures`.
        drive: electrodes where a current of 1 A enters and leaves.
        path: of the PNG file.
        mesh: with the cells to draw; the model's when omitted.

    Raises ConfigurationError for electrodes that do not exist.
    """
    Protocol(((*drive, *drive),), len(model.design.electrodes))
    cells = mesh or model.mesh
    density = np.real(model.current_density(drive))
    panels = [
        _sensor(cells),
        _cells(cells),
        _potential(model, drive),
        _lines(model.mesh, density, drive),
        _cells_at(cells, drive[0]),
        _density_at(model.mesh, density, drive[0]),
    ]
    render(panels, path, columns=2)


def _sensor(mesh: Mesh) -> Panel:
    def draw(plotter: Any) -> None:
        shapes.add_body(plotter, mesh, opacity=0.5)
        shapes.add_electrodes(plotter, mesh)
        shapes.add_numbers(plotter, mesh, range(len(mesh.electrode_facets)))

    return Panel("sensor", mesh.points, draw)


def _cells(mesh: Mesh) -> Panel:
    kind = {8: "hexahedra", 6: "prisms", 4: "tetrahedra"}[mesh.cells.shape[1]]
    title = f"{len(mesh.cells)} {kind}, {len(mesh.points)} points"
    return Panel(title, mesh.points, lambda plotter: shapes.add_cells(plotter, mesh, 0.7))


def _cells_at(mesh: Mesh, electrode: int) -> Panel:
    """Panel of the cells around an electrode; those above one inside are taken off."""
    height = shapes.height_inside(mesh, electrode)
    title = f"cells at electrode {electrode}"
    return Panel(
        title if height is None else f"{title}, those above it taken off",
        _around(mesh, electrode),
        lambda plotter: shapes.add_cells(plotter, mesh, 1.2, height),
        direction=in_front(mesh, electrode),
    )


def _potential(model: ForwardModel, drive: tuple[int, int]) -> Panel:
    plus, minus = drive
    each = np.real(model.potentials())
    potential = each[:, plus] - each[:, minus]
    potential -= 0.5 * (potential.min() + potential.max())
    reach = float(np.abs(potential).max())

    def draw(plotter: Any) -> None:
        surface = shapes.surface(model.mesh, potential=potential)
        plotter.add_mesh(
            surface,
            scalars="potential",
            cmap="RdBu_r",
            clim=(-reach, reach),
            scalar_bar_args=colour_scale("potential [V/A]", fmt="%.3g"),
            **TRUE,
        )
        levels = np.linspace(-reach, reach, _CONTOURS + 2)[1:-1]
        contours = surface.contour(levels, scalars="potential")
        contours = shapes.towards(DIRECTION, contours, model.mesh)
        plotter.add_mesh(contours, color="#333333", line_width=1.0, opacity=0.7)
        shapes.add_electrodes(plotter, model.mesh, drive)
        shapes.add_numbers(plotter, model.mesh, drive)

    title = f"potential, driven from {plus} to {minus}"
    return Panel(title, model.mesh.points, draw, legend=True)


def _lines(mesh: Mesh, density: Array, drive: tuple[int, int]) -> Panel:
    def draw(plotter: Any) -> None:
        shapes.add_body(plotter, mesh, opacity=0.25)
        lines = shapes.lines_of_current(mesh, density, drive[0], _LINES)
        low, high = np.percentile(lines["magnitude"], [10.0, 98.0])
        plotter.add_mesh(
            lines,
            line_width=2.5,
            scalars="magnitude",
            cmap="viridis_r",
            log_scale=True,
            clim=(max(float(low), 0.01 * float(high)), float(high)),
            scalar_bar_args=colour_scale("current density [A/m2 per A]", fmt="%.2g"),
        )
        shapes.add_electrodes(plotter, mesh, drive)
        shapes.add_numbers(plotter, mesh, drive)

    return Panel(f"current, {_LINES} lines of equal share", mesh.points, draw, legend=True)


def _density_at(mesh: Mesh, density: Array, electrode: int) -> Panel:
    """Panel of the current density around an electrode, largest at the electrode's edges."""
    around, eye = _around(mesh, electrode), in_front(mesh, electrode)

    def draw(plotter: Any) -> None:
        cells = shapes.volume(mesh)
        cells.cell_data["magnitude"] = np.linalg.norm(density, axis=1)
        away = np.linalg.norm(cells.cell_centers().points - around.mean(axis=0), axis=1)
        near = cells["magnitude"][away < 0.6 * np.linalg.norm(np.ptp(around, axis=0))]
        plotter.add_mesh(
            cells.extract_surface(algorithm="dataset_surface"),
            scalars="magnitude",
            cmap="viridis_r",
            log_scale=True,
            clim=(float(np.percentile(near, 5.0)), float(near.max())),
            scalar_bar_args=colour_scale("mean current density in cells [A/m2 per A]", fmt="%.2g"),
            **TRUE,
        )
        shapes.add_rim(plotter, mesh, electrode, eye)

    title = f"current density at electrode {electrode}"
    return Panel(title, around, draw, legend=True, direction=eye)


def _around(mesh: Mesh, electrode: int) -> Array:
    """Corners, (8, 3) [m], of a box about an electrode, twice as large, within the body."""
    corners, _ = shapes.electrode_corners(mesh, electrode)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    middle, reach = 0.5 * (low + high), 1.1 * float((high - low).max())
    bounds = np.clip([middle - reach, middle + reach], mesh.points.min(axis=0), mesh.points.max(0))
    return np.stack(np.meshgrid(*bounds.T), axis=-1).reshape(-1, 3)


def in_front(mesh: Mesh, electrode: int) -> Array:
    """Direction to the viewer, in front of an electrode, never straight above or below.

    Below the body for an electrode at its bottom.
    """
    _, normal = shapes.electrode_corners(mesh, electrode)
    right = np.cross([0.0, 0.0, 1.0], normal)
    eye: Array = normal + 0.3 * right + [0.0, 0.0, 0.7]
    if np.linalg.norm(eye[:2]) < 0.3:
        above_or_below: Array = DIRECTION * [1.0, 1.0, -1.0 if normal[2] < -0.5 else 1.0]
        return above_or_below
    return eye / np.linalg.norm(eye)
