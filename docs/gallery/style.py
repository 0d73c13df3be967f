"""One look for all pictures of the pages: colours, sensors from above, saving."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.geometry import Polygon, SensorDesign
from eitskin.geometry.design.outline import PlaneOutline

INK, GREY, PALE = "#1d3142", "#8596a3", "#e6edf1"
TEAL, ORANGE, GOLD, RED = "#17828a", "#e2703a", "#f0b63c", "#c0392b"
RISING = ("#f7fafb", "#b8dcd9", "#58a9ab", "#17828a", "#123f55")
DIVERGING = ("#123f55", "#4f9fa6", "#f7f7f5", "#ee9d68", "#a4331f")

_LOOK = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "text.color": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "figure.dpi": 130,
    "figure.constrained_layout.use": True,
}


def wanted() -> Path | None:
    """The folder in which a picture is wanted: what the script was given, if anything."""
    return Path(sys.argv[1]) if len(sys.argv) > 1 else None


def figure(rows: int, columns: int, size: tuple[float, float], **of: Any) -> Any:
    """A figure and its axes, as `matplotlib.pyplot.subplots` gives them; `size` in inches."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    mpl.rcParams.update(_LOOK)
    return plt.subplots(rows, columns, figsize=size, **of)


def colours(stops: tuple[str, ...]) -> Any:
    """A colour map through the given colours."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("gallery", stops)


def sensor(axes: Any, design: SensorDesign, numbers: bool = True, fill: bool = True) -> None:
    """A sensor from above in millimetres: its outline, its electrodes and their numbers."""
    rim = 1e3 * _rim(design)
    if fill:
        axes.fill(*rim.T, color=PALE, zorder=0)
    axes.plot(*rim.T, color=INK, lw=1.2, zorder=4)
    middle = np.array([design.outline.length, design.outline.width]) * 500.0
    for number, electrode in enumerate(design.electrodes):
        place = 1e3 * np.array([electrode.x, electrode.y])
        along = 1e3 * _along(design, electrode.x, electrode.y, electrode.width)
        axes.plot(*along.T, color=GOLD, lw=5, solid_capstyle="butt", zorder=5)
        if numbers:
            out = place - middle
            at = place + 5.5 * _outward(design, electrode.x, electrode.y, out)
            axes.text(*at, str(number), ha="center", va="center", fontsize=8, color=INK)
    beyond = 9.0 if numbers else 2.0
    axes.set_xlim(-beyond, 1e3 * design.outline.length + beyond)
    axes.set_ylim(-beyond, 1e3 * design.outline.width + beyond)
    axes.set_aspect("equal", anchor="N")
    axes.axis("off")


def name_pairs(axes: Any, labels: Sequence[str]) -> None:
    """Names of pairs of electrodes along x, as many as can be read."""
    step = -(-len(labels) // 15)
    numbers = range(0, len(labels), step)
    axes.set_xticks(numbers, [labels[number] for number in numbers], fontsize=8)


def circle(
    axes: Any, x: float, y: float, text: str = "", line: str = ORANGE, of_text: str = ORANGE
) -> None:
    """The indenter of 15 mm at a place [m], in millimetres."""
    from matplotlib.patches import Circle

    axes.add_patch(Circle((1e3 * x, 1e3 * y), 7.5, fill=False, edgecolor=line, lw=1.6, zorder=6))
    axes.text(1e3 * x, 1e3 * y, text, ha="center", va="center", fontsize=8, color=of_text)


def save(drawn: Any, script: str) -> None:
    """Write the figure as NAME.png of the script NAME.py into the folder that was given."""
    import matplotlib.pyplot as plt

    folder = wanted()
    if folder is None:
        return
    folder.mkdir(parents=True, exist_ok=True)
    drawn.savefig(
        folder / f"{Path(script).stem}.png", bbox_inches="tight", metadata={"Software": None}
    )
    plt.close(drawn)


def _rim(design: SensorDesign) -> NDArray[np.float64]:
    outline = design.outline
    if isinstance(outline, Polygon):
        corners = np.array(outline.points)
        return np.vstack([corners, corners[:1]])
    assert isinstance(outline, PlaneOutline)
    return np.asarray(outline.rim_points(np.linspace(0.0, outline.perimeter, 841)))


def _along(design: SensorDesign, x: float, y: float, width: float) -> NDArray[np.float64]:
    """Places of the rim that an electrode at (x, y) covers."""
    outline = design.outline
    assert isinstance(outline, PlaneOutline)
    s, _ = outline.nearest(np.array([x, y]))
    reach = np.linspace(-0.5 * width, 0.5 * width, 9)
    return np.asarray(outline.rim_points((float(s) + reach) % outline.perimeter))


def _outward(
    design: SensorDesign, x: float, y: float, towards: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit normal of the rim at an electrode, pointing out."""
    ends = _along(design, x, y, 1e-3)
    along = ends[-1] - ends[0]
    normal = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    return normal if normal @ towards >= 0.0 else -normal
