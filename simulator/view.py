"""Pictures of scenes: the bent, pressed sensor, coloured by how its conductance changed."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry import Mesh
from eitskin.geometry.deformation import Deformation, pulled_back
from eitskin.geometry.grading import Grading
from eitskin.geometry.meshing import mesh_of, natural_cells
from eitskin.simulator import shapes
from eitskin.simulator.panels import MATT, Panel, colour_scale, render
from eitskin.simulator.scene import Scene
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

# Cells along the longer side of what is drawn: finer than a dent where they are cheap.
_CELLS = {"hexahedra": 200, "prisms": 80, "tetrahedra": 30}
_LIMIT = 40.0  # of the colours, percent


def conductance_change(sim: Simulator, scene: Scene, points: Array) -> Array:
    """Relative change of the conductance along x at `points` (n, 3) [m] of the flat sensor, (n,).

    The entry xx of J F^-1 F^-T less one: what a current along the sensor meets.
    """
    deformation = sim.deformation(scene)
    if deformation is None:
        return np.zeros(len(points))
    change: Array = pulled_back(deformation.gradient(points))[:, 0, 0] - 1.0
    return change


def draw(sim: Simulator, scenes: Sequence[tuple[str, Scene]], path: str | Path) -> None:
    """Render titled scenes below each other into a PNG at `path`, without a screen.

    The body stands at its deformed place, all scenes true to one scale, with its electrodes.
    Raises ImportError, naming the extra, where pyvista is missing, and ConfigurationError where
    the file cannot be written.
    """
    flat = _mesh(sim)
    bodies = [_moved(flat, sim.deformation(scene)) for _, scene in scenes]
    seen = np.concatenate([body.points for body in bodies])
    panels = []
    for number, ((title, scene), body) in enumerate(zip(scenes, bodies, strict=True)):
        change = 100.0 * conductance_change(sim, scene, flat.points)
        last = number == len(bodies) - 1
        panels.append(Panel(title, seen, _painter(body, change, last), legend=last))
    render(panels, path)


def _mesh(sim: Simulator) -> Mesh:
    outline, thickness = sim.design.outline, sim.design.thickness
    kind = natural_cells(sim.design)
    size = max(outline.length, outline.width) / _CELLS[kind]
    layers = 1 if kind == "tetrahedra" else max(3, round(thickness / (4.0 * size)))
    return mesh_of(sim.design, Grading(size, size, 1.0, layers), kind)


def _moved(mesh: Mesh, deformation: Deformation | None) -> Mesh:
    if deformation is None:
        return mesh
    corners = deformation.positions(mesh.contacts.corners)
    contacts = dataclasses.replace(mesh.contacts, corners=corners)
    return dataclasses.replace(mesh, points=deformation.positions(mesh.points), contacts=contacts)


def _painter(body: Mesh, change: Array, scale: bool) -> Any:
    def paint(plotter: Any) -> None:
        plotter.add_mesh(
            shapes.surface(body, change=change),
            scalars="change",
            cmap="RdBu",
            clim=(-_LIMIT, _LIMIT),
            smooth_shading=True,
            split_sharp_edges=True,
            show_scalar_bar=scale,
            scalar_bar_args=colour_scale("conductance change along x [%]", fmt="%.0f"),
            **MATT,
        )
        shapes.add_electrodes(plotter, body)

    return paint
