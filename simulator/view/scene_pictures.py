"""Pictures of scenes: the deformed sensor, coloured by conductance, strain or current."""

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
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.geometry.meshing.mesh_design import natural_cells
from eitskin.protocol import Protocol
from eitskin.simulator.deformation.stored_mesh import stored_mesh
from eitskin.simulator.electrical.forward_model import AreaRatio, ForwardModel
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Field, Simulator
from eitskin.simulator.view import drawing
from eitskin.simulator.view.drawing import MATT, TRUE, Panel, colour_scale, render

Array = NDArray[np.float64]
Colour = Literal["conductance", "strain", "current"]

# Cells along the longer side of the drawn mesh: finer than a dent where cells are cheap.
CELLS = {"hexahedra": 200, "prisms": 80, "tetrahedra": 30}
_MIN_RANGE = 0.01  # of the colours, so that rounding does not look like a deformation
_ROUND = (1.0, 1.2, 1.6, 2.0, 2.4, 3.2, 4.0, 5.0, 6.0, 8.0, 10.0)
_NET = 30.0  # lines of the flat body across its longer side
_ROUNDING = 1e-9  # of the largest measurement: smaller changes count as zero


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
