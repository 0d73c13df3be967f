"""Panels of reconstructed pictures: change of conductivity over the sensor, electrodes numbered."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NearestNDInterpolator

from eitskin.extras import require
from eitskin.geometry.design.outline import Disc
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.training.evaluation.report.drawing import DARK, EXTRA, draw_sensor, new_figure
from eitskin.training.reconstruction.pixel_grid import PixelGrid

Array = NDArray[np.float64]
Circle = tuple[float, float, float]
"""x, y and radius [m]."""

COLOURS = "RdBu_r"  # red: more conductive; blue: less, as under a touch
COLUMNS = 3
_PANEL = 3.4  # width of a panel, or height of a tall one [inch]


@dataclass(frozen=True, slots=True, eq=False)
class PicturePanel:
    """Panel of a figure of pictures.

    Attributes:
        title: above the picture.
        design: of the sensor.
        grid: pixels of the picture.
        values: relative change of conductivity (rows, columns), dimensionless; NaN outside.
        circles: true positions of what changed, where known.
    """

    title: str
    design: SensorDesign
    grid: PixelGrid
    values: Array
    circles: tuple[Circle, ...] = ()

    @property
    def largest(self) -> float:
        """Largest magnitude of the values."""
        return float(np.nanmax(np.abs(self.values)))


def draw_panels(panels: Sequence[PicturePanel], columns: int = COLUMNS, common: bool = True) -> Any:
    """Figure of pictures, row by row, each with a colour scale in percent centred at zero.

    Args:
        panels: the pictures.
        columns: most panels in a row.
        common: one scale for all, so that pictures of one method are comparable; else each its own.
    """
    across = min(columns, len(panels))
    rows = math.ceil(len(panels) / across)
    outline = panels[0].design.outline
    tall = outline.width / outline.length
    width, height = (_PANEL, _PANEL * tall) if tall < 1 else (_PANEL / tall, _PANEL)
    figure = new_figure(1.25 * across * max(width, 2.2) + 0.4, rows * (height + 0.75) + 0.35)
    axes = figure.subplots(rows, across, squeeze=False).ravel()
    largest = max(panel.largest for panel in panels)
    for each, panel in zip(axes, panels, strict=False):
        image = draw_picture(each, panel, largest if common else panel.largest)
        bar = figure.colorbar(image, ax=each, shrink=0.8, pad=0.02, aspect=18)
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=7.5, length=2)
    for unused in axes[len(panels) :]:
        unused.set_axis_off()
    figure.supxlabel("x [mm]; colours: change of conductivity [%]", fontsize=9)
    figure.supylabel("y [mm]", fontsize=9)
    return figure


def draw_picture(axes: Any, panel: PicturePanel, largest: float) -> Any:
    """Draw one picture with the sensor's outline and numbered electrodes; returns the image."""
    outline, limit = panel.design.outline, 100.0 * (largest or 1.0)
    axes.set_axisbelow(False)
    image = axes.imshow(
        100.0 * _filled(panel),
        cmap=COLOURS,
        vmin=-limit,
        vmax=limit,
        origin="lower",
        extent=(0.0, 1e3 * outline.length, 0.0, 1e3 * outline.width),
        interpolation="nearest",
        zorder=0,
    )
    patches = require("matplotlib.patches", EXTRA)
    image.set_clip_path(
        patches.Polygon(1e3 * _rim(panel.grid), transform=axes.transData, closed=True)
    )
    draw_sensor(axes, panel.design, numbers=True)
    for x, y, radius in panel.circles:
        circle = patches.Circle((1e3 * x, 1e3 * y), 1e3 * radius)
        circle.set(fill=False, edgecolor=DARK, linewidth=0.9, linestyle="--")
        axes.add_patch(circle)
    axes.set_title(panel.title, fontsize=9.5, pad=4)
    axes.tick_params(labelsize=7.5, length=2)
    round_ticks = require("matplotlib.ticker", EXTRA).MaxNLocator(5, steps=(1, 2, 5, 10))
    for set_ticks, extent in ((axes.set_xticks, outline.length), (axes.set_yticks, outline.width)):
        ticks = round_ticks.tick_values(0.0, 1e3 * extent)
        set_ticks([tick for tick in ticks if -1e-6 <= tick <= 1e3 * extent + 1e-6])
    return image


def _rim(grid: PixelGrid) -> Array:
    """Points along the rim (k, 2) [m]; the corners of an outline with straight sides."""
    outline = grid.outline
    if isinstance(outline, Disc):
        return outline.at(np.linspace(0.0, outline.perimeter, 181)[:-1])
    return outline.vertices


def _filled(panel: PicturePanel) -> Array:
    """Values (rows, columns), those outside taken from the nearest pixel inside.

    The rim then cuts the picture, not the staircase of its pixels.
    """
    grid = panel.grid
    nearest = NearestNDInterpolator(grid.centres, panel.values[grid.inside])
    filled: Array = nearest(*np.meshgrid(grid.x, grid.y))
    return filled
