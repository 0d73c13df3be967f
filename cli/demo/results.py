"""Results of the demo's stages, each stored in a file of its own until its inputs change."""

import io
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from eitskin.errors import PartialError
from eitskin.extras import require
from eitskin.files import atomic_file
from eitskin.training.evaluation.report.drawing import EXTRA, CaptionedFigure, NoFigure

SVG, WEBP = "image/svg+xml", "image/webp"
REMEDY = "make room or give write permission, then give the same command again to go on from here"

# Words as text instead of outlines of glyphs, and the same bytes each time.
_PLAIN = {"svg.hashsalt": "eitskin", "svg.fonttype": "none"}


@dataclass(frozen=True, slots=True)
class Picture:
    """Picture with its texts.

    Attributes:
        alt: short text for readers who do not see the picture.
        caption: full text: content and how it was made.
        media: `SVG` or `WEBP`.
        data: bytes of the file.
        width: width where there is room [inch].
    """

    alt: str
    caption: str
    media: str
    data: bytes
    width: float


@dataclass(frozen=True, slots=True)
class StageResult:
    """Result of one stage.

    Attributes:
        numbers: plain data, as JSON takes it.
        pictures: by name, in the order in which they are shown.
        remarks: sentences beside them.
    """

    numbers: dict[str, Any]
    pictures: dict[str, Picture] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class StoredResult:
    """Result of one stage as stored in its file.

    Attributes:
        inputs: everything that the result depends on: seed, versions, SHA-256 of data.
        result: numbers, pictures and remarks.
        seconds: time that the stage took.
        date: end of the stage, ISO 8601, UTC.
    """

    inputs: dict[str, Any]
    result: StageResult
    seconds: float
    date: str


def stored(
    path: Path,
    inputs: Mapping[str, Any],
    make: Callable[[], StageResult],
    start: float | None = None,
) -> StoredResult:
    """Result in the file `path` where its inputs are the same, else a new one, stored there.

    The result is decoded from the file's bytes in both cases, so that a demo that was resumed
    reports the same as an uninterrupted one.

    Args:
        path: file of the stage.
        inputs: everything that the result depends on, plain data.
        make: computes the result.
        start: begin of the stage, by `time.perf_counter`; now, when omitted.

    Raises PartialError where the file cannot be written.
    """
    start = time.perf_counter() if start is None else start
    expected = msgspec.json.decode(msgspec.json.encode(inputs))  # as it will be read back
    try:
        found = msgspec.json.decode(path.read_bytes(), type=StoredResult)
        if found.inputs == expected:
            return found
    except (OSError, msgspec.MsgspecError):
        pass  # missing, or written by another version
    result = make()
    now = datetime.now(UTC).isoformat(timespec="seconds")
    content = msgspec.json.encode(
        StoredResult(expected, result, round(time.perf_counter() - start, 2), now)
    )
    with atomic_file(path, PartialError, REMEDY) as temporary:
        temporary.write_bytes(content)
    return msgspec.json.decode(content, type=StoredResult)


def as_pictures(drawn: Mapping[str, tuple[CaptionedFigure | NoFigure, str]]) -> dict[str, Picture]:
    """Figures with their alternative texts as SVG pictures; absent figures are left out."""
    return {
        name: Picture(alt, each.caption, SVG, _svg(each.figure), float(each.figure.get_figwidth()))
        for name, (each, alt) in drawn.items()
        if isinstance(each, CaptionedFigure)
    }


def _svg(figure: Any) -> bytes:
    """SVG file of a figure; equal figures give equal bytes."""
    file = io.BytesIO()
    with require("matplotlib", EXTRA).rc_context(_PLAIN):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()
