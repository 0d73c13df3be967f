"""Lines of the table of `bench paper`: figure, unit, the paper's value and the target."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TableLine:
    """Line of the table.

    Attributes:
        figure: its name in `paper_scores`.
        text: what it is.
        unit: "mm", "deg", "ms", "%" of a share, or none.
        paper: as published; empty where the paper gives none.
        target: to be reached; empty where there is none.
    """

    figure: str
    text: str
    unit: str = ""
    paper: str = ""
    target: str = ""


def _touches(name: str, text: str, paper: tuple[str, str], target: str) -> tuple[TableLine, ...]:
    several = target if target.endswith("2.5") else ""
    return (
        TableLine(f"{name}.error_mm", text, "mm", paper[0], target),
        TableLine(f"{name}.deviation_mm", "  standard deviation", "mm", paper[1]),
        TableLine(f"{name}.found", "  found", "%", "", ">= 98" if several else ""),
        TableLine(f"{name}.false", "  false, per touch", "%", "", "<= 2" if several else ""),
    )


def _pictures(
    group: str, text: str, paper: tuple[str, str, str], target: str
) -> tuple[TableLine, ...]:
    return (
        TableLine(f"{group}.ssim.static", f"{text}: SSIM, static reference", "", paper[0]),
        TableLine(f"{group}.ssim.dynamic", "  dynamic reference", "", paper[1]),
        TableLine(f"{group}.ssim.touch_map", "  touch map", "", paper[2], target),
        TableLine(f"{group}.ssim.empty", "  empty picture", ""),
    )


def _step(angle_deg: int, count: int) -> tuple[TableLine, ...]:
    name = f"demo.{angle_deg}deg.{count}"
    return (
        TableLine(f"{name}.state", f"  {count} touches at {angle_deg} deg: state right", "%"),
        TableLine(f"{name}.found", "    found", "%"),
        TableLine(f"{name}.error_mm", "    error", "mm"),
    )


LINES: tuple[TableLine, ...] = (
    *_touches("indentation", "one touch at 27 places, flat: error", ("4.8", "2.8"), "<= 1.5"),
    *_touches("touch.1", "one touch at -10 to 50 deg: error", ("", ""), "<= 1.5"),
    *_touches("touch.2", "two touches at 0 to 30 deg: error", ("5.5", ""), "<= 2.5"),
    *_touches("touch.3", "three touches at 0 to 30 deg: error", ("4.3", ""), "<= 2.5"),
    *_touches("touch.4", "four touches at 0 to 30 deg: error", ("5.0", ""), "<= 2.5"),
    *_pictures("touch.1", "one touch", ("0.29", "0.71", "0.94"), ">= 0.97"),
    *_pictures("touch.several", "several touches", ("0.11", "0.47", "0.80"), ">= 0.90"),
    TableLine("state.idle", "idle recognised", "%", "> 97", ">= 99.5"),
    TableLine("state.touch", "touch recognised", "%", "99", ">= 99.5"),
    TableLine("state.bend", "bend recognised", "%", "", ">= 99.5"),
    TableLine("touch.state", "touch on a bent sensor recognised", "%", "", ">= 99.5"),
    TableLine("bend.r2", "bend angle: R2", "", "0.997"),
    TableLine("bend.angle_deg", "  RMSE", "deg", "0.90"),
    TableLine("touch.angle_deg", "  RMSE while touched", "deg"),
    TableLine("sequence.angle_deg", "  RMSE in a continuous sequence", "deg"),
    TableLine("calibrated.r2", "bend angle, calibrated: R2"),
    TableLine("calibrated.angle_deg", "  RMSE", "deg", "", "<= 0.3"),
    TableLine("calibrated.touched_deg", "  RMSE while touched", "deg", "", "<= 0.6"),
    TableLine("demo.state", "demonstration: state right", "%"),
    TableLine("demo.angle_deg", "  angle, RMSE", "deg"),
    *(line for step in ((-10, 2), (20, 3), (40, 4), (0, 4)) for line in _step(*step)),
    TableLine("time.p50_ms", "processing of a touched frame, median", "ms", "303.6"),
    TableLine("time.p99_ms", "  99th percentile", "ms", "", "<= 5"),
)
"""The paper's time is the mean of 606.6 ms less 303 ms of acquisition; its angle is of the sensor
that was trained with, its sequence has no figure."""
