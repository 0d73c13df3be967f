"""Pictures of scenes: the bent, pressed sensor, coloured by how its conductance changed."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry import SensorDesign
from eitskin.geometry.deformation import pulled_back
from eitskin.geometry.optional import require
from eitskin.simulator.scene import Scene
from eitskin.simulator.simulator import Simulator

Array = NDArray[np.float64]

_STEP = 0.75e-3  # of the drawn grid [m], finer than any dent
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

    The layer stands at its deformed place, true to scale; electrodes are dark.
    Raises ImportError, naming the extra, where pyvista is missing.
    """
    # Without a display VTK would try X first and complain; EGL needs none.
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    pv = require("pyvista", "view")
    plotter = pv.Plotter(
        off_screen=True, shape=(len(scenes), 1), window_size=(1100, 430 * len(scenes)), border=False
    )
    for row, (title, scene) in enumerate(scenes):
        plotter.subplot(row, 0)
        _add_scene(plotter, pv, sim, scene, scale=row == 0)
        plotter.add_text(title, font_size=11, position="upper_left", color="black")
        plotter.set_background("white")
        plotter.camera_position = [(0.155, -0.22, 0.16), (0.073, 0.030, -0.014), (0, 0, 1)]
        plotter.camera.zoom(1.6)
    plotter.screenshot(str(path))
    plotter.close()


def _add_scene(plotter: Any, pv: Any, sim: Simulator, scene: Scene, scale: bool) -> None:
    outline, thickness = sim.design.outline, sim.design.thickness
    axes = (
        np.linspace(0, outline.length, round(outline.length / _STEP) + 1),
        np.linspace(0, outline.width, round(outline.width / _STEP) + 1),
        np.linspace(0, thickness, 5),
    )
    flat = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    layer = pv.StructuredGrid(*np.moveaxis(_moved(sim, scene, flat), -1, 0))
    change = conductance_change(sim, scene, flat.reshape(-1, 3)).reshape(flat.shape[:3])
    layer["change"] = 100.0 * change.ravel(order="F")
    plotter.add_mesh(
        layer.extract_surface(algorithm="dataset_surface"),
        scalars="change",
        cmap="RdBu",
        clim=(-_LIMIT, _LIMIT),
        smooth_shading=True,
        split_sharp_edges=True,
        show_scalar_bar=scale,
        scalar_bar_args={
            "title": "conductance change along x [%]\n",
            "color": "black",
            "title_font_size": 14,
            "label_font_size": 13,
            "position_x": 0.3,
            "position_y": 0.02,
            "width": 0.4,
            "height": 0.11,
        },
    )
    for patch in _electrode_patches(sim.design):
        electrode = pv.StructuredGrid(*np.moveaxis(_moved(sim, scene, patch), -1, 0))
        plotter.add_mesh(electrode, color="#333333")


def _moved(sim: Simulator, scene: Scene, points: Array) -> Array:
    deformation = sim.deformation(scene)
    return points if deformation is None else deformation.positions(points)


def _electrode_patches(design: SensorDesign) -> list[Array]:
    """Grids over the electrodes, (6, 6, 1, 3) [m], lifted a little off the layer's side."""
    patches = []
    for index, electrode in enumerate(design.electrodes):
        side = design.side(index)
        along = np.linspace(-electrode.width / 2, electrode.width / 2, 6)
        outward = np.array([(0, -1, 0), (1, 0, 0), (0, 1, 0), (-1, 0, 0)])[side] * 2e-4
        tangent = np.array([(1, 0, 0), (0, 1, 0)])[side % 2]
        heights = np.linspace(0, design.thickness, 6)
        centre = np.array([electrode.x, electrode.y, 0.0]) + outward
        grid = (
            centre + along[:, None, None] * tangent + heights[None, :, None] * np.array([0, 0, 1])
        )
        patches.append(grid[:, :, None, :])
    return patches
