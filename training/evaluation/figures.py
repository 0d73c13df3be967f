"""Figures of a report: learning curves, states, bend angles, positions of touches, and images."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets import Dataset, State
from eitskin.extras import require
from eitskin.geometry import SensorDesign, Surface
from eitskin.training.evaluation.drawing import (
    BLUE,
    DARK,
    EXTRA,
    GREEN,
    GREY,
    ORANGE,
    CaptionedFigure,
    Circle,
    NoFigure,
    PicturePanel,
    draw_panels,
    draw_sensor,
    new_figure,
)
from eitskin.training.evaluation.evaluate import Evaluation, drawable, images
from eitskin.training.evaluation.scores import GATE, SSIM_DEFINITION, root_mean_square
from eitskin.training.method.interface import LearningCurve
from eitskin.training.method.targets import STATE_NAMES
from eitskin.training.pipeline.pipeline import Pipeline
from eitskin.training.reconstruction.reconstructor import Method, Reconstructor

MIN_SEQUENCE = 20  # frames
MIN_ANGLE_CHANGE = 1.0  # deg, in a sequence that is worth drawing
MAX_VECTORS = 240  # more would hide each other
ANGLES_DEG = (-10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0)  # as in the paper, a single touch
COUNTED, SEVERAL_DEG = (1, 2, 3, 4), (30.0,)  # and one to four touches
NOWHERE = np.zeros((0, 2))
# the frame that is nearest to a wanted angle is shown where it is this near
MAX_ANGLE_DIFFERENCE = 5.0
COLUMNS = {
    "truth": "truth",
    "static": "static reference",
    "dynamic": "dynamic reference",
    "touch_map": "touch map",
}
METHODS: tuple[Method, ...] = ("back-projection", "noser", "greit")
PIXELS = 1000

Array = NDArray[np.float64]


def learning_curves(pipeline: Pipeline) -> Mapping[str, LearningCurve]:
    """Learning curves of the networks by name, without empty ones."""
    curves = pipeline.method.learning_curves
    return {name: history for name, history in curves.items() if history.training}


def loss_curves(pipeline: Pipeline) -> CaptionedFigure | NoFigure:
    """Learning curves of every network of a pipeline."""
    networks = learning_curves(pipeline)
    if not networks:
        return NoFigure(
            "this pipeline has no networks, or was trained without keeping their losses"
        )
    ticker = require("matplotlib.ticker", EXTRA)
    figure = new_figure(4.8 * len(networks), 3.6)
    panels = figure.subplots(1, len(networks), squeeze=False)[0]
    for axes, (name, history) in zip(panels, networks.items(), strict=True):
        for part, losses, colour in (
            ("training", history.training, BLUE),
            ("validation", history.validation, ORANGE),
        ):
            if losses:
                look = {"color": colour, "marker": "o", "markersize": 3}
                axes.plot(range(1, len(losses) + 1), losses, label=f"{part} part", **look)
        axes.set(title=name, xlabel="epoch", ylabel="mean loss per frame", yscale="log")
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.yaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(ticker.NullFormatter())
        axes.legend()
    caption = (
        "Loss after every epoch: cross-entropy of the state, mean binary cross-entropy per pixel "
        "of the touch map; of the joint method the weighted squared error of the response and the "
        "cross-entropy per cell of the proposals, whose frames are new in every step. The "
        "training part is seen with the noise that training adds and as the "
        "weights were during the epoch; the validation part, a fifth of the frames that no weight "
        "is fitted to, without it and at the end of the epoch."
    )
    if not all(history.validation for history in networks.values()):
        caption += " A network without a curve of the validation part was trained without one."
    return CaptionedFigure(figure, caption)


def confusion_matrix(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Confusion matrix of the state, normalised by row, with counts."""
    counts = np.array(evaluation.report.states.confusion)
    totals = counts.sum(axis=1, keepdims=True)
    if not totals.any():
        return NoFigure("the state of no frame is known")
    shares = counts / np.maximum(totals, 1)
    figure = new_figure(4.2, 3.9)
    axes = figure.subplots()
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0)
    for row, column in np.ndindex(counts.shape):
        share = shares[row, column]
        text = f"{100 * share:.1f} %\n{counts[row, column]}" if totals[row] else "no frames"
        colour = "white" if share > 0.5 else DARK
        axes.text(column, row, text, ha="center", va="center", color=colour)
    axes.set(xticks=range(3), yticks=range(3), xticklabels=STATE_NAMES, yticklabels=STATE_NAMES)
    axes.set(xlabel="estimated state", ylabel="true state")
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    return CaptionedFigure(
        figure,
        f"Confusion matrix of the state over {int(totals.sum())} frames: shares of each row and, "
        "below, counts. A bent sensor that is touched counts as touch.",
    )


