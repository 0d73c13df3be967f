"""The sections of a demo's report that say how good its pipelines are."""

from collections.abc import Mapping
from html import escape
from typing import Any

from eitskin.cli.demo.folder import HERE, SHIPPED
from eitskin.cli.demo.html import figure, figures, filled, paragraph, section, table
from eitskin.cli.demo.measured import report_of
from eitskin.cli.demo.parts import Kept, Part
from eitskin.cli.episode import COLUMNS, episode_cells
from eitskin.training.evaluation.report.table import table_rows
from eitskin.training.evaluation.scores import SSIM_DEFINITION

Parts = Mapping[str, Kept]
Document = Mapping[str, Any]

BOTH = {"test": "Trained here, in this demo", "shipped": "Comes with eitskin"}
BOTH_PLACES = {"indentation": BOTH["test"], "shipped_indentation": BOTH["shipped"]}


def states_and_angle(parts: Parts, document: Document) -> str:
    """How states are told apart, and the bend angle."""
    text = (
        "Idle, touched or bent? {test.frames} frames that no pipeline was trained with, of one "
        "specimen. The pipeline that comes along was trained on other specimens and knows this one "
        "only by its flat reference."
    )
    return section(
        "angle",
        "States and bend angle",
        paragraph(filled(text, document)),
        _beside(parts, BOTH, "confusion"),
        f"<h3>{BOTH['test']}</h3>",
        figures(parts["test"].part, "bend_angle"),
        f"<h3>{BOTH['shipped']}</h3>",
        figures(parts["shipped"].part, "bend_angle"),
    )


def touches(parts: Parts, document: Document) -> str:
    """Touch maps beside the truth."""
    text = (
        "Each row is one frame: the truth; the picture reconstructed against the flat sensor "
        "(static reference), in which the bend hides the touch; the one against the sensor as it "
        "was just before the touch (dynamic reference); and the touch map that a network makes of "
        "it. SSIM of the touch map, one touch: {test.touches.1.ssim.touch_map:.2f} (published "
        "0.94), several: {test.touches.several.ssim.touch_map:.2f} (published 0.80)."
    )
    return section(
        "touches",
        "Touch maps",
        paragraph(filled(text, document)),
        f"<h3>{BOTH['test']}</h3>",
        figures(parts["test"].part, "touch_maps_angles", "touch_maps_counts"),
        f"<h3>{BOTH['shipped']}</h3>",
        figures(parts["shipped"].part, "touch_maps_counts"),
    )


def places(parts: Parts, document: Document) -> str:
    """Where touches at known places are found."""
    text = (
        "The paper's first experiment: 10 N at 27 places, 8 times each, flat. Trained here: "
        "{indentation.touches.1.mean_error_mm:.2f} &plusmn; "
        "{indentation.touches.1.deviation_mm:.2f} mm, {indentation.touches.1.found:.1%} found; the "
        "pipeline that comes along: {shipped_indentation.touches.1.mean_error_mm:.2f} &plusmn; "
        "{shipped_indentation.touches.1.deviation_mm:.2f} mm, "
        "{shipped_indentation.touches.1.found:.1%} found; published: 4.8 &plusmn; 2.8 mm."
    )
    return section(
        "places",
        "Where touches are found",
        paragraph(filled(text, document)),
        *(
            f"<h3>{title}</h3>{figures(parts[stage].part, 'error_vectors', 'localisation_errors')}"
            for stage, title in BOTH_PLACES.items()
        ),
    )


