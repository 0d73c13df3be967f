"""Figures of the bend angle: estimated over true angle, and over time."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.state import State
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.metrics import root_mean_square
from eitskin.training.evaluation.report.drawing import (
    BLUE,
    DARK,
    GREY,
    ORANGE,
    CaptionedFigure,
    NoFigure,
    new_figure,
)

SHORTEST_SEQUENCE = 20  # frames
LEAST_MOVED = 1.0  # deg, in a sequence that is worth drawing

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def bend_angles(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Scatter plot of estimated over true angle, and histogram of the errors."""
    data = evaluation.dataset
    true = data.bend_angle_deg.astype(float)
    estimated = evaluation.predictions.bend_angle_deg
    known = _known(true) & _known(estimated)
    groups = {
        "bent, untouched": (known & (data.state == State.BEND), BLUE),
        "touched, flat or bent": (known & (data.state == State.TOUCH), ORANGE),
    }
    groups = {name: group for name, group in groups.items() if group[0].any()}
    every = np.concatenate([true[mask] for mask, _ in groups.values()] or [np.zeros(1)])
    if np.ptp(every) < LEAST_MOVED:
        return NoFigure("no bent or touched frames of several known angles")
    errors = {name: (estimated - true)[mask] for name, (mask, _) in groups.items()}
    figure = new_figure(10.0, 4.6)
    scatter, histogram = figure.subplots(1, 2)
    ends = [every.min(), every.max()]
    scatter.plot(ends, ends, color=DARK, linewidth=0.9, zorder=1, label="true")
    for name, (mask, colour) in groups.items():
        rmse, bias = root_mean_square(errors[name]), errors[name].mean()
        label = f"{name}: RMSE {rmse:.2f} deg, bias {bias:+.2f} deg"
        dots = {"s": 9, "alpha": 0.5, "linewidths": 0, "zorder": 2}
        scatter.scatter(true[mask], estimated[mask], color=colour, label=label, **dots)
    scatter.set(xlabel="true bend angle [deg]", ylabel="estimated bend angle [deg]")
    legend = figure.legend(loc="outside upper center", ncols=3, handletextpad=0.4)
    for handle in legend.legend_handles[1:]:
        handle.set(alpha=1.0, sizes=[22])
    _histogram(histogram, errors, {name: colour for name, (_, colour) in groups.items()})
    return CaptionedFigure(
        figure,
        "Bend angle of every frame by itself, and the distribution of its errors with their root "
        "mean square and bias; errors beyond the axis are counted in the outermost bins.",
    )


def _histogram(axes: Any, errors: dict[str, Array], colours: dict[str, str]) -> None:
    """Histograms of the errors of every group on one axis."""
    widest = max(float(np.percentile(np.abs(error), 99)) for error in errors.values())
    limit = 1.1 * (widest or 1.0)
    bins = np.linspace(-limit, limit, 42)
    for name, error in errors.items():
        inside = np.clip(error, -limit, limit)
        weights = np.full(len(error), 100.0 / len(error))
        look = {"color": colours[name], "weights": weights, "histtype": "stepfilled"}
        axes.hist(inside, bins, alpha=0.35, **look)
        axes.hist(inside, bins, **(look | {"histtype": "step", "linewidth": 1.2}))
    axes.axvline(0.0, color=DARK, linewidth=0.9)
    axes.set(xlabel="error of the bend angle [deg]", ylabel="share of the frames [%]")


def bend_sequence(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Angle and its error over time in the longest episode in which the sensor moves."""
    frames = _longest_sequence(evaluation)
    if frames is None:
        return NoFigure(
            f"no episode of at least {SHORTEST_SEQUENCE} frames moves by more than "
            f"{LEAST_MOVED:g} deg; a dataset from a recipe with episodes, as paper_bending, has one"
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
    if np.isfinite(deviation).all():
        edge = 2.0 * deviation
        below.fill_between(time, -edge, edge, color=GREY, alpha=0.25, linewidth=0, zorder=0)
    above.set_ylabel("bend angle [deg]")
    below.set(xlabel="time [s]", ylabel="error [deg]")
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    band = " Grey: twice its stated standard error." if np.isfinite(deviation).all() else ""
    return CaptionedFigure(
        figure,
        f"Bend angle in one episode of {len(frames)} frames, each estimated by itself, and its "
        f"error: RMSE {root_mean_square(estimated - true):.2f} deg.{band}",
    )


def _longest_sequence(evaluation: Evaluation) -> NDArray[np.int64] | None:
    """Frames of the longest moving episode in order of time; None if all are too short."""
    data = evaluation.dataset
    estimated = evaluation.predictions.bend_angle_deg
    usable = np.flatnonzero(_known(data.bend_angle_deg) & _known(estimated))
    episodes, sizes = np.unique(data.episode[usable], return_counts=True)
    longest_first = np.argsort(-sizes, kind="stable")
    for episode in episodes[longest_first][: np.sum(sizes >= SHORTEST_SEQUENCE)]:
        frames: NDArray[np.int64] = usable[data.episode[usable] == episode]
        frames = frames[np.argsort(data.time[frames], kind="stable")]
        moves = np.ptp(data.bend_angle_deg[frames]) > LEAST_MOVED
        if moves and np.all(np.diff(data.time[frames]) > 0):
            return frames
    return None


def _known(angle: NDArray[np.floating]) -> Mask:
    known: Mask = np.isfinite(angle)
    return known
