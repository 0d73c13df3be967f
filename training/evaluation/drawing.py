"""Style of the figures of a report, and the sensors and pictures that they show."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NearestNDInterpolator

from eitskin.extras import require
from eitskin.geometry import Disc, Electrode, PlaneOutline, SensorDesign, Surface
from eitskin.training.reconstruction.pixel_grid import PixelGrid

Array = NDArray[np.float64]
Circle = tuple[float, float, float]
"""x, y and radius [m]."""

EXTRA = "view"  # of eitskin, that brings matplotlib

# Okabe and Ito's colours, which all kinds of colour vision show apart.
BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
DARK, GREY, LIGHT, PALE = "#222222", "#7a7a7a", "#c9c9c9", "#e6e6e6"

COLOURS = "RdBu_r"  # red: more conductive; blue: less, as under a touch
COLUMNS = 3
_PANEL = 3.4  # width of a panel, or height of a tall one [inch]

_STYLE = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.labelcolor": DARK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": PALE,
    "grid.linewidth": 0.7,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": DARK,
    "ytick.labelcolor": DARK,
    "legend.frameon": False,
    "savefig.dpi": 150,
    "savefig.facecolor": "white",
}


@dataclass(frozen=True, slots=True, eq=False)
class CaptionedFigure:
    """A matplotlib figure and its caption."""

    figure: Any
    caption: str


@dataclass(frozen=True, slots=True)
class NoFigure:
    """Reason for a figure that is left out."""

    why: str


@contextmanager
def style() -> Iterator[None]:
    """Context in which figures are drawn and saved with the style of the report."""
    with require("matplotlib", EXTRA).rc_context(_STYLE):
        yield


def new_figure(width: float, height: float) -> Any:
    """Empty figure of this size [inch], without a window."""
    figure = require("matplotlib.figure", EXTRA).Figure
    return figure(figsize=(width, height), layout="constrained")


def draw_sensor(axes: Any, design: SensorDesign, numbers: bool = False) -> None:
    """Draw the outline of the conductive layer and its electrodes from above, in mm.

    With `numbers`, next to each electrode stands its number.
    """
    outline = design.outline
    margin = (0.07 if numbers else 0.03) * max(outline.length, outline.width) * 1e3
    if not isinstance(outline, Surface):
        around = np.sort(np.append(np.linspace(0, outline.perimeter, 241), outline.corners))
        axes.plot(*(1e3 * outline.rim_points(around)).T, color=GREY, linewidth=1.2, zorder=1)
    for electrode in design.electrodes:
        if electrode.on == "side" and not isinstance(outline, Surface):
            middle = outline.locate(electrode.x, electrode.y)
            along = middle + np.linspace(-0.5, 0.5, 9) * electrode.width
            places = 1e3 * outline.rim_points(along % outline.perimeter)
            axes.plot(*places.T, color=GREY, linewidth=5, solid_capstyle="butt", zorder=1)
        else:
            axes.plot(1e3 * electrode.x, 1e3 * electrode.y, "s", color=GREY, zorder=1)
        if numbers and not isinstance(outline, Surface):
            _number(axes, outline, electrode, str(design.electrodes.index(electrode)))
    axes.set(xlim=(-margin, 1e3 * outline.length + margin), aspect="equal")
    axes.set(ylim=(-margin, 1e3 * outline.width + margin))
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)


def _number(axes: Any, outline: PlaneOutline, electrode: Electrode, text: str) -> None:
    """Write an electrode's number: outside the rim next to one on the side, above any other."""
    x, y = electrode.x, electrode.y
    away = np.array([0.0, 1.0])
    if electrode.on == "side":
        middle, step = outline.locate(x, y), 1e-3 * outline.perimeter
        ahead, behind = outline.rim_points(
            np.array([middle + step, middle - step]) % outline.perimeter
        )
        away = np.array([1.0, -1.0]) * (ahead - behind)[::-1]
        away /= np.linalg.norm(away)
    axes.annotate(
        text,
        (1e3 * x, 1e3 * y),
        xytext=8.0 * away,
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=7.5,
        color=DARK,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PicturePanel:
    """Panel of a figure of pictures.

    Attributes:
        title: title above the picture.
        design: design of the sensor.
        grid: pixels of the picture; None for one of the whole bounding box.
        values: dimensionless (rows, columns); NaN outside.
        circles: true positions of what changed, where known.
        crosses: x and y of touches that were found (k, 2) [m].
        noise: sizes of values (rows, columns) up to which they are grey; NaN where unknown.
    """

    title: str
    design: SensorDesign
    grid: PixelGrid | None
    values: NDArray[np.floating]
    circles: tuple[Circle, ...] = ()
    crosses: Array = field(default_factory=lambda: np.zeros((0, 2)))
    noise: NDArray[np.floating] | None = None


def draw_panels(
    panels: Sequence[PicturePanel],
    columns: int = COLUMNS,
    common: bool = True,
    shares: bool = False,
) -> Any:
    """Figure of pictures, row by row.

    Changes of conductivity have colour scales in percent centred at zero.

    Args:
        panels: the pictures.
        columns: most panels in a row.
        common: one scale for all, so that pictures of one method are comparable; else each its own.
        shares: whether the pictures are touch maps, whose pixels count from 0 to 1.
    """
    across = min(columns, len(panels))
    rows = math.ceil(len(panels) / across)
    outline = panels[0].design.outline
    tall = outline.width / outline.length
    width, height = (_PANEL, _PANEL * tall) if tall < 1 else (_PANEL / tall, _PANEL)
    figure = new_figure(1.25 * across * max(width, 2.2) + 0.4, rows * (height + 0.75) + 0.35)
    axes = figure.subplots(rows, across, squeeze=False).ravel()
    limits = [100.0 * float(np.nanmax(np.abs(panel.values))) for panel in panels]
    if common:
        limits = [max(limits)] * len(panels)
    for axis, panel, limit in zip(axes, panels, limits, strict=False):
        image = _draw_picture(axis, panel, limit or 100.0, shares)
        if shares:
            continue
        bar = figure.colorbar(image, ax=axis, shrink=0.8, pad=0.02, aspect=18)
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=7.5, length=2)
    for unused in axes[len(panels) :]:
        unused.set_axis_off()
    colours = "" if shares else "; colours: change of conductivity [%]"
    if any(panel.noise is not None and np.isfinite(panel.noise).any() for panel in panels):
        colours += ", grey: within the noise"
    figure.supxlabel(f"x [mm]{colours}", fontsize=9)
    figure.supylabel("y [mm]", fontsize=9)
    return figure


