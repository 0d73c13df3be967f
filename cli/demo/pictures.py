"""Pictures of what a demo makes: its frames, its episode and its times."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.state import State
from eitskin.extras import require
from eitskin.training.evaluation.report.drawing import (
    BLUE,
    DARK,
    EXTRA,
    GREEN,
    GREY,
    ORANGE,
    PALE,
    CaptionedFigure,
    draw_sensor,
    new_figure,
)

if TYPE_CHECKING:
    from eitskin.cli.demo.latency import Times

COLOURS = {State.IDLE: GREY, State.TOUCH: ORANGE, State.BEND: BLUE}
RAW = 6  # frames of each state
MOST_PLACES = 1500  # more would be one grey patch

Array = NDArray[np.float64]


def changed_resistances(
    titles: Sequence[str], changes: Sequence[Array], labels: Sequence[str]
) -> CaptionedFigure:
    """What scenes do to every resistance: changes (measurements,) [%] of each."""
    figure = new_figure(9.0, 3.8)
    axes = figure.subplots()
    at = np.arange(len(labels))
    looks = zip(titles, changes, (ORANGE, BLUE, GREEN), strict=True)
    for number, (title, change, colour) in enumerate(looks):
        axes.bar(at + 0.28 * (number - 1), change, 0.28, color=colour, label=title)
    axes.axhline(0.0, color=DARK, linewidth=0.8)
    axes.set_xticks(at, labels, rotation=90, fontsize=8)
    axes.set(xlabel="pair of electrodes", ylabel="change of resistance [%]")
    axes.grid(visible=False, axis="x")
    figure.legend(loc="outside upper center", ncols=3)
    return CaptionedFigure(
        figure,
        "Change of the resistance of every pair of electrodes from that of the flat, untouched "
        "sensor in the three scenes, without noise.",
    )


def states_and_angles(sets: Mapping[str, Dataset]) -> CaptionedFigure:
    """How many frames of each state every set has, and at which bend angles."""
    figure = new_figure(9.0, 3.6)
    counts, angles = figure.subplots(1, 2, width_ratios=[1, 1.25])
    _counts(counts, sets)
    every = np.concatenate([data.bend_angle_deg for data in sets.values()])
    bins = np.arange(5 * np.floor(every.min() / 5) - 2.5, every.max() + 7.5, 5)
    rows = [data.bend_angle_deg[_moved(data)] for data in sets.values()]
    looks = zip(sets, rows, (BLUE, ORANGE, GREEN), strict=False)
    for name, values, colour in looks:
        if len(values):
            weights = np.full(len(values), 100.0 / len(values))
            look = {"histtype": "step", "linewidth": 1.6, "color": colour, "label": name}
            angles.hist(values, bins, weights=weights, **look)
    angles.set(xlabel="bend angle [deg]", ylabel="share of the bent frames [%]")
    if angles.get_legend_handles_labels()[0]:
        angles.legend(loc="upper right")
    bent = ", ".join(f"{name} {len(row)}" for name, row in zip(sets, rows, strict=True))
    return CaptionedFigure(
        figure,
        "Left: frames of each state; a sensor that is touched counts as touch whether it is flat "
        f"or bent. Right: bend angles of the frames that are bent, touched or not ({bent}), in "
        "bins of 5 deg.",
    )


def _counts(axes: Any, sets: Mapping[str, Dataset]) -> None:
    """A bar per set, stacked by state."""
    names = list(sets)[::-1]
    left = np.zeros(len(names))
    for state, colour in COLOURS.items():
        widths = np.array([np.sum(sets[name].state == state) for name in names], float)
        bars = axes.barh(names, widths, left=left, color=colour, label=state.name.lower())
        light = state is not State.IDLE
        large = widths > 0.1 * max(len(data) for data in sets.values())
        labels = [f"{w:.0f}" if big else "" for w, big in zip(widths, large, strict=True)]
        axes.bar_label(bars, labels, label_type="center", color="white" if light else DARK)
        left += widths
    axes.bar_label(bars, [f"{len(sets[name])}" for name in names], padding=4, color=DARK)
    axes.set(xlabel="frames", xlim=(0, 1.17 * left.max()))
    axes.grid(visible=False, axis="y")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)


def _moved(data: Dataset) -> NDArray[np.bool_]:
    bent: NDArray[np.bool_] = np.abs(data.bend_angle_deg) > 0
    return bent


def touched_places(sets: Mapping[str, Dataset]) -> CaptionedFigure:
    """Where each set is touched, over the sensor."""
    shown = {name: data for name, data in sets.items() if data.touch_count.any()}
    figure = new_figure(9.0, 2.0 * ((len(shown) + 1) // 2) + 0.5)
    panels = figure.subplots((len(shown) + 1) // 2, 2, squeeze=False).ravel()
    told = []
    for axes, (name, data) in zip(panels, shown.items(), strict=False):
        if data.design is not None:
            draw_sensor(axes, data.design)
        count = data.touch_count
        places = 1e3 * np.stack([data.touch_x, data.touch_y], axis=2)
        for touches, colour, label in ((count == 1, ORANGE, "one"), (count > 1, BLUE, "several")):
            x, y = places[touches][np.isfinite(places[touches][:, :, 0])].T[:, :MOST_PLACES]
            if x.size:
                look = {"s": 7, "color": colour, "alpha": 0.55, "linewidths": 0}
                axes.scatter(x, y, label=f"{label} at once", **look)
        axes.set(title=name, xlabel="x [mm]", ylabel="y [mm]")
        told.append(f"{name} {int(count.sum())} in {int(np.sum(count > 0))} frames")
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    handles = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if handles:
        place = panels[-1] if len(shown) % 2 else figure
        where = "center" if len(shown) % 2 else "outside upper center"
        place.legend(handles.values(), handles.keys(), loc=where, markerscale=2.5)
    return CaptionedFigure(
        figure,
        f"Places of the touches: {', '.join(told)}. Grey: the sensor's outline and electrodes. "
        "Places that are touched several times lie on each other.",
    )


def raw_frames(data: Dataset, name: str) -> CaptionedFigure:
    """Some frames as they are measured: change of every resistance from the flat sensor's."""
    figure = new_figure(9.0, 5.2)
    panels = figure.subplots(3, 1, sharex=True)
    change = (np.abs(data.impedance) - np.abs(data.reference[data.specimen])).astype(float)
    for axes, (state, colour) in zip(panels, COLOURS.items(), strict=True):
        still = (data.state == State.BEND) | ~_moved(data)
        chosen = np.flatnonzero((data.state == state) & still)[:RAW]
        look = {"color": colour, "alpha": 0.8, "linewidth": 1.1, "marker": "o", "markersize": 2.5}
        axes.plot(change[chosen].T, **look)
        axes.axhline(0.0, color=DARK, linewidth=0.8, zorder=0)
        axes.set_ylabel(f"{state.name.lower()} [ohm]")
    labels = data.protocol.labels if data.protocol else ()
    panels[-1].set_xticks(range(change.shape[1]), labels, rotation=90, fontsize=8)
    panels[-1].set_xlabel("pair of electrodes")
    flat = np.abs(data.reference[0])
    return CaptionedFigure(
        figure,
        f"The first {RAW} frames of each state in {name}, touches on the flat sensor, noise "
        "included: change of every resistance from that of the flat, untouched sensor, which is "
        f"{flat.min():.0f} to {flat.max():.0f} ohm. Mind the three scales.",
    )


