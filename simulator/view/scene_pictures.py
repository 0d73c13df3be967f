"""Pictures of scenes, and of a forward model: its sensor, mesh, potential and lines of current."""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Deformation, largest_strain
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.geometry.meshing.mesh_design import CellKind, natural_cells
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.forward_model import AreaRatio, ForwardModel
from eitskin.simulator.electrical.stored_mesh import stored_mesh
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Field, Simulator
from eitskin.simulator.view import drawing
from eitskin.simulator.view.drawing import DIRECTION, MATT, TRUE, Panel, colour_scale, render

Array = NDArray[np.float64]
Colour = Literal["conductance", "strain", "current"]

# Cells along the longer side of the drawn mesh: finer than a dent where cells are cheap.
CELLS = {"hexahedra": 200, "prisms": 80, "tetrahedra": 30}
_MIN_RANGE = 0.01  # of the colours, so that rounding does not look like a deformation
_ROUND = (1.0, 1.2, 1.6, 2.0, 2.4, 3.2, 4.0, 5.0, 6.0, 8.0, 10.0)
_NET = 30.0  # lines of the flat body across its longer side
_ROUNDING = 1e-9  # of the largest measurement: smaller changes count as zero
_LINES = 60  # of current
_CONTOURS = 29
_KINDS = {8: "hexahedra", 6: "prisms", 4: "tetrahedra"}


def conductance_change(sim: Simulator, scene: Scene, points: Array) -> Array:
    """Relative change of the conductance along x at `points` (n, 3) [m] of the flat sensor, (n,).

    The entry xx of J F^-1 sigma F^-T, over sigma, minus one: for a current along the sensor.
    """
    conductivity = sim.conductivity(scene)
    if conductivity is None:
        return np.zeros(len(points))
    ratio = conductivity(points)[:, 0, 0] / sim.design.evaluate_conductivity(points)
    return np.real(ratio) - 1.0


def deformed_current_density(
    model: ForwardModel,
    deformation: Deformation | None,
    drive: tuple[int, int],
    conductivity: Field | None = None,
    area_ratio: AreaRatio | None = None,
) -> Array:
    """Current density in the deformed body per unit drive current, (cells, 3) [1/m2].

    Equal currents pass through a material face of the flat and of the deformed body, with different
    areas: j = F j_ref / J (Piola transformation), with the mean j_ref in each cell of the model and
    F at the cell's centre.

    Args:
        model: model of the flat body.
        deformation: deformation of the body; None where the body is flat.
        drive: electrodes where the current enters and leaves.
        conductivity: f(x), pulled back to the flat body; the design's own when omitted.
        area_ratio: f(x, normals), ratio of deformed to flat area; 1 when omitted.
    """
    flat: Array = np.real(model.current_density(drive, conductivity, area_ratio))
    if deformation is None:
        return flat
    F = deformation.gradient(model.mesh.points[model.mesh.cells].mean(axis=1))
    moved: Array = np.einsum("cij,cj->ci", F, flat) / np.linalg.det(F)[:, None]
    return moved


def most_sensitive_pair(sim: Simulator, scene: Scene) -> tuple[int, int]:
    """Drive pair of the measurement with the largest relative change from the flat sensor.

    Without any change, the drive pair of the largest resistance.
    """
    flat, now = (sim.measure(s).impedance.real for s in (Scene(), scene))
    rounding = _ROUNDING * np.abs(flat).max()
    nonzero = np.abs(flat) > rounding
    change = np.where(nonzero, np.abs(now - flat) / np.where(nonzero, np.abs(flat), 1.0), 0.0)
    score = change if change.max() > _ROUNDING else np.abs(flat)
    plus, minus, *_ = sim.protocol.table[int(np.argmax(score))]
    return plus, minus


def draw_scenes(
    sim: Simulator,
    scenes: Sequence[tuple[str, Scene]],
    path: str | Path,
    colour: Colour = "conductance",
    drive: tuple[int, int] | None = None,
) -> None:
    """Render titled scenes below each other into a PNG at `path`, without a screen.

    The picture has the deformed gel with its electrodes and the indenters, all scenes at one true
    scale; the encapsulation between gel and indenter is left out.

    Args:
        sim: the sensor.
        scenes: titles and scenes.
        path: path of the PNG file.
        colour: "conductance", the change of `conductance_change`; "strain", `largest_strain`; or
            "current", the magnitude of `deformed_current_density`.
        drive: electrodes where the current enters and leaves; `most_sensitive_pair` of each scene
            when omitted.

    Raises ImportError, naming the extra, where pyvista is missing, and ConfigurationError where
    the file cannot be written or the colour or an electrode does not exist.
    """
    if colour not in get_args(Colour):
        raise ConfigurationError(f"colour must be one of {get_args(Colour)}, got {colour!r}")
    if drive is not None:
        Protocol(((*drive, *drive),), len(sim.design.electrodes))
    kind = natural_cells(sim.design)
    size = max(sim.design.outline.length, sim.design.outline.width) / CELLS[kind]
    layers = 1 if kind == "tetrahedra" else max(3, round(sim.design.thickness / (4.0 * size)))
    grading, order = Grading(size, size, 1.0, layers), (1,) if kind == "tetrahedra" else (1, 1)
    model = ForwardModel(sim.design, (order, grading)) if colour == "current" else None
    flat = model.mesh if model else stored_mesh(sim.design, grading)
    drawings = []
    for title, scene in scenes:
        pair = (drive or most_sensitive_pair(sim, scene)) if model else ()
        values = _values(sim, scene, flat, colour, model, pair)
        driven = f", driven from {pair[0]} to {pair[1]}" if pair else ""
        body = _deformed_grid(flat, sim.deformation(scene))
        drawings.append((title + driven, body, values, indenter_surfaces(sim, scene), pair))
    shown = [each.points for _, body, _, tools, _ in drawings for each in (body, *tools)]
    points = np.concatenate(shown)
    scale = _scale(colour, np.concatenate([values for _, _, values, _, _ in drawings]))
    panels = []
    for number, (title, body, values, tools, pair) in enumerate(drawings, 1):
        last = number == len(drawings)
        draw = partial(
            _draw_body, scale | {"show_scalar_bar": last}, flat, body, values, tools, pair
        )
        panels.append(Panel(title, points, draw, legend=last))
    render(panels, path)