def bend_angles(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Scatter plot of estimated over true angle, and histogram of the errors."""
    data = evaluation.dataset
    true = data.bend_angle_deg.astype(float)
    estimated = evaluation.predictions.bend_angle_deg
    finite = np.isfinite(true) & np.isfinite(estimated)
    groups = {
        "bent, untouched": (finite & (data.state == State.BEND), BLUE),
        "touched, flat or bent": (finite & (data.state == State.TOUCH), ORANGE),
    }
    groups = {name: group for name, group in groups.items() if group[0].any()}
    every = np.concatenate([true[mask] for mask, _ in groups.values()] or [np.zeros(1)])
    if np.ptp(every) < MIN_ANGLE_CHANGE:
        return NoFigure("no bent or touched frames of several known angles")
    errors = [(estimated - true)[mask] for mask, _ in groups.values()]
    limit = 1.1 * (max(float(np.percentile(np.abs(error), 99)) for error in errors) or 1.0)
    bins = np.linspace(-limit, limit, 42)
    figure = new_figure(10.0, 4.6)
    scatter, histogram = figure.subplots(1, 2)
    ends = [every.min(), every.max()]
    scatter.plot(ends, ends, color=DARK, linewidth=0.9, zorder=1, label="true")
    for (name, (mask, colour)), error in zip(groups.items(), errors, strict=True):
        label = f"{name}: RMSE {root_mean_square(error):.2f} deg, bias {error.mean():+.2f} deg"
        dots = {"s": 9, "alpha": 0.5, "linewidths": 0, "zorder": 2}
        scatter.scatter(true[mask], estimated[mask], color=colour, label=label, **dots)
        weights = np.full(len(error), 100.0 / len(error))
        for look in ({"alpha": 0.35, "histtype": "stepfilled"}, {"lw": 1.2, "histtype": "step"}):
            inside = np.clip(error, -limit, limit)
            histogram.hist(inside, bins, color=colour, weights=weights, **look)
    scatter.set(xlabel="true bend angle [deg]", ylabel="estimated bend angle [deg]")
    legend = figure.legend(loc="outside upper center", ncols=3, handletextpad=0.4)
    for handle in legend.legend_handles[1:]:
        handle.set(alpha=1.0, sizes=[22])
    histogram.axvline(0.0, color=DARK, linewidth=0.9)
    histogram.set(xlabel="error of the bend angle [deg]", ylabel="share of the frames [%]")
    return CaptionedFigure(
        figure,
        "Bend angle of every frame on its own, and the distribution of its errors with their root "
        "mean square and bias; errors beyond the axis are counted in the outermost bins.",
    )


def bend_sequence(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Angle and its error over time in the longest episode in which the sensor moves."""
    frames = _longest_sequence(evaluation)
    if frames is None:
        return NoFigure(
            f"no episode of at least {MIN_SEQUENCE} frames moves by more than "
            f"{MIN_ANGLE_CHANGE:g} deg; a dataset from a recipe with episodes, as paper_bending, "
            f"has one"
        )
    data, predictions = evaluation.dataset, evaluation.predictions
    time, true = data.time[frames], data.bend_angle_deg[frames].astype(float)
    estimated, touched = predictions.bend_angle_deg[frames], data.state[frames] == State.TOUCH
    deviation = predictions.bend_deviation_deg[frames]
    figure = new_figure(10.0, 5.2)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    above.plot(time, true, color=DARK, linewidth=1.0, label="true", zorder=1)
    for axes, values in ((above, estimated), (below, estimated - true)):
        for name, mask, colour in (("untouched", ~touched, BLUE), ("touched", touched, ORANGE)):
            if mask.any():
                label = f"estimated, {name}"
                axes.scatter(time[mask], values[mask], s=9, color=colour, label=label, zorder=2)
    below.axhline(0.0, color=DARK, linewidth=0.9, zorder=1)
    band = ""
    if np.isfinite(deviation).all():
        edge, band = 2.0 * deviation, " Grey: twice its stated standard error."
        below.fill_between(time, -edge, edge, color=GREY, alpha=0.25, linewidth=0, zorder=0)
    above.set_ylabel("bend angle [deg]")
    below.set(xlabel="time [s]", ylabel="error [deg]")
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return CaptionedFigure(
        figure,
        f"Bend angle in one episode of {len(frames)} frames, each estimated on its own, and its "
        f"error: RMSE {root_mean_square(estimated - true):.2f} deg.{band}",
    )


def _longest_sequence(evaluation: Evaluation) -> NDArray[np.int64] | None:
    """Frames of the longest moving episode in order of time; None if all are too short."""
    data, estimated = evaluation.dataset, evaluation.predictions.bend_angle_deg
    usable = np.flatnonzero(np.isfinite(data.bend_angle_deg) & np.isfinite(estimated))
    episodes, sizes = np.unique(data.episode[usable], return_counts=True)
    longest_first = np.argsort(-sizes, kind="stable")
    for episode in episodes[longest_first][: np.sum(sizes >= MIN_SEQUENCE)]:
        frames: NDArray[np.int64] = usable[data.episode[usable] == episode]
        frames = frames[np.argsort(data.time[frames], kind="stable")]
        moves = np.ptp(data.bend_angle_deg[frames]) > MIN_ANGLE_CHANGE
        if moves and np.all(np.diff(data.time[frames]) > 0):
            return frames
    return None


def error_vectors(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Error vectors of all single touches, from true to found position."""
    if not evaluation.pipeline.targets.touches:
        return NoFigure("the pipeline does not estimate positions of touches")
    data, matches = evaluation.dataset, evaluation.matches
    single = np.flatnonzero(data.touch_count == 1)[:MAX_VECTORS]
    if not single.size:
        return NoFigure("no frame has exactly one touch of known position")
    mine = np.isin(matches.frame, single)
    lost = single[~np.isin(single, matches.frame[mine])]
    missed: Array = np.nanmax([data.touch_x[lost], data.touch_y[lost]], axis=2).T.astype(float)
    design = evaluation.pipeline.layout.design
    return draw_error_vectors(design, matches.true[mine], matches.found[mine], missed)


def draw_error_vectors(
    design: SensorDesign | None, true: Array, estimated: Array, missed: Array = NOWHERE
) -> CaptionedFigure:
    """Error vectors over a sensor, whose design may be unknown.

    Args:
        design: design of the sensor.
        true, estimated: positions of touches that were found (k, 2) [m].
        missed: true positions of others (m, 2) [m].
    """
    figure = new_figure(9.6, 4.7)
    axes, places = figure.subplots(), np.concatenate([true, missed])
    caption = (
        f"{len(places)} single touches at {len(np.unique(np.round(1e3 * places, 1), axis=0))} "
        "positions, to scale: a line leads from the true to the found position; "
        f"{len(missed)} were missed."
    )
    if design is not None:
        draw_sensor(axes, design)
        caption += " Grey: the sensor's outline and its electrodes."
    plus = {"s": 60, "marker": "+", "color": DARK, "linewidths": 1.0, "zorder": 5}
    axes.scatter(*(1e3 * places.T), label="true position", **plus)
    segments = require("matplotlib.collections", EXTRA).LineCollection
    lines = 1e3 * np.stack([true, estimated], axis=1)
    axes.add_collection(segments(lines, color=BLUE, alpha=0.7, linewidths=0.9, zorder=3))
    dots = {"s": 12, "color": BLUE, "linewidths": 0, "zorder": 4}
    axes.scatter(*(1e3 * estimated.T), label="found there", **dots)
    if len(missed):
        ring = {"s": 150, "facecolors": "none", "edgecolors": ORANGE, "linewidths": 1.4}
        axes.scatter(*(1e3 * missed.T), label="missed at least once", zorder=2, **ring)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    return CaptionedFigure(figure, caption)


def localisation_errors(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Histogram of the localisation errors of all matched touches."""
    error = evaluation.matches.error
    if not len(error):
        return NoFigure("no touch was matched to a true one")
    return draw_errors(
        error,
        f"Localisation errors of {len(error)} detected touches, in frames with one to four. "
        f"Detected is a touch within {1e3 * GATE:g} mm; the largest errors are counted in the "
        "last bin.",
    )


def draw_errors(errors: Array, caption: str) -> CaptionedFigure:
    """Histogram of localisation errors (n,) [m]."""
    error = 1e3 * errors
    upper = max(float(np.percentile(error, 99.5)) * 1.05, 1e-3)
    figure = new_figure(7.2, 4.2)
    axes: Any = figure.subplots()
    weights = np.full(len(error), 100.0 / len(error))
    axes.hist(np.minimum(error, upper), np.linspace(0, upper, 40), weights=weights, color=BLUE)
    median, mean, most = float(np.median(error)), error.mean(), np.percentile(error, 95)
    for label, value, colour, line in (
        (f"median {median:.2f} mm", median, GREEN, "--"),
        (f"mean {mean:.2f} mm", mean, DARK, "-"),
        (f"95 % within {most:.2f} mm", most, ORANGE, ":"),
    ):
        axes.axvline(value, color=colour, linestyle=line, linewidth=1.6, label=label)
    axes.set(xlabel="distance between true and found position [mm]", ylabel="share of touches [%]")
    axes.set_xlim(0, upper)
    axes.legend()
    return CaptionedFigure(figure, caption)


def _nearest(evaluation: Evaluation, count: int, angle_deg: float) -> int | None:
    """Frame with `count` touches nearest to an angle; None beyond `MAX_ANGLE_DIFFERENCE`."""
    data = evaluation.dataset
    shown = np.isfinite(evaluation.similarity.get("touch_map", np.full(len(data), np.nan)))
    away = np.abs(data.bend_angle_deg.astype(float) - angle_deg)
    away[~shown | (data.touch_count != count) | ~np.isfinite(away)] = np.inf
    nearest = int(np.argmin(away))
    return nearest if away[nearest] <= MAX_ANGLE_DIFFERENCE else None


def touch_map_images(
    evaluation: Evaluation, counts: Sequence[int], angles_deg: Sequence[float]
) -> CaptionedFigure | NoFigure:
    """Grid of images, a column for each kind, a row for each frame nearest to a target.

    Targets are numbers of touches at each angle [deg].
    """
    near = dict.fromkeys(_nearest(evaluation, *each) for each in product(counts, angles_deg))
    rows = [row for row in near if row is not None]
    touches = "one touch" if len(counts) == 1 else f"one to {len(counts)} touches"
    if not rows:
        return NoFigure(
            f"no frame with {touches} of known position and radius is within "
            f"{MAX_ANGLE_DIFFERENCE:g} deg of {' or '.join(f'{each:g}' for each in angles_deg)} deg"
        )
    frames, design = evaluation.dataset.select(rows), evaluation.pipeline.layout.design
    maps = evaluation.predictions.touch_map[rows]
    pictures = images(evaluation.pipeline, frames, maps)
    panels = []
    for i, (row, angle) in enumerate(zip(rows, frames.bend_angle_deg, strict=True)):
        for name, values in pictures.items():
            words = f"{frames.touch_count[i]} at {angle:.0f} deg: {COLUMNS[name]}"
            if name in evaluation.similarity:
                words += f", SSIM {evaluation.similarity[name][row]:.2f}"
            crosses = evaluation.predictions.touches[row].place if name == "touch_map" else NOWHERE
            scaled = values[i] / (float(np.abs(values[i]).max()) or 1.0)
            panels.append(PicturePanel(words, design, None, scaled, _discs(frames, i), crosses))
    return CaptionedFigure(
        draw_panels(panels, len(pictures), shares=True),
        f"{touches.capitalize()}: the frame nearest to each angle, without selection, each image "
        "scaled to its largest magnitude; reconstructions are against the flat sensor and against "
        f"the bent one. Dashed: the true touches; crosses: the detected ones. {SSIM_DEFINITION}",
    )


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
    values = np.where(data.status == 0, data.impedance, np.nan)
    makers = [
        Reconstructor(layout.design, layout.protocol, method, pixels=PIXELS, resolution="coarse")
        for method in METHODS
    ]
    pictures = [maker.images(maker.data(values, data.values_before_touch)) for maker in makers]
    panels = [
        PicturePanel(
            f"{maker.method}, {count} touch{'es' * (count > 1)}",
            layout.design,
            maker.grid,
            picture[row],
            _discs(data, row),
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


def _discs(data: Dataset, frame: int) -> tuple[Circle, ...]:
    """Positions and radii of the true touches of a frame."""
    discs = np.stack([data.touch_x[frame], data.touch_y[frame], data.touch_radius[frame]], axis=1)
    return tuple(map(tuple, discs[np.isfinite(discs[:, 0])].tolist()))
