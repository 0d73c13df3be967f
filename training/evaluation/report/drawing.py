"""Style of the figures of a report, and the outline of a sensor in them."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from eitskin.extras import require
from eitskin.geometry.design.electrode import Electrode
from eitskin.geometry.design.outline import PlaneOutline
from eitskin.geometry.design.sensor import SensorDesign
from eitskin.geometry.design.surface import Surface

EXTRA = "view"  # of eitskin, that brings matplotlib

# Okabe and Ito's colours, which all kinds of colour vision tell apart.
BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
DARK, GREY, PALE = "#222222", "#7a7a7a", "#e6e6e6"

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

    With `numbers`, beside each electrode stands its number.
    """
    outline = design.outline
    margin = (0.07 if numbers else 0.03) * max(outline.length, outline.width) * 1e3
    if not isinstance(outline, Surface):
        around = np.sort(np.append(np.linspace(0, outline.perimeter, 241), outline.corners))
        axes.plot(*(1e3 * outline.at(around)).T, color=GREY, linewidth=1.2, zorder=1)
    for electrode in design.electrodes:
        if electrode.on == "side" and not isinstance(outline, Surface):
            middle = outline.locate(electrode.x, electrode.y)
            along = middle + np.linspace(-0.5, 0.5, 9) * electrode.width
            places = 1e3 * outline.at(along % outline.perimeter)
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
    """Write an electrode's number: outside the rim beside one on the side, above any other."""
    x, y = electrode.x, electrode.y
    away = np.array([0.0, 1.0])
    if electrode.on == "side":
        middle, step = outline.locate(x, y), 1e-3 * outline.perimeter
        ahead, behind = outline.at(np.array([middle + step, middle - step]) % outline.perimeter)
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
