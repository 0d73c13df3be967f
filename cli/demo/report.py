"""A demo's report: one HTML page and one JSON document, from what its stages left behind."""

import json
import os
import shlex
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from eitskin.cli.demo.folder import Demo
from eitskin.cli.demo.html import page
from eitskin.cli.demo.parts import REMEDY, Kept
from eitskin.cli.demo.sections import TITLE, content
from eitskin.errors import PartialError
from eitskin.files import atomic_file
from eitskin.provenance import Provenance

PAGE, DOCUMENT = "report.html", "report.json"

Parts = Mapping[str, Kept]
Document = dict[str, Any]


def write_demo_report(parts: Parts, demo: Demo) -> Document:
    """Write report.html and report.json into the demo's folder; what the second holds.

    Raises PartialError where they cannot be written.
    """
    document = document_of(parts, demo)
    texts = {
        DOCUMENT: json.dumps(document, indent=1, allow_nan=False) + "\n",
        PAGE: page(TITLE, content(parts, document)),
    }
    for name, text in texts.items():
        with atomic_file(demo.out / name, PartialError, REMEDY) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return document


def document_of(parts: Parts, demo: Demo) -> Document:
    """All numbers by stage, and what they were made with."""
    made = asdict(Provenance.now(demo.plan.seed))
    given = [] if demo.data is None else ["--data", str(demo.data)]
    command = ["eitskin", "demo", "--out", str(demo.out), *given, "--seed", str(demo.plan.seed)]
    first = next(iter(parts.values()))
    return {
        "provenance": {
            "command": shlex.join(command),
            "machine": made["machine"],
            "cores": os.cpu_count(),
            "python": made["python"],
            "versions": first.made_from["versions"],
            "seed": demo.plan.seed,
            "date": max(kept.date for kept in parts.values()),
        },
        "seconds": {name: kept.seconds for name, kept in parts.items()},
        **{name: kept.part.numbers for name, kept in parts.items()},
    }
