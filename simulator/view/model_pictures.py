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
from eitskin.simulator.view import drawing
from eitskin.simulator.view.drawing import DIRECTION, MATT, TRUE, Panel, colour_scale, render

Array = NDArray[np.float64]

_LINES = 60  # of current
_CONTOURS = 29
_KINDS = {8: "hexahedra", 6: "prisms", 4: "tetrahedra"}


def model_for_pictures(design: SensorDesign, cells: CellKind | None = None) -> ForwardModel:
    """Forward model of low order with dense points, for smooth colours; a few per cent off."""
    kind = cells or natural_cells(design)
    shorter = min(design.outline.length, design.outline.width)
    smallest = min(min(e.width, e.height or e.width) for e in design.electrodes)
    # Edges of electrodes at some height ask for many layers of cells.
    flat = all(e.on == "side" and e.height is None for e in design.electrodes)
    if kind == "tetrahedra":
        parts, per_electrode, growth = 16.0, 6.0, 0.3
    elif flat:
        parts, per_electrode, growth = (50.0 if kind == "hexahedra" else 32.0), 16.0, 0.5
    else:
        parts, per_electrode, growth = 24.0, 8.0, 0.8
    coarsest = shorter / parts
    layers = max(1, math.ceil(design.thickness / (4.0 * coarsest)))
    grading = Grading(min(smallest / per_electrode, coarsest), coarsest, growth, layers)
    return ForwardModel(design, ((1,) if kind == "tetrahedra" else (1, 1), grading), cells=kind)


def draw_mesh(mesh: Mesh, path: str | Path) -> None:
    """Draw the sensor with numbered electrodes, all cells, and the cells at electrode 0."""
    render([_sensor(mesh), _cells(mesh), _cells_panel(mesh, 0)], path)


def draw_drive(
    model: ForwardModel, drive: tuple[int, int], path: str | Path, mesh: Mesh | None = None
) -> None:
    """Draw sensor, cells, potential and current of a drive pair, and the plus electrode enlarged.

    The real part is drawn where potential and current are complex.

    Args:
        model: model to be solved. Colours vary linearly between its points, which should be dense:
            see `model_for_pictures`.
        drive: electrodes where a current of 1 A enters and leaves.
        path: path of the PNG file.
        mesh: mesh with the cells to draw; the model's when omitted.

    Raises ConfigurationError for electrodes that do not exist.
    """
    Protocol(((*drive, *drive),), len(model.design.electrodes))
    cells, (plus, minus) = mesh or model.mesh, drive
    fields = model.fields()
    potential, density = (
        np.real(each[..., plus] - each[..., minus])
        for each in (fields.potentials, fields.current_densities)
    )
    panels = [
        _sensor(cells),
        _cells(cells),
        _potential(model.mesh, potential, drive),
        _lines(model.mesh, density, drive),
        _cells_panel(cells, plus),
        _density_panel(model.mesh, density, plus),
    ]
    render(panels, path, columns=2)


def _sensor(mesh: Mesh) -> Panel:
    def draw(plotter: Any) -> None:
        drawing.add_solid(plotter, drawing.outside(drawing.volume(mesh)), drawing.GEL, 0.5)
        drawing.add_electrodes(plotter, mesh)
        drawing.add_numbers(plotter, mesh, range(len(mesh.electrode_facets)))

    return Panel("sensor", mesh.points, draw)


def _cells(mesh: Mesh) -> Panel:
    title = f"{len(mesh.cells)} {_KINDS[mesh.cells.shape[1]]}, {len(mesh.points)} points"
    return Panel(title, mesh.points, lambda plotter: _add_cells(plotter, mesh, 0.7))


def _cells_panel(mesh: Mesh, electrode: int) -> Panel:
    """Panel of the cells around an electrode; those above one inside are taken off."""
    height = height_inside(mesh, electrode)
    title = f"cells at electrode {electrode}"
    return Panel(
        title if height is None else f"{title}, those above it taken off",
        _box_around_electrode(mesh, electrode),
        lambda plotter: _add_cells(plotter, mesh, 1.2, height),
        direction=in_front(mesh, electrode),
    )


def _add_cells(plotter: Any, mesh: Mesh, line: float, below: float | None = None) -> None:
    """Add cells, all or those below a height [m], and electrodes, with edges `line` pixels wide."""
    edges: dict[str, Any] = {"show_edges": True, "edge_color": drawing.EDGE, "line_width": line}
    cells = drawing.volume(mesh)
    if below is not None:
        cells = cells.extract_cells(cells.cell_centers().points[:, 2] < below)
    plotter.add_mesh(drawing.outside(cells), color=drawing.GEL, **edges, **MATT)
    drawing.add_electrodes(plotter, mesh, **edges)


