"""The demo's report: one HTML page and one JSON document with the numbers of all stages."""

import base64
import json
import os
import shlex
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from eitskin.cli.demo.measured import report_of
from eitskin.cli.demo.results import REMEDY, SVG, Picture, StoredResult
from eitskin.cli.demo.stages import STAGES
from eitskin.cli.demo.workspace import SETS, SHIPPED, TRAINED, Workspace
from eitskin.cli.episode import COLUMNS, episode_cells
from eitskin.errors import PartialError
from eitskin.files import atomic_file
from eitskin.provenance import Provenance
from eitskin.training.evaluation.report.table import table_rows
from eitskin.training.evaluation.scores import SSIM_DEFINITION, Report

if TYPE_CHECKING:
    from markupsafe import Markup

PAGE, DOCUMENT, TEMPLATE = "report.html", "report.json", "report.html.j2"
GRID = "one touch at 27 positions, flat: error"
_PLAIN = " !$()*+,-./:;=?@[]^_`{|}~"  # what an address within quotation marks may hold as it is

Results = Mapping[str, StoredResult]
Document = dict[str, Any]


def write_demo_report(results: Results, demo: Workspace) -> Document:
    """Write report.html and report.json into the demo's folder; returns the document.

    Raises PartialError where they cannot be written.
    """
    document = document_of(results, demo)
    texts = {
        DOCUMENT: json.dumps(document, indent=1, allow_nan=False) + "\n",
        PAGE: page(results, document),
    }
    for name, text in texts.items():
        with atomic_file(demo.out / name, PartialError, REMEDY) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return document


def document_of(results: Results, demo: Workspace) -> Document:
    """Numbers by stage, and their provenance."""
    made = asdict(Provenance.now(demo.plan.seed))
    given = [] if demo.data is None else ["--data", str(demo.data)]
    command = ["eitskin", "demo", "--out", str(demo.out), *given, "--seed", str(demo.plan.seed)]
    return {
        "provenance": {
            "command": shlex.join(command),
            "machine": made["machine"],
            "cores": os.cpu_count(),
            "python": made["python"],
            "versions": next(iter(results.values())).inputs["versions"],
            "seed": demo.plan.seed,
            "date": max(stored.date for stored in results.values()),
        },
        "seconds": {name: stored.seconds for name, stored in results.items()},
        **{name: stored.result.numbers for name, stored in results.items()},
    }


def page(results: Results, document: Document) -> str:
    """The report as one HTML page without references to anything outside."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("eitskin.cli.demo", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(TEMPLATE).render(
        document=document,
        results=results,
        number=lambda path, form="": marked_number(document, path, form),
        source=_data_url,
        inputs=_short_inputs,
        stages=STAGES,
        sets=SETS,
        pipelines=(TRAINED, SHIPPED),
        paper_rows=list(paper_rows(results)),
        episode_columns=COLUMNS,
        episode_rows=[episode_cells(row) for row in document["live"]["steps"]],
        ssim=SSIM_DEFINITION,
    )


def marked_number(document: Document, path: str, form: str) -> "Markup":
    """Formatted number of the document, marked with its path "stage.key.key" in report.json."""
    from markupsafe import Markup

    value: Any = document
    for key in path.split("."):
        value = value[int(key)] if isinstance(value, list) else value[key]
    shown = "none" if value is None else format(value, form)
    mark = Markup('<data value="{}" data-from="{}">{}</data>')
    return mark.format(str(value), path, shown)


def paper_rows(results: Results) -> list[tuple[str, str, str, str]]:
    """Rows of the paper's table: experiment, published, trained here, shipped."""
    columns = [
        _grid_figures(report_of(results[grid].result)) | _figures(report_of(results[test].result))
        for grid, test in (("indentation", "test"), ("shipped_indentation", "shipped"))
    ]
    rows = []
    for key in dict.fromkeys(key for column in columns for key in column):
        published = next(column[key][0] for column in columns if key in column)
        trained, shipped = (column.get(key, ("", "-"))[1] for column in columns)
        rows.append((key[1], published, trained, shipped))
    return rows


def _figures(report: Report) -> dict[tuple[str, str], tuple[str, str]]:
    """Published and measured figure by experiment and row."""
    rows, experiment = {}, ""
    for name, published, here in table_rows(report):
        experiment = experiment if name.startswith(" ") else name
        rows[experiment, name] = published.replace("+-", "±"), here.replace("+-", "±")
    return rows


def _grid_figures(report: Report) -> dict[tuple[str, str], tuple[str, str]]:
    """Figures of single touches on the paper's grid."""
    return {
        (GRID, name if name.startswith(" ") else GRID): row
        for (experiment, name), row in _figures(report).items()
        if experiment == "one touch: error"
    }


def _data_url(picture: Picture) -> str:
    """The picture itself as an address; SVG stays text, which is shorter than base64."""
    if picture.media == SVG:
        return f"data:{SVG},{quote(picture.data, safe=_PLAIN)}"
    return f"data:{picture.media};base64,{base64.b64encode(picture.data).decode()}"


def _short_inputs(inputs: Mapping[str, Any]) -> str:
    """Frames, weights and files by the first digits of their SHA-256."""
    found: list[str] = []
    for kind in ("frames", "weights", "files"):
        value = inputs.get(kind, {})
        named = value if isinstance(value, dict) else {"": value}
        found += [" ".join(filter(None, (kind, name, sum_[:8]))) for name, sum_ in named.items()]
    return ", ".join(found) or "the design"