def _draw_picture(axes: Any, panel: PicturePanel, limit: float, shares: bool) -> Any:
    """Draw one picture with the sensor's outline and numbered electrodes; returns the image."""
    outline = panel.design.outline
    axes.set_axisbelow(False)
    values = 100.0 * _fill_outside(panel.grid, panel.values)
    colours = require("matplotlib", EXTRA).colormaps["Oranges" if shares else COLOURS]
    if panel.noise is not None:
        small = np.abs(values) <= 100.0 * _fill_outside(panel.grid, panel.noise)
        values, colours = np.ma.masked_array(values, small), colours.with_extremes(bad=LIGHT)
    image = axes.imshow(
        values,
        cmap=colours,
        vmin=0.0 if shares else -limit,
        vmax=limit,
        origin="lower",
        extent=(0.0, 1e3 * outline.length, 0.0, 1e3 * outline.width),
        interpolation="nearest",
        zorder=0,
    )
    patches, ticker = (require(f"matplotlib.{name}", EXTRA) for name in ("patches", "ticker"))
    if not isinstance(outline, Surface):
        along = np.linspace(0.0, outline.perimeter, 181)[:-1]
        rim = outline.rim_points(along) if isinstance(outline, Disc) else outline.vertices
        image.set_clip_path(patches.Polygon(1e3 * rim, transform=axes.transData, closed=True))
    draw_sensor(axes, panel.design, numbers=True)
    for x, y, radius in panel.circles:
        circle = patches.Circle((1e3 * x, 1e3 * y), 1e3 * radius)
        circle.set(fill=False, edgecolor=DARK, linewidth=0.9, linestyle="--")
        axes.add_patch(circle)
    halo = require("matplotlib.patheffects", EXTRA).withStroke(linewidth=2.2, foreground="white")
    cross = {"color": DARK, "markersize": 5, "markeredgewidth": 1.2, "path_effects": [halo]}
    axes.plot(*(1e3 * panel.crosses.T), "x", **cross)
    axes.set_title(panel.title, fontsize=9.5, pad=4)
    axes.tick_params(labelsize=7.5, length=2)
    round_ticks = ticker.MaxNLocator(5, steps=(1, 2, 5, 10))
    for set_ticks, extent in ((axes.set_xticks, outline.length), (axes.set_yticks, outline.width)):
        ticks = round_ticks.tick_values(0.0, 1e3 * extent)
        set_ticks([tick for tick in ticks if -1e-6 <= tick <= 1e3 * extent + 1e-6])
    return image


def _fill_outside(grid: PixelGrid | None, values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Values (rows, columns), those outside taken from the nearest pixel inside.

    The rim then cuts the picture, not the staircase of its pixels.
    """
    if grid is None:
        return values
    nearest = NearestNDInterpolator(grid.centres, values[grid.inside])
    filled: Array = nearest(*np.meshgrid(grid.x, grid.y))
    return filled