def _potential(mesh: Mesh, potential: Array, drive: tuple[int, int]) -> Panel:
    potential = potential - 0.5 * (potential.min() + potential.max())
    reach = float(potential.max())

    def draw(plotter: Any) -> None:
        cells = drawing.volume(mesh)
        cells["potential"] = potential
        surface = drawing.outside(cells)
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
        drawing.add_lines(plotter, contours, mesh, color="#333333", opacity=0.7)
        drawing.add_electrodes(plotter, mesh, drive)
        drawing.add_numbers(plotter, mesh, drive)

    title = f"potential, driven from {drive[0]} to {drive[1]}"
    return Panel(title, mesh.points, draw, legend=True)


def _lines(mesh: Mesh, density: Array, drive: tuple[int, int]) -> Panel:
    def draw(plotter: Any) -> None:
        drawing.add_solid(plotter, drawing.outside(drawing.volume(mesh)), drawing.GEL, 0.25)
        lines = drawing.lines_of_current(mesh, density, drive[0], _LINES)
        low, high = np.percentile(lines["magnitude"], [10.0, 98.0])
        limits = max(float(low), 0.01 * float(high)), float(high)
        _add_magnitude(plotter, lines, limits, "current density [A/m2 per A]", line_width=2.5)
        drawing.add_electrodes(plotter, mesh, drive)
        drawing.add_numbers(plotter, mesh, drive)

    return Panel(f"current, {_LINES} lines of equal share", mesh.points, draw, legend=True)


def _density_panel(mesh: Mesh, density: Array, electrode: int) -> Panel:
    """Panel of the current density around an electrode, largest at the electrode's edges."""
    around, eye = _box_around_electrode(mesh, electrode), in_front(mesh, electrode)

    def draw(plotter: Any) -> None:
        cells = drawing.volume(mesh)
        cells.cell_data["magnitude"] = np.linalg.norm(density, axis=1)
        away = np.linalg.norm(cells.cell_centers().points - around.mean(axis=0), axis=1)
        near = cells["magnitude"][away < 0.6 * np.linalg.norm(np.ptp(around, axis=0))]
        limits = float(np.percentile(near, 5.0)), float(near.max())
        title = "mean current density in cells [A/m2 per A]"
        _add_magnitude(plotter, drawing.outside(cells), limits, title, **TRUE)
        plate = drawing.electrode_plate(mesh, electrode, lift=0.0).clean(tolerance=1e-6)
        rim = plate.extract_feature_edges(feature_edges=False, manifold_edges=False)
        drawing.add_lines(plotter, rim, mesh, eye, color=drawing.PLUS, line_width=3.0)

    title = f"current density at electrode {electrode}"
    return Panel(title, around, draw, legend=True, direction=eye)


def _add_magnitude(
    plotter: Any, body: Any, limits: tuple[float, float], title: str, **style: Any
) -> None:
    """Add a body coloured by its "magnitude", on a logarithmic scale."""
    scale = colour_scale(title, fmt="%.2g")
    colours = {"cmap": "viridis_r", "log_scale": True, "clim": limits, "scalar_bar_args": scale}
    plotter.add_mesh(body, scalars="magnitude", **colours, **style)


def _box_around_electrode(mesh: Mesh, electrode: int) -> Array:
    """Corners, (8, 3) [m], of a box about an electrode, twice as large, within the body."""
    corners, _ = drawing.electrode_corners(mesh, electrode)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    middle, reach = 0.5 * (low + high), 1.1 * float((high - low).max())
    bounds = np.clip([middle - reach, middle + reach], mesh.points.min(axis=0), mesh.points.max(0))
    return np.stack(np.meshgrid(*bounds.T), axis=-1).reshape(-1, 3)


def height_inside(mesh: Mesh, electrode: int) -> float | None:
    """Height of an electrode that lies level inside the body [m]; None for all others."""
    heights = drawing.electrode_corners(mesh, electrode)[0][..., 2]
    low, high = mesh.points[:, 2].min(), mesh.points[:, 2].max()
    edge = 1e-6 * (high - low)
    inside = np.ptp(heights) < edge and low + edge < heights.mean() < high - edge
    return float(heights.mean()) if inside else None


def in_front(mesh: Mesh, electrode: int) -> Array:
    """Direction to the viewer, in front of an electrode, never straight above or below.

    Below the body for an electrode at its bottom.
    """
    _, normal = drawing.electrode_corners(mesh, electrode)
    eye: Array = normal + 0.3 * np.cross([0.0, 0.0, 1.0], normal) + [0.0, 0.0, 0.7]
    if np.linalg.norm(eye[:2]) < 0.3:
        eye = DIRECTION * [1.0, 1.0, -1.0 if normal[2] < -0.5 else 1.0]
    return eye / np.linalg.norm(eye)