def tracked_angle(rows: Sequence[Mapping[str, Any]]) -> CaptionedFigure:
    """True and estimated angle of every frame of the live episode, and the states it was given."""
    figure = new_figure(9.0, 4.4)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1])
    sizes = [len(row["states"]) for row in rows]
    ends = np.cumsum([0, *sizes])
    true = np.repeat([row["true_angle_deg"] for row in rows], sizes)
    said = np.concatenate([row["angles_deg"] for row in rows])
    states = np.concatenate([row["states"] for row in rows])
    frames = np.arange(len(true))
    for row, start, end in zip(rows, ends[:-1], ends[1:], strict=True):
        if row["true_state"] == "touch":
            label = "touched" if row is _first_touched(rows) else None
            for axes in (above, below):
                axes.axvspan(start - 0.5, end - 0.5, color=PALE, zorder=0, label=label)
    above.step(frames, true, where="mid", color=DARK, linewidth=1.2, label="true")
    for state, colour in COLOURS.items():
        mine = states == state.name.lower()
        label = f"estimated, taken for {state.name.lower()}"
        above.scatter(frames[mine], said[mine], s=14, color=colour, label=label, zorder=3)
        below.scatter(frames[mine], (said - true)[mine], s=10, color=colour, zorder=3)
    below.axhline(0.0, color=DARK, linewidth=0.9)
    above.set_ylabel("bend angle [deg]")
    below.set(xlabel="frame", ylabel="error [deg]")
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    rmse = float(np.sqrt(np.mean((said - true) ** 2)))
    return CaptionedFigure(
        figure,
        f"Bend angle in {len(true)} frames of a virtual board, each through the serial link and "
        f"the pipeline: RMSE {rmse:.2f} deg. Every step of the episode lasts {sizes[0]} frames.",
    )


