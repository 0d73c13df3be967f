"""The paper's results and those of a report, side by side, as rows of text."""

from collections.abc import Iterator

from eitskin.training.evaluation.scores import Consistency, Report

Row = tuple[str, str, str]

NOTHING = "-"  # where a figure has no value
ERROR, ANGLE = "{:.2f} +- {:.2f} mm", "{:.2f} deg (bias {:+.2f})"
HEADINGS: Row = ("experiment", "paper", "here")
COUNTS = {"1": "one touch", "2": "two touches", "3": "three touches", "4": "four touches"}
GROUPS = {**COUNTS, "bent": "bent and touched"}
PAPER_ERROR_MM = {"1": "4.8 +- 2.8 mm", "2": "5.5 mm", "3": "4.3 mm", "4": "5.0 mm"}
PAPER_SSIM = {"1": ("0.29", "0.71", "0.94", "-"), "several": ("0.11", "0.47", "0.80", "-")}
PICTURES = {
    "static": "static",
    "dynamic": "dynamic",
    "touch_map": "post-processed",
    "empty": "empty picture",
}


def table_rows(report: Report) -> Iterator[Row]:
    """Rows of experiment, result of the paper and result of `report`, of what is estimated."""
    yield from _touch_rows(report)
    yield from _state_rows(report)
    if report.estimates.angle:
        yield from _bend_rows(report)
    if missing := report.estimates.missing:
        yield "not estimated", NOTHING, ", ".join(missing)
    latency = report.latency
    # The paper's 606.6 ms hold 303 ms of acquisition.
    times = f"{latency.p50_ms:.1f} ms (p99 {latency.p99_ms:.1f} ms)"
    yield "processing of a frame", "303.6 of 606.6 ms", times


def _touch_rows(report: Report) -> Iterator[Row]:
    for group, name in GROUPS.items():
        if score := report.touches.get(group):
            spread = (score.mean_error_mm, score.deviation_mm)
            yield f"{name}: error", PAPER_ERROR_MM.get(group, "-"), _text(ERROR, *spread)
            quantiles = (score.median_error_mm, score.p95_error_mm)
            yield "  median, 95 % within", "-", _text("{:.2f} mm, {:.2f} mm", *quantiles)
            yield "  found", "-", f"{score.found:.1%}, and {score.false_per_touch:.1%} false"
    for group, paper in PAPER_SSIM.items():
        if score := report.touches.get(group):
            name = COUNTS.get(group, group)
            for (key, picture), figure in zip(PICTURES.items(), paper, strict=True):
                if key in score.ssim:
                    yield f"{name}: SSIM {picture}", figure, f"{score.ssim[key]:.2f}"
    if untouched := report.untouched:
        shown = f"in {untouched.touched:.2%} of {untouched.frames} frames"
        yield "touches where there are none", "-", shown
    if found := report.place_calibration:
        yield "place error / standard error", "-", _consistency(found)
    if force := report.force:
        shown = f"{force.mean_error_n:.2f} N off (bias {force.bias_n:+.2f})"
        yield "force of a touch", "-", shown


def _state_rows(report: Report) -> Iterator[Row]:
    states, told_apart = report.states, report.estimates.states
    if "idle" in told_apart:
        yield "idle recognised", "> 97 %", _text("{:.1%}", states.accuracy["idle"])
        yield "  taken for a touch", NOTHING, _text("{:.1%}", states.idle_as_touch)
    if "touch" in told_apart:
        yield "touch recognised", "99 %", _text("{:.1%}", states.accuracy["touch"])
        if "bend" in told_apart or states.bent_touch_accuracy is not None:
            yield "  on a bent sensor", NOTHING, _text("{:.1%}", states.bent_touch_accuracy)
    if "bend" in told_apart:
        yield "bend recognised", NOTHING, _text("{:.1%}", states.accuracy["bend"])
    if states.left_out:
        yield "frames of another state", NOTHING, f"{states.left_out}, not judged"


def _bend_rows(report: Report) -> Iterator[Row]:
    bend = report.bend
    touched = (bend.touched_rmse_deg, bend.touched_bias_deg)
    yield "bend angle, R2", "0.997", _text("{:.4f}", bend.r2)
    yield "bend angle, RMSE", "0.90 deg", _text(ANGLE, bend.rmse_deg, bend.bias_deg)
    yield "  while touched", "-", _text(ANGLE, *touched)
    if bend.calibration:
        yield "angle error / standard error", "-", _consistency(bend.calibration)


def _consistency(found: Consistency) -> str:
    return f"rms {found.rms_ratio:.2f}, {found.within_one:.0%} within one"


def _text(form: str, *values: float | None) -> str:
    """Values in a format; a dash where there are none."""
    return NOTHING if None in values else form.format(*values)
