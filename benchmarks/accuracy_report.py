"""What `bench accuracy` leaves behind: tables as CSV, and the plot of error against time."""

import csv
import dataclasses
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eitskin.benchmarks.accuracy import Accuracy, Result
from eitskin.geometry.optional import require
from eitskin.geometry.whole_file import whole_file


@dataclass(frozen=True, slots=True)
class Target:
    """What a named resolution is to reach on one core; errors as in `Judgement`."""

    name: str
    resistance_error: float | None
    signal_error: float
    seconds: float


TARGETS = (
    Target("fast", None, 2e-2, 0.010),
    Target("standard", 1e-3, 1e-2, 0.050),
    Target("fine", 1e-5, 1e-4, 5.0),
)
TARGET_RATIO = 20.0

_COLOURS = {
    "hexahedra": "#1f5fa8",
    "prisms": "#2e8b57",
    "tetrahedra": "#b8860b",
    "squares": "#6a9bd1",
    "pyEIT": "#c0392b",
}
_MARKERS = {"linear": "o", "quadratic": "s", "cubic": "^", "quartic": "D", "named": "*"}


def write(found: Accuracy, folder: Path) -> list[Path]:
    """Write accuracy.csv, deformed.csv and accuracy.png into `folder`, each whole."""
    paths = [folder / name for name in ("accuracy.csv", "deformed.csv", "accuracy.png")]
    rows = [dataclasses.asdict(point) for point in found.points]
    flat = [_flattened(dataclasses.asdict(row)) for row in found.deformed]
    for path, table in zip(paths, (rows, flat), strict=False):
        with whole_file(path) as temporary:
            temporary.write_text(_csv(table, str(found.provenance)), encoding="utf-8")
    with whole_file(paths[-1]) as temporary:
        plot(found, temporary)
    return paths


def plot(found: Accuracy, path: Path) -> None:
    """Both errors over the time per frame; one line per family, targets as corners."""
    matplotlib = require("matplotlib", "bench")
    figure_class = require("matplotlib.figure", "bench").Figure
    with matplotlib.rc_context(
        {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}
    ):
        figure = figure_class(figsize=(13.0, 6.6), layout="constrained")
        panels = figure.subplots(1, 2, sharex=True)
        for axes, quantity in zip(panels, ("resistance_error", "signal_error"), strict=True):
            _panel(axes, found, quantity)
        panels[0].set_title("flat resistances: largest relative error")
        panels[1].set_title("signal of a 30 % drop: relative error of the change")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right upper", frameon=False)
        figure.suptitle("Forward model of the reference sensor: error against time per frame")
        figure.text(0.01, -0.045, str(found.provenance), fontsize=7.5, color="#555555")
        figure.savefig(path, dpi=130, bbox_inches="tight", facecolor="white")


def _panel(axes: Any, found: Accuracy, quantity: str) -> None:
    families: dict[str, list[Result]] = {}
    for point in found.points:
        families.setdefault(point.family, []).append(point)
    for family, points in families.items():
        ordered = sorted(points, key=lambda point: point.unknowns)
        milliseconds = [1e3 * point.frame_seconds for point in ordered]
        errors = [getattr(point, quantity) for point in ordered]
        axes.loglog(milliseconds, errors, label=family, **_style(family))
        for point in ordered if "named" in family else ():
            _label(axes, point.name, 1e3 * point.frame_seconds, getattr(point, quantity), family)
    for target in TARGETS:
        _corner(axes, target, getattr(target, quantity))
    own = getattr(found, quantity)
    axes.axhline(own, color="#999999", linewidth=0.8, linestyle=(0, (1, 2)))
    axes.annotate(
        "error of the reference",
        (1.0, own),
        xycoords=("axes fraction", "data"),
        ha="right",
        va="bottom",
        fontsize=8,
        color="#777777",
    )
    axes.set_xlabel("time per frame of 28, one core [ms]")
    axes.grid(visible=True, which="major", color="#e4e4e4", linewidth=0.7)
    axes.set_axisbelow(True)


def _label(axes: Any, text: str, x: float, y: float, family: str) -> None:
    axes.annotate(
        text,
        (x, y),
        xytext=(7, 4),
        textcoords="offset points",
        fontsize=9,
        color=_COLOURS[family.partition(", ")[0]],
        zorder=6,
    )


def _style(family: str) -> dict[str, Any]:
    """Colour by cells, marker by order, dashes for a solver that was asked for."""
    cells, *parts = family.split(", ")
    marker = next((_MARKERS[part] for part in parts if part in _MARKERS), "x")
    named = "named" in parts
    uniform = "uniform" in parts
    return {
        "color": _COLOURS[cells],
        "marker": marker,
        "markersize": 13 if named else 5.5,
        "markeredgecolor": "white" if named else _COLOURS[cells],
        "markerfacecolor": "white" if uniform else _COLOURS[cells],
        "linestyle": "none" if named else "--" if "sparse LU" in parts else ":" if uniform else "-",
        "linewidth": 1.3,
        "zorder": 5 if named else 3,
    }


def _corner(axes: Any, target: Target, error: float | None) -> None:
    """Mark the corner that a resolution must stay within, below and to the left."""
    if error is None:
        return
    time = 1e3 * target.seconds
    axes.plot([time / 3.0, time, time], [error, error, error / 6.0], color="#444444", linewidth=1.1)
    axes.annotate(
        f"target {target.name}",
        (time, error),
        xytext=(-3, 3),
        textcoords="offset points",
        ha="right",
        fontsize=8,
        color="#444444",
    )


def _csv(rows: Sequence[dict[str, Any]], comment: str) -> str:
    """A table with a header, after a line that begins with # and says how it was measured."""
    text = io.StringIO()
    text.write(f"# {comment}\n")
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _flattened(row: dict[str, Any]) -> dict[str, Any]:
    """The same with the entries of tables within it as columns of their own."""
    flat: dict[str, Any] = {}
    for key, value in row.items():
        flat |= value if isinstance(value, dict) else {key: value}
    return flat


def misses(found: Accuracy) -> Iterable[str]:
    """A sentence for every target that was not reached."""
    named = {point.name: point for point in found.results if point.family == "hexahedra, named"}
    for target in TARGETS:
        point = named.get(target.name)
        if point is None:
            continue
        limits = (
            ("error of R", point.resistance_error, target.resistance_error),
            ("signal error", point.signal_error, target.signal_error),
            ("seconds per frame", point.frame_seconds, target.seconds),
        )
        for quantity, value, limit in limits:
            if limit is not None and value > limit:
                yield f"{target.name}: {quantity} {value:.2g}, target {limit:g}"
    for duel in found.duels:
        if abs(duel.other.nodes / 1e4 - 1.0) < 0.2 and duel.ratio < TARGET_RATIO:
            yield (
                f"{duel.other.family}, {duel.other.nodes} nodes: {duel.ratio:.1f} times faster, "
                f"target {TARGET_RATIO:g}"
            )
