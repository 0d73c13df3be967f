"""Figures of images over the sensor: touch maps beside the truth, and pictures without training."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.extras import require
from eitskin.geometry.design.surface import Surface
from eitskin.training.evaluation.evaluate import Evaluation, contact_maps, drawable, reconstructions
from eitskin.training.evaluation.report.drawing import (
    DARK,
    EXTRA,
    CaptionedFigure,
    NoFigure,
    PicturePanel,
    draw_panels,
    new_figure,
)
from eitskin.training.evaluation.scores import SSIM_DEFINITION
from eitskin.training.reconstruction.reconstructor import Method, Reconstructor

ANGLES_DEG = (-10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0)  # as in the paper, a single touch
SEVERAL_DEG = 30.0  # and one to four touches
NEAR_DEG = 5.0  # the frame that is nearest to a wanted angle is shown where it is this near
COLUMNS = {
    "truth": "truth",
    "static": "static reference",
    "dynamic": "dynamic reference",
    "touch_map": "touch map",
}
METHODS: tuple[Method, ...] = ("back-projection", "noser", "greit")
PIXELS = 1000


def touch_maps_by_angle(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Touch maps of one touch at the angles of the paper that have frames near them."""
    frames = [_nearest(evaluation, 1, wanted) for wanted in ANGLES_DEG]
    rows = {frame: _degrees(evaluation, frame) for frame in frames if frame is not None}
    if not rows:
        return NoFigure(
            "no frame has exactly one touch of known position and radius at a known angle"
        )
    return _draw_rows(evaluation, rows, "One touch at several bend angles")


