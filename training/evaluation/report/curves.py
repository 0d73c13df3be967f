"""Figures of the learning curves and of the confusion matrix."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from eitskin.extras import require
from eitskin.training.evaluation.evaluate import Evaluation
from eitskin.training.evaluation.metrics import STATES
from eitskin.training.evaluation.report.drawing import (
    BLUE,
    DARK,
    EXTRA,
    ORANGE,
    CaptionedFigure,
    NoFigure,
    new_figure,
)
from eitskin.training.method.learning_curve import LearningCurve
from eitskin.training.pipeline.pipeline import Pipeline


def learning_curves(pipeline: Pipeline) -> Mapping[str, LearningCurve]:
    """Learning curves of the networks by name, without empty ones."""
    kept = pipeline.method.learning_curves
    return {name: history for name, history in kept.items() if history.training}


def training_curves(evaluation: Evaluation) -> CaptionedFigure | NoFigure:
    """Learning curves of the evaluated pipeline."""
    return loss_curves(evaluation.pipeline)


def loss_curves(pipeline: Pipeline) -> CaptionedFigure | NoFigure:
    """Learning curves of every network of a pipeline."""
    networks = learning_curves(pipeline)
    if not networks:
        return NoFigure(
            "this pipeline has no networks, or was trained without keeping their losses"
        )
    figure = new_figure(4.8 * len(networks), 3.6)
    panels = figure.subplots(1, len(networks), squeeze=False)[0]
    for axes, (name, history) in zip(panels, networks.items(), strict=True):
        _curve(axes, history.training, "training part", BLUE)
        _curve(axes, history.validation, "validation part", ORANGE)
        axes.set(title=name, xlabel="epoch", ylabel="mean loss per frame", yscale="log")
        axes.xaxis.get_major_locator().set_params(integer=True)
        _plain_numbers(axes.yaxis)
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


def _plain_numbers(axis: Any) -> None:
    """Label a logarithmic axis with 0.1, 0.2, 0.5 and so on."""
    ticker = require("matplotlib.ticker", EXTRA)
    axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(ticker.NullFormatter())


def _curve(axes: Any, losses: tuple[float, ...], label: str, colour: str) -> None:
    if losses:
        epochs = range(1, len(losses) + 1)
        axes.plot(epochs, losses, color=colour, label=label, marker="o", markersize=3)


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
    axes.set(xticks=range(3), yticks=range(3), xticklabels=STATES, yticklabels=STATES)
    axes.set(xlabel="estimated state", ylabel="true state")
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    return CaptionedFigure(
        figure,
        f"Confusion matrix of the state over {int(totals.sum())} frames: shares of each row and, "
        "below, counts. A bent sensor that is touched counts as touch.",
    )
