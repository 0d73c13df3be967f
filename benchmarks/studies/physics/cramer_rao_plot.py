"""Plot of the Cramer-Rao bound of a touch's position over the sensor."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eitskin.benchmarks.studies.physics.signals import POSITIONS
from eitskin.extras import require
from eitskin.geometry.design.sensor import SensorDesign

Array = NDArray[np.float64]

_LEVELS = (0.25, 0.5, 1.0, 1.5, 2.0)


def draw_map(design: SensorDesign, lines: tuple[Array, Array], quarter: Array, path: Path) -> None:
    """Draw values [mm] of a quarter of a symmetric sensor over all of it.

    Args:
        design: whose electrodes are drawn too.
        lines: x and y of the quarter, rising to the middle of the sensor [m].
        quarter: (len(y), len(x)).
        path: of the PNG.
    """
    figure = require("matplotlib.figure", "bench").Figure(figsize=(9.0, 4.0), layout="constrained")
    axes, length, width = figure.subplots(), design.outline.length, design.outline.width
    x, y = (_mirrored(line, size) for line, size in zip(lines, (length, width), strict=True))
    whole = np.block([[quarter, quarter[:, -2::-1]], [quarter[-2::-1], quarter[-2::-1, -2::-1]]])
    filled = axes.pcolormesh(1e3 * x, 1e3 * y, whole, cmap="viridis", rasterized=True)
    drawn = axes.contour(1e3 * x, 1e3 * y, whole, _LEVELS, colors="white", linewidths=0.6)
    axes.plot(*(1e3 * np.array(POSITIONS).T), ".", color="black", markersize=3)
    corners = np.array([(0, 0), (length, 0), (length, width), (0, width), (0, 0)])
    axes.plot(*(1e3 * corners.T), color="#444444", linewidth=1.0)
    for number, electrode in enumerate(design.electrodes, 1):
        place = 1e3 * np.array([electrode.x, electrode.y])
        axes.plot(*place, "s", color="#b8860b", markersize=9, clip_on=False)
        axes.text(*place, f"{number}", ha="center", va="center", fontsize=7, color="white")
    axes.set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    axes.spines[:].set_visible(False)
    bar = figure.colorbar(filled, label="bound of the mean distance [mm]", shrink=0.8)
    bar.add_lines(drawn)
    figure.savefig(path, dpi=120, facecolor="white")


def _mirrored(line: Array, size: float) -> Array:
    return np.concatenate([line, size - line[-2::-1]])
