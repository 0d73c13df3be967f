"""The lines of the table of `bench paper`: figure, unit, and what the paper and the aim are."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Line:
    """One line.

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


def _touches(name: str, text: str, paper: tuple[str, str], target: str) -> tuple[Line, ...]:
    several = target if target.endswith("2.5") else ""
    return (
        Line(f"{name}.error_mm", text, "mm", paper[0], target),
        Line(f"{name}.deviation_mm", "  standard deviation", "mm", paper[1]),
        Line(f"{name}.found", "  found", "%", "", ">= 98" if several else ""),
        Line(f"{name}.false", "  false, per touch", "%", "", "<= 2" if several else ""),
    )


def _pictures(group: str, text: str, paper: tuple[str, str, str], target: str) -> tuple[Line, ...]:
    return (
        Line(f"{group}.ssim.static", f"{text}: SSIM, static reference", "", paper[0]),
        Line(f"{group}.ssim.dynamic", "  dynamic reference", "", paper[1]),
        Line(f"{group}.ssim.touch_map", "  touch map", "", paper[2], target),
        Line(f"{group}.ssim.empty", "  empty picture", ""),
    )


def _step(angle_deg: int, count: int) -> tuple[Line, ...]:
    name = f"demo.{angle_deg}deg.{count}"
    return (
        Line(f"{name}.state", f"  {count} touches at {angle_deg} deg: state right", "%"),
        Line(f"{name}.found", "    found", "%"),
        Line(f"{name}.error_mm", "    error", "mm"),
    )


LINES: tuple[Line, ...] = (
    *_touches("indentation", "one touch at 27 places, flat: error", ("4.8", "2.8"), "<= 1.5"),
    *_touches("touch.1", "one touch at -10 to 50 deg: error", ("", ""), "<= 1.5"),
    *_touches("touch.2", "two touches at 0 to 30 deg: error", ("5.5", ""), "<= 2.5"),
    *_touches("touch.3", "three touches at 0 to 30 deg: error", ("4.3", ""), "<= 2.5"),
    *_touches("touch.4", "four touches at 0 to 30 deg: error", ("5.0", ""), "<= 2.5"),
    *_pictures("touch.1", "one touch", ("0.29", "0.71", "0.94"), ">= 0.97"),
    *_pictures("touch.several", "several touches", ("0.11", "0.47", "0.80"), ">= 0.90"),
    Line("state.idle", "idle recognised", "%", "> 97", ">= 99.5"),
    Line("state.touch", "touch recognised", "%", "99", ">= 99.5"),
    Line("state.bend", "bend recognised", "%", "", ">= 99.5"),
    Line("touch.state", "touch on a bent sensor recognised", "%", "", ">= 99.5"),
    Line("bend.r2", "bend angle: R2", "", "0.997"),
    Line("bend.angle_deg", "  RMSE", "deg", "0.90"),
    Line("touch.angle_deg", "  RMSE while touched", "deg"),
    Line("sequence.angle_deg", "  RMSE in a continuous sequence", "deg"),
    Line("calibrated.r2", "bend angle, calibrated: R2"),
    Line("calibrated.angle_deg", "  RMSE", "deg", "", "<= 0.3"),
    Line("calibrated.touched_deg", "  RMSE while touched", "deg", "", "<= 0.6"),
    Line("demo.state", "demonstration: state right", "%"),
    Line("demo.angle_deg", "  angle, RMSE", "deg"),
    *(line for step in ((-10, 2), (20, 3), (40, 4), (0, 4)) for line in _step(*step)),
    Line("time.p50_ms", "processing of a touched frame, median", "ms", "303.6"),
    Line("time.p99_ms", "  99th percentile", "ms", "", "<= 5"),
)
"""The paper's time is the mean of 606.6 ms less 303 ms of acquisition; its angle is of the sensor
that was trained with, its sequence has no figure."""
