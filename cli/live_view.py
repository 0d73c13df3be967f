"""Readings of the live loop as plain data and as a panel in the terminal."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.rule import Rule
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from eitskin.frame import Frame
    from eitskin.hardware.boards.board import Counts
    from eitskin.hardware.live import Estimate, Reading

NOT_ESTIMATED = "not estimated"
SHOWN = 0.3  # least value of the touch map that is drawn


def plain(reading: "Reading", counts: "Counts") -> dict[str, Any]:
    """Reading as plain data; null stands for unknown values."""
    frame, estimate = reading.frame, reading.estimate
    return {
        "number": frame.number,
        "session": frame.session,
        "time": frame.time,
        **(_nothing(reading) if estimate is None else _perceived(estimate)),
        "bad_channels": bad_channels(frame),
        "latency_ms": reading.latency * 1e3,
        "rate_hz": known(reading.rate),
        "lost": counts.lost,
        "skipped": counts.skipped,
        "unusable": reading.unusable,
        "reconnections": counts.reconnections,
        "dropped": dict(counts.dropped),
    }


def _perceived(estimate: "Estimate") -> dict[str, Any]:
    return {
        "state": state_name(estimate),
        "probabilities": [known(p) for p in np.asarray(estimate.probabilities).tolist()],
        "bend_angle_deg": known(estimate.bend_angle_deg),
        "touches": None
        if estimate.touches is None
        else [[known(value) for value in touch] for touch in estimate.touches],
        "zero": zero_name(estimate),
        "problems": list(estimate.problems),
    }


def zero_name(estimate: "Estimate") -> str:
    """State of the sensor that an estimate is relative to, in words."""
    return str(getattr(estimate, "zero", "first frames"))


def _nothing(reading: "Reading") -> dict[str, Any]:
    """Plain data of a frame without an estimate."""
    return {
        "state": None,
        "probabilities": None,
        "bend_angle_deg": None,
        "touches": None,
        "zero": None,
        "problems": [reading.problem],
    }


def bad_channels(frame: "Frame") -> dict[str, str]:
    """Status of each bad measurement, by its label."""
    return {
        label: _status_text(int(bits))
        for label, bits in zip(frame.protocol.labels, frame.status, strict=True)
        if bits
    }


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


def state_name(estimate: "Estimate") -> str | None:
    """Name of the state in lower case; None where the pipeline does not estimate it."""
    state = estimate.state
    if state is None:
        return None
    return (state if isinstance(state, str) else state.name).lower()


def _status_text(bits: int) -> str:
    from eitskin.frame import Status

    names = [flag.name.lower().replace("_", " ") for flag in Status if flag.name and flag & bits]
    return ", ".join(names) or f"status {bits:#04x}"


def known(value: float | None) -> float | None:
    """`value`, None where it is unknown or not finite, which JSON cannot say."""
    return float(value) if value is not None and math.isfinite(value) else None
