"""Pictures that only the demo draws: frames, touches, the live episode and real recordings."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.schema import State
from eitskin.extras import require
from eitskin.training.evaluation.report.drawing import (
    BLUE,
    DARK,
    EXTRA,
    GREY,
    ORANGE,
    PALE,
    CaptionedFigure,
    draw_sensor,
    new_figure,
)

COLOURS = {State.IDLE: GREY, State.TOUCH: ORANGE, State.BEND: BLUE}
SHOWN_FRAMES = 6  # of each state
MOST_TOUCHES = 1500  # more would be one grey patch

Array = NDArray[np.float64]


def touch_positions(data: Dataset, name: str) -> CaptionedFigure:
    """Positions of all touches of a dataset, over the sensor."""
    figure = new_figure(7.0, 3.4)
    axes = figure.subplots()
    if data.design is not None:
        draw_sensor(axes, data.design)
    count = data.touch_count
    positions = 1e3 * np.stack([data.touch_x, data.touch_y], axis=2)
    for touches, colour, label in ((count == 1, ORANGE, "one"), (count > 1, BLUE, "several")):
        x, y = positions[touches][np.isfinite(positions[touches][:, :, 0])].T[:, :MOST_TOUCHES]
        look = {"s": 7, "color": colour, "alpha": 0.55, "linewidths": 0, "rasterized": True}
        axes.scatter(x, y, label=f"{label} at once", **look)
    axes.set(xlabel="x [mm]", ylabel="y [mm]")
    figure.legend(loc="outside upper center", ncols=2, markerscale=2.5)
    return CaptionedFigure(
        figure,
        f"Positions of the touches in {name}: {int(count.sum())} in {int(np.sum(count > 0))} "
        f"frames, at most {MOST_TOUCHES} of either kind shown. Grey: the sensor's outline and "
        "electrodes.",
    )


def raw_frames(data: Dataset, name: str) -> CaptionedFigure:
    """Some measured frames of each state: change of every resistance from the flat sensor's."""
    figure = new_figure(9.0, 5.2)
    panels = figure.subplots(3, 1, sharex=True)
    change = (np.abs(data.impedance) - np.abs(data.reference[data.specimen])).astype(float)
    for axes, (state, colour) in zip(panels, COLOURS.items(), strict=True):
        flat_or_bend = (data.state == State.BEND) | ~(np.abs(data.bend_angle_deg) > 0)
        rows = np.flatnonzero((data.state == state) & flat_or_bend)[:SHOWN_FRAMES]
        look = {"color": colour, "alpha": 0.8, "linewidth": 1.1, "marker": "o", "markersize": 2.5}
        axes.plot(change[rows].T, **look)
        axes.axhline(0.0, color=DARK, linewidth=0.8, zorder=0)
        axes.set_ylabel(f"{state.name.lower()} [ohm]")
    _name_channels(panels[-1], data.protocol.labels if data.protocol else ())
    flat = np.abs(data.reference[0])
    return CaptionedFigure(
        figure,
        f"The first {SHOWN_FRAMES} frames of each state in {name}, touches on the flat sensor, "
        "noise included: change of every resistance from that of the flat, untouched sensor, which "
        f"is {flat.min():.0f} to {flat.max():.0f} ohm. The three scales differ.",
    )


def tracked_angle(rows: Sequence[Mapping[str, Any]]) -> CaptionedFigure:
    """True and estimated angle in every frame of the live episode, coloured by estimated state."""
    figure = new_figure(9.0, 4.4)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1])
    sizes = [len(row["states"]) for row in rows]
    true = np.repeat([row["true_angle_deg"] for row in rows], sizes)
    touched = np.repeat([row["true_state"] == "touch" for row in rows], sizes)
    angles = np.concatenate([row["angles_deg"] for row in rows])
    states = np.concatenate([row["states"] for row in rows])
    frames = np.arange(len(true))
    for axes in (above, below):
        span = {"transform": axes.get_xaxis_transform(), "step": "mid", "color": PALE, "zorder": 0}
        axes.fill_between(frames, 0, 1, where=touched, linewidth=0, label="touched", **span)
    above.step(frames, true, where="mid", color=DARK, linewidth=1.2, label="true")
    for state, colour in COLOURS.items():
        mine = states == state.name.lower()
        label = f"estimated, taken for {state.name.lower()}"
        above.scatter(frames[mine], angles[mine], s=14, color=colour, label=label, zorder=3)
        below.scatter(frames[mine], (angles - true)[mine], s=10, color=colour, zorder=3)
    below.axhline(0.0, color=DARK, linewidth=0.9)
    above.set_ylabel("bend angle [deg]")
    below.set(xlabel="frame", ylabel="error [deg]")
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    rmse = float(np.sqrt(np.mean((angles - true) ** 2)))
    return CaptionedFigure(
        figure,
        f"Bend angle in {len(true)} frames of a virtual board, each through the serial link and "
        f"the pipeline: RMSE {rmse:.2f} deg. Every step of the episode lasts {sizes[0]} frames.",
    )


def found_presses(true: Array, found: Array, name: str) -> CaptionedFigure:
    """True positions of real presses (n, 2) [m], joined to the estimated ones (n, 2) [m]."""
    segments = require("matplotlib.collections", EXTRA).LineCollection
    figure = new_figure(5.6, 5.2)
    axes = figure.subplots()
    lines = 1e3 * np.stack([true, found], axis=1)
    axes.add_collection(segments(lines, color=BLUE, alpha=0.8, linewidths=1.0, zorder=3))
    axes.scatter(*(1e3 * true).T, s=45, marker="+", color=DARK, linewidths=1.0, label="true")
    axes.scatter(*(1e3 * found).T, s=14, color=BLUE, linewidths=0, zorder=4, label="estimated")
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    figure.legend(loc="outside upper center", ncols=2)
    error = 1e3 * np.linalg.norm(found - true, axis=1)
    return CaptionedFigure(
        figure,
        f"{name}: the last {len(true)} presses of a robot on a real, round hydrogel skin, left out "
        f"of the training; to scale. Mean error {error.mean():.1f} mm, largest {error.max():.1f} "
        "mm.",
    )


def two_sensors(own: Array, measured: Array, labels: Sequence[str], name: str) -> CaptionedFigure:
    """Magnitudes (measurements,) [ohm] of the training sensor and of a recorded frame."""
    figure = new_figure(9.0, 3.4)
    axes = figure.subplots()
    axes.plot(measured, "s", color=ORANGE, markersize=5, label=name)
    axes.plot(own, "o", color=BLUE, markersize=5, label="sensor of the training frames")
    axes.set(yscale="log", ylabel="magnitude [ohm, or its own unit]")
    _name_channels(axes, labels)
    figure.legend(loc="outside upper center", ncols=2)
    return CaptionedFigure(
        figure,
        "Every value of a frame of another, real board beside those of the flat sensor that the "
        f"pipeline was trained for: {float(np.median(measured / own)):.3g} times as large in the "
        "median.",
    )


def _name_channels(axes: Any, labels: Sequence[str]) -> None:
    axes.set_xticks(range(len(labels)), labels, rotation=90, fontsize=8)
    axes.set_xlabel("pair of electrodes")