def _first_touched(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    return next((row for row in rows if row["true_state"] == "touch"), None)


def latencies(times: "Mapping[str, Times]") -> CaptionedFigure:
    """Histogram of the whole time per frame, and the stages of the pipeline trained here."""
    figure = new_figure(9.0, 3.8)
    whole, stages = figure.subplots(1, 2, width_ratios=[1.2, 1])
    every = np.concatenate([each.whole for each in times.values()])
    bins = np.geomspace(every.min() * 0.9, np.percentile(every, 99.5) * 1.1, 45)
    for (name, each), colour in zip(times.items(), (BLUE, ORANGE), strict=False):
        p50, p99 = np.percentile(each.whole, [50, 99])
        inside = np.clip(each.whole, bins[0], bins[-1])
        look = {"histtype": "stepfilled", "alpha": 0.35, "color": colour}
        whole.hist(inside, bins, label=f"{name}: p50 {p50:.1f} ms, p99 {p99:.1f} ms", **look)
        for value, line in ((p50, "-"), (p99, ":")):
            whole.axvline(value, color=colour, linestyle=line, linewidth=1.6)
    whole.set(xscale="log", xlabel="time per frame [ms]", ylabel="frames")
    ticks = [t for t in (0.5, 1, 2, 5, 10, 20, 50, 100, 200) if bins[0] <= t <= bins[-1]]
    whole.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    whole.set_xticks([], minor=True)
    whole.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0))
    _stages(stages, next(iter(times.values())).stages)
    return CaptionedFigure(
        figure,
        f"Left: time of Pipeline.process for each of {len(every) // len(times)} frames in a row on "
        "one thread; full line p50, dotted p99; frames beyond the axis are counted in its "
        "outermost bins. Right: stages of the pipeline trained here, p50 as bar and p99 as dot; a "
        "frame without touch needs no touch map.",
    )


def _stages(axes: Any, stages: Mapping[str, Array]) -> None:
    names = list(stages)[::-1]
    middle, upper = np.array([np.percentile(stages[name], [50, 99]) for name in names]).T
    axes.barh(names, middle, height=0.6, color=BLUE, alpha=0.6)
    axes.hlines(names, middle, upper, color=BLUE, linewidth=1.2)
    axes.plot(upper, names, "o", color=BLUE, markersize=4)
    axes.set(xlabel="time where it is needed [ms]", xlim=(0.0, None))
    axes.grid(visible=False, axis="y")


def found_presses(true: Array, found: Array, name: str) -> CaptionedFigure:
    """Places of real presses (n, 2) [m] and those found (n, 2) [m]."""
    segments = require("matplotlib.collections", EXTRA).LineCollection
    figure = new_figure(5.6, 5.2)
    axes = figure.subplots()
    lines = 1e3 * np.stack([true, found], axis=1)
    axes.add_collection(segments(lines, color=BLUE, alpha=0.8, linewidths=1.0, zorder=3))
    axes.scatter(*(1e3 * true).T, s=45, marker="+", color=DARK, linewidths=1.0, label="true place")
    axes.scatter(*(1e3 * found).T, s=14, color=BLUE, linewidths=0, zorder=4, label="found there")
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    figure.legend(loc="outside upper center", ncols=2)
    error = 1e3 * np.linalg.norm(found - true, axis=1)
    return CaptionedFigure(
        figure,
        f"{name}: the last {len(true)} presses of a robot on a real, round hydrogel skin, which "
        f"nothing was learned from; to scale. Mean error {error.mean():.1f} mm, largest "
        f"{error.max():.1f} mm.",
    )


def two_sensors(own: Array, measured: Array, labels: Sequence[str], name: str) -> CaptionedFigure:
    """Magnitudes (measurements,) [ohm] of the sensor trained with and of a recorded frame."""
    figure = new_figure(9.0, 3.4)
    axes = figure.subplots()
    at = np.arange(len(labels))
    axes.plot(at, measured, "s", color=ORANGE, markersize=5, label=name)
    axes.plot(at, own, "o", color=BLUE, markersize=5, label="sensor trained with")
    axes.set(yscale="log", xlabel="pair of electrodes", ylabel="magnitude [ohm, or its own unit]")
    axes.set_xticks(at, labels, rotation=90, fontsize=8)
    figure.legend(loc="outside upper center", ncols=2)
    ratio = float(np.median(measured / own))
    return CaptionedFigure(
        figure,
        f"Every value of a frame of another, real board beside those of the flat sensor that the "
        f"pipeline was trained for: {ratio:.3g} times as large in the median.",
    )