def _values(
    sim: Simulator,
    scene: Scene,
    flat: Mesh,
    colour: Colour,
    model: ForwardModel | None,
    drive: tuple[int, ...],
) -> Array:
    """Values at the points of the flat mesh, (points,), that are drawn in colours."""
    if model is not None:
        plus, minus = drive
        layer = sim.deformed_layer(scene)
        fields = layer.conductivity, layer.area_ratio
        density = deformed_current_density(model, layer.deformation, (plus, minus), *fields)
        cells = drawing.volume(flat)
        cells.cell_data["values"] = 1e-3 * np.linalg.norm(density, axis=1)  # of 1 mA
        return np.array(cells.cell_data_to_point_data()["values"], dtype=float)
    if colour == "strain":
        return largest_strain(sim.deformation(scene), flat.points)
    return 100.0 * conductance_change(sim, scene, flat.points)


def _deformed_grid(mesh: Mesh, deformation: Deformation | None) -> Mesh:
    if deformation is None:
        return mesh
    corners = deformation.positions(mesh.contacts.corners)
    contacts = dataclasses.replace(mesh.contacts, corners=corners)
    return dataclasses.replace(mesh, points=deformation.positions(mesh.points), contacts=contacts)


def indenter_surfaces(sim: Simulator, scene: Scene) -> list[Any]:
    """Indenters in contact, rotated by the bend; none without touches."""
    if not scene.touches:
        return []
    bent = sim.deformation(dataclasses.replace(scene, touches=()))
    top = 0.5 * (sim.design.thickness + sim.design.encapsulated_thickness)
    bodies = []
    for press in sim.presses(scene):
        if press.force > 0.0:
            tip, turned = np.array([press.touch.x, press.touch.y, top - press.depth]), np.eye(3)
            if bent is not None:
                left_vectors, _, right = np.linalg.svd(bent.gradient(tip))
                tip, turned = bent.positions(tip), left_vectors @ right
            bodies.append(drawing.indenter_surface(press.touch.indenter, tip, turned))
    return bodies


def _scale(colour: Colour, values: Array) -> dict[str, Any]:
    """Colour scale of all scenes, as arguments of pyvista's add_mesh."""
    reach = float(np.abs(values).max())
    if colour == "current":
        low, high = (float(value) for value in np.percentile(values, [5.0, 99.9]))
        title, cmap, clim = (
            "current density for 1 mA [A/m2]",
            "viridis_r",
            (max(low, 1e-3 * high), high),
        )
    elif colour == "strain":
        title, cmap = "largest principal strain, logarithmic [-]", "YlGnBu"
        clim = (0.0, round_number(max(reach, _MIN_RANGE)))
    else:
        title, cmap = "change of conductance along x [%]", "RdBu"
        reach = round_number(max(reach, 100.0 * _MIN_RANGE))
        clim = (-reach, reach)
    current = colour == "current"
    bar = colour_scale(title, fmt="%.2g" if current else "%.3g")
    # Colours of the current hardly show the dents, which need shading.
    light = MATT if current else TRUE
    return {"cmap": cmap, "clim": clim, "log_scale": current, "scalar_bar_args": bar, **light}


def round_number(value: float) -> float:
    """Smallest number of at least `value` with short halves and quarters."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * next(step for step in _ROUND if value <= step * power * (1.0 + 1e-9))


def _draw_body(
    scale: dict[str, Any],
    flat: Mesh,
    body: Mesh,
    values: Array,
    indenters: Sequence[Any],
    drive: tuple[int, ...],
    plotter: Any,
) -> None:
    """Add the deformed body in its colours, a net of equal x and y, electrodes and indenters."""
    cells = drawing.volume(body)
    cells["values"], cells["flat"] = values, flat.points
    surface = drawing.outside(cells)
    smooth = {"smooth_shading": True, "split_sharp_edges": True}
    plotter.add_mesh(surface, scalars="values", **smooth, **scale)
    spacing = round_number(np.ptp(flat.points, axis=0).max() / _NET)
    for position in surface["flat"][:, :2].T:
        levels = np.arange(position.min() + spacing, position.max() - 0.01 * spacing, spacing)
        lines = surface.contour(levels, scalars=position)
        drawing.add_lines(plotter, lines, flat, color=drawing.EDGE, opacity=0.6)
    drawing.add_electrodes(plotter, body, drive)
    drawing.add_numbers(plotter, body, range(len(body.electrode_facets)))
    for indenter in indenters:
        drawing.add_solid(plotter, indenter, drawing.GLASS, 0.25, angle=20.0)


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