def latency(parts: Parts, document: Document) -> str:
    """Time per frame and stage."""
    stages = list(document["latency"][HERE])
    rows = [
        (
            f"{which}: {name}" if name == "whole frame" else f" {name}",
            *(
                filled(f"{{latency.{which}.{name}.{key}}}", document)
                if key == "times"
                else filled(f"{{latency.{which}.{name}.{key}:.2f}}", document)
                for key in ("p50_ms", "p99_ms", "times")
            ),
        )
        for which, names in ((HERE, stages), (SHIPPED, list(document["latency"][SHIPPED])))
        for name in names
    ]
    return section(
        "latency",
        "Time per frame",
        figures(parts["latency"].part, "latency"),
        table(
            ("pipeline and stage", "p50, ms", "p99, ms", "times"),
            rows,
            "Median and 99th percentile of the time for a frame and, where the method has them, of "
            "its stages. The paper's frame takes 606.6 ms, 303 of them for its acquisition.",
            as_html=True,
        ),
    )


def live(parts: Parts, document: Document) -> str:
    """The episode on a virtual board."""
    text = (
        "The saved pipeline on a virtual board: every frame crosses a pseudo-terminal as packets, "
        "as from a real one. In {live.frames} frames the state was right {live.right_states} "
        "times; of {live.touches} touches at the ends of their steps {live.touches_found} were "
        "found, {live.mean_error_mm:.1f} mm off on average; the angle was off by "
        "{live.angle_rmse_deg:.2f}° (RMSE), touched frames included; a frame took "
        "{live.latency.p50_ms:.1f} ms (p99 {live.latency.p99_ms:.1f} ms)."
    )
    rows = [episode_cells(row) for row in document["live"]["steps"]]
    caption = (
        "The steps of the episode: the state that most of its frames were given and how many were "
        "right, the median angle, and places [mm] and errors of the touches in its last frame."
    )
    return section(
        "live",
        "Live, through the serial link",
        paragraph(filled(text, document)),
        figures(parts["live"].part, "episode"),
        table(COLUMNS, rows, caption),
    )


def real(parts: Parts) -> str:
    """What real recordings gave, or how to give some."""
    told = [paragraph(escape(sentence)) for sentence in parts["real"].part.told]
    return section(
        "real", "Real recordings", *told, figures(parts["real"].part, "presses", "board_frame")
    )


def paper(parts: Parts) -> str:
    """All figures of the paper beside those of both pipelines."""
    rows: list[tuple[str, ...]] = []
    columns = [
        _grid_rows(parts[grid].part) | _rows(parts[test].part)
        for grid, test in zip(BOTH_PLACES, BOTH, strict=True)
    ]
    for key in dict.fromkeys(key for column in columns for key in column):
        paper = next(column[key][0] for column in columns if key in column)
        rows.append((key[1], paper, *(column.get(key, ("", "-"))[1] for column in columns)))
    caption = (
        f"{parts['test'].part.numbers['frames']} test frames of one simulated specimen; published "
        "figures are of a real sensor. Places are of touches matched by the Hungarian method "
        f"within 15 mm. {SSIM_DEFINITION}"
    )
    headings = ("experiment", "published", "trained here", "comes with eitskin")
    return section("paper", "The paper's table", table(headings, rows, caption))


def _rows(part: Part) -> dict[tuple[str, str], tuple[str, str]]:
    """Published and measured figures by experiment and row."""
    rows, experiment = {}, ""
    for name, paper, here in table_rows(report_of(part)):
        experiment = experiment if name.startswith(" ") else name
        rows[experiment, name] = paper.replace("+-", "±"), here.replace("+-", "±")
    return rows


def _grid_rows(part: Part) -> dict[tuple[str, str], tuple[str, str]]:
    """Those of the single touches on a grid."""
    rows = [(key, row) for key, row in _rows(part).items() if key[0] == "one touch: error"]
    title = "one touch at 27 places, flat: error"
    return {(title, name if name.startswith(" ") else title): row for (_, name), row in rows}


def _beside(parts: Parts, stages: Mapping[str, str], name: str) -> str:
    """A picture of several stages in columns, each under its title."""
    columns = (
        f"<div><h3>{title}</h3>{figure(parts[stage].part.pictures[name])}</div>"
        for stage, title in stages.items()
        if name in parts[stage].part.pictures
    )
    return f'<div class="pair">{"".join(columns)}</div>'
