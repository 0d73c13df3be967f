"""Pictures of scenes: the deformed sensor, coloured by conductance, strain or current."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.geometry.deformation.kinematics import Deformation
from eitskin.geometry.meshing.grading import Grading
from eitskin.geometry.meshing.mesh import Mesh
from eitskin.geometry.meshing.mesh_design import mesh_design, natural_cells
from eitskin.protocol import Protocol
from eitskin.simulator.electrical.forward_model import AreaRatio, ForwardModel
from eitskin.simulator.scene.scene import Scene
from eitskin.simulator.simulator import Field, Simulator
from eitskin.simulator.view import shapes
from eitskin.simulator.view.render import MATT, TRUE, Panel, colour_scale, render

Array = NDArray[np.float64]
Colour = Literal["conductance", "strain", "current"]

# Cells along the longer side of the drawn mesh: finer than a dent where cells are cheap.
CELLS = {"hexahedra": 200, "prisms": 80, "tetrahedra": 30}
_ORDER: dict[str, tuple[int, ...]] = {"hexahedra": (1, 1), "prisms": (1, 1), "tetrahedra": (1,)}
_SMALLEST_RANGE = 0.01  # of the colours, so that rounding does not look like a deformation
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
    change: Array = conductivity(points)[:, 0, 0] / sim.design.conductivity_at(points) - 1.0
    return change


def largest_strain(deformation: Deformation | None, points: Array) -> Array:
    """Largest principal logarithmic strain at `points` (n, 3) [m] of the flat sensor, (n,).

    The logarithm of the largest principal stretch (Hencky 1928) is positive wherever an
    incompressible body deforms, because at least one fibre is stretched.
    """
    if deformation is None:
        return np.zeros(len(points))
    F = deformation.gradient(points)
    squares = np.linalg.eigvalsh(np.swapaxes(F, -1, -2) @ F)
    strain: Array = 0.5 * np.log(squares[:, -1])
    return strain


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
        model: of the flat body.
        deformation: of the body; None where the body is flat.
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


def most_changed(sim: Simulator, scene: Scene) -> tuple[int, int]:
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
        path: of the PNG file.
        colour: "conductance", the change of `conductance_change`; "strain", `largest_strain`; or
            "current", the magnitude of `deformed_current_density`.
        drive: electrodes where the current enters and leaves; `most_changed` of each scene when
            omitted.

    Raises ImportError, naming the extra, where pyvista is missing, and ConfigurationError where
    the file cannot be written or the colour or an electrode does not exist.
    """
    if colour not in get_args(Colour):
        raise ConfigurationError(f"colour must be one of {get_args(Colour)}, got {colour!r}")
    if drive is not None:
        Protocol(((*drive, *drive),), len(sim.design.electrodes))
    order, grading, model = _ORDER[natural_cells(sim.design)], _grading(sim), None
    if colour == "current":
        model = ForwardModel(sim.design, (order, grading))
    flat = model.mesh if model else mesh_design(sim.design, grading)
    shown = [_drawing(sim, scene, flat, colour, model, drive) for _, scene in scenes]
    seen = np.concatenate([part.points for one in shown for part in (one.body, *one.indenters)])
    scale = _scale(colour, [one.values for one in shown])
    panels = []
    for number, ((title, _), one) in enumerate(zip(scenes, shown, strict=True)):
        last = number == len(shown) - 1
        driven = f", driven from {one.drive[0]} to {one.drive[1]}" if one.drive else ""
        panels.append(Panel(title + driven, seen, _painter(flat, one, scale, last), legend=last))
    render(panels, path)


class _Drawing(NamedTuple):
    """Drawing of one scene: deformed gel, values at its points, indenters and drive pair."""

    body: Mesh
    values: Array
    indenters: list[Any]
    drive: tuple[int, ...]


def _drawing(
    sim: Simulator,
    scene: Scene,
    flat: Mesh,
    colour: Colour,
    model: ForwardModel | None,
    drive: tuple[int, int] | None,
) -> _Drawing:
    deformation = sim.deformation(scene)
    body, indenters = _moved(flat, deformation), indenter_surfaces(sim, scene)
    if model is not None:
        pair = drive or most_changed(sim, scene)
        fields = sim.conductivity(scene), sim.area_ratio(scene)
        density = deformed_current_density(model, deformation, pair, *fields)
        values = shapes.at_points(flat, 1e-3 * np.linalg.norm(density, axis=1))  # of 1 mA
        return _Drawing(body, values, indenters, pair)
    if colour == "strain":
        return _Drawing(body, largest_strain(deformation, flat.points), indenters, ())
    return _Drawing(body, 100.0 * conductance_change(sim, scene, flat.points), indenters, ())


def _grading(sim: Simulator) -> Grading:
    outline, kind = sim.design.outline, natural_cells(sim.design)
    size = max(outline.length, outline.width) / CELLS[kind]
    layers = 1 if kind == "tetrahedra" else max(3, round(sim.design.thickness / (4.0 * size)))
    return Grading(size, size, 1.0, layers)


def _moved(mesh: Mesh, deformation: Deformation | None) -> Mesh:
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
                left, _, right = np.linalg.svd(bent.gradient(tip))
                tip, turned = bent.positions(tip), left @ right
            bodies.append(shapes.revolved(press.touch.indenter, tip, turned))
    return bodies


def _scale(colour: Colour, values: Sequence[Array]) -> dict[str, Any]:
    """Colour scale of all scenes, as arguments of pyvista's add_mesh."""
    everything = np.concatenate(values)
    if colour == "current":
        low, high = (float(value) for value in np.percentile(everything, [5.0, 99.9]))
        bar = colour_scale("current density for 1 mA [A/m2]", fmt="%.2g")
        clim = (max(low, 1e-3 * high), high)
        colours = {"cmap": "viridis_r", "clim": clim, "log_scale": True}
        # Colours of the current hardly show the dents, which need shading.
        return {**colours, **MATT, "scalar_bar_args": bar}
    smallest = _SMALLEST_RANGE * (100.0 if colour == "conductance" else 1.0)
    reach = round_number(max(float(np.abs(everything).max()), smallest))
    if colour == "strain":
        bar = colour_scale("largest principal strain, logarithmic [-]", fmt="%.3g")
        return {"cmap": "YlGnBu", "clim": (0.0, reach), **TRUE, "scalar_bar_args": bar}
    bar = colour_scale("change of conductance along x [%]", fmt="%.3g")
    return {"cmap": "RdBu", "clim": (-reach, reach), **TRUE, "scalar_bar_args": bar}


def round_number(value: float) -> float:
    """Smallest number of at least `value` with short halves and quarters."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * next(step for step in _ROUND if value <= step * power * (1.0 + 1e-9))


def _painter(flat: Mesh, shown: _Drawing, scale: dict[str, Any], bar: bool) -> Any:
    def paint(plotter: Any) -> None:
        surface = shapes.surface(shown.body, values=shown.values, flat=flat.points)
        plotter.add_mesh(
            surface,
            scalars="values",
            smooth_shading=True,
            split_sharp_edges=True,
            show_scalar_bar=bar,
            **scale,
        )
        shapes.add_net(
            plotter, surface, flat, round_number(np.ptp(flat.points, axis=0).max() / _NET)
        )
        shapes.add_electrodes(plotter, shown.body, shown.drive)
        shapes.add_numbers(plotter, shown.body, range(len(shown.body.electrode_facets)))
        for indenter in shown.indenters:
            shapes.add_indenter(plotter, indenter)

    return paint
