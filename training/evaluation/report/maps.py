"""Figures of touch maps beside the truth and both reconstructions."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.extras import require
from eitskin.training.evaluation.evaluate import Evaluation, contact_maps, reconstructions
from eitskin.training.evaluation.report.drawing import (
    DARK,
    EXTRA,
    CaptionedFigure,
    NoFigure,
    new_figure,
)
from eitskin.training.evaluation.scores import SSIM_DEFINITION

ANGLES_DEG = (-10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0)  # as in the paper, a single touch
SEVERAL_DEG = 30.0  # and one to four touches
NEAR_DEG = 5.0  # the frame that is nearest to a wanted angle is shown where it is this near
COLUMNS = {
    "truth": "truth",
    "static": "static reference",
    "dynamic": "dynamic reference",
    "touch_map": "touch map",
}

Maps = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class _Row:
    """One frame of a figure, and its label."""

    frame: int
    label: str


def touch_maps_by_angle(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Touch maps of one touch at the angles of the paper that have frames near them."""
    rows: list[_Row] = []
    for wanted in ANGLES_DEG:
        frame = _nearest(evaluation, 1, wanted)
        if frame is not None and all(row.frame != frame for row in rows):
            rows.append(_Row(frame, _degrees(evaluation, frame)))
    if not rows:
        return NoFigure(
            "no frame has exactly one touch of known position and radius at a known angle"
        )
    return _drawn(evaluation, rows, "One touch at several bend angles")


def touch_maps_by_count(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Touch maps of one to four touches on the sensor bent by 30 deg."""
    rows: list[_Row] = []
    for count in range(1, evaluation.dataset.touch_x.shape[1] + 1):
        frame = _nearest(evaluation, count, SEVERAL_DEG)
        if frame is not None:
            rows.append(_Row(frame, f"{count} at\n{_degrees(evaluation, frame)}"))
    if not rows:
        return NoFigure(
            f"no touched frame of known positions and radii is within {NEAR_DEG:g} deg of "
            f"{SEVERAL_DEG:g} deg"
        )
    return _drawn(evaluation, rows, f"One to four touches near {SEVERAL_DEG:g} deg")


def _degrees(evaluation: Evaluation, frame: int) -> str:
    angle = f"{evaluation.dataset.bend_angle_deg[frame]:.0f} deg"
    return angle.replace("-", "\N{MINUS SIGN}")


def _nearest(evaluation: Evaluation, count: int, angle_deg: float) -> int | None:
    """Frame with `count` touches nearest to an angle; None beyond `NEAR_DEG`."""
    data = evaluation.dataset
    drawable = np.isfinite(evaluation.similarity.get("touch_map", np.full(len(data), np.nan)))
    away = np.abs(data.bend_angle_deg.astype(float) - angle_deg)
    away[~drawable | (data.touch_count != count) | ~np.isfinite(away)] = np.inf
    nearest = int(np.argmin(away))
    return nearest if away[nearest] <= NEAR_DEG else None


def _drawn(evaluation: Evaluation, rows: list[_Row], title: str) -> CaptionedFigure:
    """Grid of images, a row for each frame and a column for each kind."""
    frames = evaluation.dataset.select([row.frame for row in rows])
    post_processed = evaluation.predictions.touch_map[[row.frame for row in rows]]
    shape = post_processed.shape
    pictures = {"truth": contact_maps(frames, evaluation.pipeline, shape)}
    pictures |= {**reconstructions(evaluation.pipeline, frames), "touch_map": post_processed}
    names = [name for name in COLUMNS if name in pictures]
    length, width = (1e3 * side for side in evaluation.pipeline.layout.outline)
    panel = 10.0 / len(names) if len(names) > 2 else 3.6
    figure = new_figure(2.0 + panel * len(names), 0.6 + (panel * width / length + 0.1) * len(rows))
    panels = figure.subplots(len(rows), len(names), squeeze=False, sharex=True, sharey=True)
    for i, row in enumerate(rows):
        for j, name in enumerate(names):
            axes = panels[i, j]
            image = _panel(axes, pictures[name][i], (length, width))
            _mark(axes, evaluation, row.frame, name)
            if i == 0:
                axes.set_title(COLUMNS[name])
        panels[i, 0].set_ylabel(row.label, rotation=0, ha="right", va="center", weight="bold")
    figure.supxlabel("x [mm]", fontsize=10)
    figure.supylabel("y [mm]", fontsize=10)
    tall = {"shrink": min(1.0, 2.6 / len(rows)), "aspect": 22, "pad": 0.01}
    bar = figure.colorbar(image, ax=panels, ticks=(-1, 0, 1), **tall)
    bar.set_ticklabels(["more\nconductive", "no change", "touched"])
    bar.outline.set_visible(False)
    scaled = (
        " Reconstructions, against the flat sensor and against the bent one, are scaled to their "
        "largest magnitude."
        if "static" in names
        else " The method makes no reconstructions."
    )
    return CaptionedFigure(
        figure,
        f"{title}: the frame nearest to each angle, without selection. Circles: the true touches; "
        f"crosses: those found.{scaled} {SSIM_DEFINITION}",
    )


def _panel(axes: Any, values: Maps, size: tuple[float, float]) -> Any:
    largest = float(np.abs(values).max()) or 1.0
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=2)
    return axes.imshow(
        values / largest,
        cmap="RdBu_r",
        vmin=-1.0,
        vmax=1.0,
        origin="lower",
        extent=(0.0, size[0], 0.0, size[1]),
        interpolation="nearest",
    )


def _mark(axes: Any, evaluation: Evaluation, frame: int, name: str) -> None:
    """Mark true and found touches, and write the SSIM."""
    data = evaluation.dataset
    circle = require("matplotlib.patches", EXTRA).Circle
    halo = require("matplotlib.patheffects", EXTRA).withStroke(linewidth=2.2, foreground="white")
    touches = np.stack([data.touch_x[frame], data.touch_y[frame], data.touch_radius[frame]], axis=1)
    for x, y, radius in 1e3 * touches[np.isfinite(touches[:, 0])]:
        axes.add_patch(circle((x, y), radius, fill=False, edgecolor=DARK, linewidth=0.7))
    if name == "touch_map":
        found = 1e3 * evaluation.predictions.touches[frame].place
        axes.plot(*found.T, "x", color=DARK, markersize=5, markeredgewidth=1.2, path_effects=[halo])
    if name in evaluation.similarity:
        text = f"SSIM {evaluation.similarity[name][frame]:.2f}"
        place = {"transform": axes.transAxes, "ha": "right", "va": "top", "path_effects": [halo]}
        axes.text(0.985, 0.96, text, fontsize=8, color=DARK, **place)