def touch_maps_by_count(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Touch maps of one to four touches on the sensor bent by 30 deg."""
    counts = range(1, evaluation.dataset.touch_x.shape[1] + 1)
    frames = {count: _nearest(evaluation, count, SEVERAL_DEG) for count in counts}
    rows = {
        frame: f"{count} at\n{_degrees(evaluation, frame)}"
        for count, frame in frames.items()
        if frame is not None
    }
    if not rows:
        return NoFigure(
            f"no touched frame of known positions and radii is within {NEAR_DEG:g} deg of "
            f"{SEVERAL_DEG:g} deg"
        )
    return _draw_rows(evaluation, rows, f"One to four touches near {SEVERAL_DEG:g} deg")


def _degrees(evaluation: Evaluation, frame: int) -> str:
    angle = f"{evaluation.dataset.bend_angle_deg[frame]:.0f} deg"
    return angle.replace("-", "\N{MINUS SIGN}")


def _nearest(evaluation: Evaluation, count: int, angle_deg: float) -> int | None:
    """Frame with `count` touches nearest to an angle; None beyond `NEAR_DEG`."""
    data = evaluation.dataset
    shown = np.isfinite(evaluation.similarity.get("touch_map", np.full(len(data), np.nan)))
    away = np.abs(data.bend_angle_deg.astype(float) - angle_deg)
    away[~shown | (data.touch_count != count) | ~np.isfinite(away)] = np.inf
    nearest = int(np.argmin(away))
    return nearest if away[nearest] <= NEAR_DEG else None


def _draw_rows(evaluation: Evaluation, rows: dict[int, str], title: str) -> CaptionedFigure:
    """Grid of images, a row for each labelled frame and a column for each kind."""
    frames = evaluation.dataset.select(list(rows))
    post_processed = evaluation.predictions.touch_map[list(rows)]
    images = {"truth": contact_maps(frames, evaluation.pipeline, post_processed.shape)}
    images |= {**reconstructions(evaluation.pipeline, frames), "touch_map": post_processed}
    names = [name for name in COLUMNS if name in images]
    length, width = (1e3 * side for side in evaluation.pipeline.layout.outline)
    panel = 10.0 / len(names) if len(names) > 2 else 3.6
    figure = new_figure(2.0 + panel * len(names), 0.6 + (panel * width / length + 0.1) * len(rows))
    panels = figure.subplots(len(rows), len(names), squeeze=False, sharex=True, sharey=True)
    look = {"cmap": "RdBu_r", "vmin": -1.0, "vmax": 1.0, "origin": "lower"}
    look |= {"extent": (0.0, length, 0.0, width), "interpolation": "nearest"}
    for i, (frame, label) in enumerate(rows.items()):
        for axes, name in zip(panels[i], names, strict=True):
            axes.grid(visible=False)
            axes.spines[:].set_visible(False)
            axes.tick_params(length=2)
            values = images[name][i]
            image = axes.imshow(values / (float(np.abs(values).max()) or 1.0), **look)
            _mark(axes, evaluation, frame, name)
            if i == 0:
                axes.set_title(COLUMNS[name])
        panels[i, 0].set_ylabel(label, rotation=0, ha="right", va="center", weight="bold")
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


def _mark(axes: Any, evaluation: Evaluation, frame: int, name: str) -> None:
    """Mark true and found touches, and write the SSIM."""
    data = evaluation.dataset
    circle = require("matplotlib.patches", EXTRA).Circle
    halo = require("matplotlib.patheffects", EXTRA).withStroke(linewidth=2.2, foreground="white")
    for x, y, radius in 1e3 * _discs(data, frame):
        axes.add_patch(circle((x, y), radius, fill=False, edgecolor=DARK, linewidth=0.7))
    if name == "touch_map":
        found = 1e3 * evaluation.predictions.touches[frame].place
        axes.plot(*found.T, "x", color=DARK, markersize=5, markeredgewidth=1.2, path_effects=[halo])
    if name in evaluation.similarity:
        text = f"SSIM {evaluation.similarity[name][frame]:.2f}"
        place = {"transform": axes.transAxes, "ha": "right", "va": "top", "path_effects": [halo]}
        axes.text(0.985, 0.96, text, fontsize=8, color=DARK, **place)


def pictures_by_count(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Pictures by several methods of the first frame with each number of touches."""
    layout = evaluation.pipeline.layout
    if isinstance(layout.design.outline, Surface):
        return NoFigure("pictures are those of sensors with an outline in the plane")
    touched = drawable(evaluation.dataset)
    _, first = np.unique(evaluation.dataset.touch_count[touched], return_index=True)
    if not len(first):
        return NoFigure("no touched frame has touches of known positions and radii")
    data = evaluation.dataset.select(touched[first])
    flat = data.reference[data.specimen]
    known = np.isfinite(data.touch_reference).all(axis=1, keepdims=True)
    before = np.where(known, data.touch_reference, flat)
    values = np.where(data.status == 0, data.impedance, np.nan)
    makers = [
        Reconstructor(layout.design, layout.protocol, method, pixels=PIXELS, resolution="coarse")
        for method in METHODS
    ]
    pictures = [maker.images(maker.data(values, before)) for maker in makers]
    panels = [
        PicturePanel(
            f"{maker.method}, {count} touch{'es' * (count > 1)}",
            layout.design,
            maker.grid,
            picture[row],
            tuple(map(tuple, _discs(data, row).tolist())),
        )
        for row, count in enumerate(data.touch_count.tolist())
        for maker, picture in zip(makers, pictures, strict=True)
    ]
    return CaptionedFigure(
        draw_panels(panels, columns=len(METHODS), common=False),
        "Pictures without training: change of conductivity from the untouched sensor at the same "
        "bend, one step of linear reconstruction from the sensor's design. The first frame with "
        "each number of touches, without selection. Dashed: the true touches.",
    )


def _discs(data: Dataset, frame: int) -> NDArray[np.float32]:
    """Positions and radius [m] of the true touches of a frame, (touches, 3)."""
    discs = np.stack([data.touch_x[frame], data.touch_y[frame], data.touch_radius[frame]], axis=1)
    placed: NDArray[np.float32] = discs[np.isfinite(discs[:, 0])]
    return placed
