"""Readings of the live loop as a panel in the terminal."""

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

from eitskin.hardware.streams.reading_record import bad_channels, state_name, zero_name

if TYPE_CHECKING:
    from eitskin.hardware.boards.board import Counts
    from eitskin.hardware.live import Estimate, Reading

NOT_ESTIMATED = "not estimated"
SHOWN = 0.3  # least value of the touch map that is drawn


def draw(reading: "Reading", counts: "Counts", silence: str = "") -> RenderableType:
    """Panel of a reading: numbers, touch map, health; `silence`: why no newer reading comes."""
    frame, estimate = reading.frame, reading.estimate
    numbers = Table.grid(padding=(0, 2))
    if silence:
        numbers.add_row("board", Text(silence, style="bold red"))
    if estimate is None:
        numbers.add_row("state", Text(f"unknown: {reading.problem}", style="bold red"))
    else:
        _add_estimate(numbers, estimate, stale=bool(silence))
    rate = f"{reading.rate:.1f} frames/s" if math.isfinite(reading.rate) else "-"
    numbers.add_row("rate", f"{rate}, latency {reading.latency * 1e3:.1f} ms")
    numbers.add_row("losses", losses(counts, reading.unusable))
    bad = bad_channels(frame)
    health = ", ".join(f"{label} {what}" for label, what in bad.items())
    good = f"all {len(frame.status)} good"
    numbers.add_row("channels", Text(health, style="red") if bad else good)
    if estimate is None:
        return numbers
    if estimate.problems:
        numbers.add_row("problems", Text("; ".join(estimate.problems), style="red"))
    if estimate.touch_map is None:
        return numbers
    # Rules and no frame: the 80 columns of the map are all that a plain terminal has.
    return Group(
        numbers, Rule("touch map, y up, x right"), touch_picture(estimate.touch_map), Rule()
    )


def _add_estimate(numbers: Table, estimate: "Estimate", stale: bool) -> None:
    """Add state, angle and touches, dimmed where the reading is old."""
    style = "dim" if stale else ""
    state, angle, touches = state_name(estimate), estimate.bend_angle_deg, estimate.touches
    numbers.add_row("state", Text(state or NOT_ESTIMATED, style=style or "bold"))
    shown = NOT_ESTIMATED
    if angle is not None:
        shown = f"{angle:+.1f} deg" if math.isfinite(angle) else "unknown"
    numbers.add_row("bend", Text(shown, style=style))
    places = [f"({x * 1e3:.0f}, {y * 1e3:.0f}) mm {s:.2f}" for x, y, s in touches or ()]
    none = NOT_ESTIMATED if touches is None else "none"
    zero = zero_name(estimate)
    numbers.add_row("zero", zero if zero == "first frames" else f"stored reference, {zero}")
    numbers.add_row("touches", Text(", ".join(places) or none, style=style))


def touch_picture(touch_map: NDArray[np.floating]) -> Text:
    """Touch map (rows, columns), 0 to 1, in half-blocks: two rows of pixels in a line of text."""
    values = np.asarray(touch_map)[::-1]  # text runs downwards, y upwards
    if len(values) % 2:
        values = np.vstack([values, np.zeros_like(values[:1])])
    picture = Text(no_wrap=True, overflow="crop")
    for row, (upper, lower) in enumerate(zip(values[::2], values[1::2], strict=True)):
        if row:
            picture.append("\n")
        for high, low in zip(upper, lower, strict=True):
            block = " ▄▀█"[2 * int(high > SHOWN) + int(low > SHOWN)]
            strong = max(high, low) > 2 * SHOWN
            picture.append(block, style="" if block == " " else "red" if strong else "yellow")
    return picture


def losses(counts: "Counts", unusable: int) -> str:
    """Lost, skipped, unusable and dropped frames as a sentence."""
    dropped = ", ".join(f"{count} {reason}" for reason, count in counts.dropped.items())
    return (
        f"{counts.lost} lost, {counts.skipped} skipped, {unusable} unusable, "
        f"{counts.reconnections} reconnections, dropped: {dropped or 'none'}"
    )
