"""`eitskin demo`: everything once, from the bare sensor to a pipeline on a live board."""

import json
import os
import shlex
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from eitskin import training
from eitskin.cli.options import TRAINING, Output, ended_by_signals, with_output
from eitskin.errors import PartialError
from eitskin.extras import require_all

if TYPE_CHECKING:
    from markupsafe import Markup

    from eitskin.cli.demo.stages import Demo, Stage

FOLDER, WORKERS = Path("build/demo"), 2
GRID = "one touch at 27 positions, flat: error"
REMEDY = "make room or give write permission, then give the same command again to go on from here"

Document = dict[str, Any]


@with_output
def command(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder for all that the demo makes; what is finished stays.")
    ] = FOLDER,
    data: Annotated[
        Path | None, typer.Option(help="Folder with real recordings; left out when absent.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that simulate.")] = WORKERS,
    seed: int = 0,
    output: Output,
) -> None:
    """Run the whole chain (simulate, train, evaluate, go live) and write an HTML report.

    Datasets and the trained pipeline are kept in --out, so a demo that was interrupted goes on from
    there. The report is one file, report.html, that needs nothing else.
    """
    require_all(training=TRAINING, hardware="serial cobs", view="pyvista matplotlib", demo="jinja2")
    again = ["eitskin", "demo", "--out", str(out)]
    again += [] if data is None else ["--data", str(data)]
    try:
        with ended_by_signals():
            # Imports of the stages take seconds, and Ctrl-C shall be answered meanwhile.
            from eitskin.cli.demo.stages import Demo

            document = run_demo(Demo(out, data, workers, output, seed), again)
    except (KeyboardInterrupt, PartialError):
        again += [] if workers == WORKERS else ["--workers", str(workers)]
        again += [] if seed == 0 else ["--seed", str(seed)]
        # Not through a console, which would break the line.
        typer.echo(f"finished stages are kept; continue with: {shlex.join(again)}", err=True)
        raise
    seconds = sum(document["seconds"].values())
    sentence = f"\nreport, made in {seconds:.0f} s: {(out / 'report.html').resolve().as_uri()}"
    output.result(document, sentence)


def run_demo(demo: "Demo", words: list[str]) -> Document:
    """Run all stages, and write report.html and report.json; returns the document.

    Args:
        demo: the folder, and how it is filled.
        words: command line that makes the same demo, without its seed.

    Raises PartialError where the folder cannot be written to; the same demo goes on then.
    """
    from eitskin.cli.demo.stages import PACKAGES, STAGES
    from eitskin.files import atomic_file
    from eitskin.provenance import Provenance, package_versions
    from eitskin.training.evaluation.drawing import style

    stages, seconds = {}, {}
    for number, (name, (heading, work)) in enumerate(STAGES.items(), 1):
        demo.output.heading(f"{number}. {heading}")
        start = time.perf_counter()
        with style():
            stage = stages[name] = work(demo)
        seconds[name] = round(time.perf_counter() - start, 2)
        for shown in (stage.table, *stage.remarks):
            if shown is not None:
                demo.output.show(shown)
    provenance = asdict(Provenance.now(demo.seed))
    numbers = {
        "provenance": {
            "command": shlex.join([*words, "--seed", str(demo.seed)]),
            "versions": package_versions(PACKAGES),
            "cores": os.cpu_count(),
            **{key: provenance[key] for key in ("machine", "python", "seed", "date")},
        },
        "seconds": seconds,
        **{name: stage.numbers for name, stage in stages.items()},
    }
    document: Document = json.loads(json.dumps(numbers, allow_nan=False))
    files = {
        "report.json": json.dumps(document, indent=1) + "\n",
        "report.html": page(stages, document, shlex.quote(str(demo.model))),
    }
    for file, text in files.items():
        with atomic_file(demo.out / file, PartialError, REMEDY) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return document


def page(stages: Mapping[str, "Stage"], document: Document, model: str) -> str:
    """The report as one HTML page without references to anything outside.

    Args:
        stages: results by the names of their stages.
        document: numbers of all stages.
        model: pipeline that was trained, as a word of a command line.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    from eitskin.cli.demo.stages import COLUMNS, SETS, STAGES, episode_cells
    from eitskin.training.evaluation.scores import SSIM_DEFINITION

    environment = Environment(
        loader=PackageLoader("eitskin.cli.demo", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html.j2").render(
        document=document,
        results=stages,
        number=lambda path, form="": marked_number(document, path, form),
        headings={name: heading for name, (heading, _) in STAGES.items()},
        sets=SETS,
        model=model,
        paper_rows=_paper_rows(document),
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


def _paper_rows(document: Document) -> list[list[str]]:
    """Rows of the paper's table: experiment, published, trained here, shipped.

    The errors of touches on the grid come first, then all figures of the test frames.
    """
    import msgspec

    from eitskin.training.evaluation.report import table_rows

    rows: dict[tuple[str, str], list[str]] = {}
    for stage, column in (
        ("indentation", 2),
        ("test", 2),
        ("shipped_indentation", 3),
        ("shipped", 3),
    ):
        experiment = ""
        for name, published, here in table_rows(msgspec.convert(document[stage], training.Report)):
            experiment = experiment if name.startswith(" ") else name
            key, shown = (experiment, name), name
            if "indentation" in stage:
                if experiment != "one touch: error":
                    continue
                shown = name if name.startswith(" ") else GRID
                key = (GRID, shown)
            row = rows.setdefault(key, [shown, published.replace("+-", "±"), "-", "-"])
            row[column] = here.replace("+-", "±")
    return list(rows.values())
