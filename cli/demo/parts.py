"""What the stages of a demo leave behind: one file each, kept while what it was made from stays."""

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

PNG, SVG = "image/png", "image/svg+xml"
REMEDY = "make room or give write permission, then give the same command again to go on from here"


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture and what it shows.

    Attributes:
        alt: what is seen, in a few words, for those who do not see it.
        caption: what is seen and how it was made, in full.
        media: `PNG` or `SVG`.
        data: the picture's file.
        width: that it should have where there is room [inch].
    """

    alt: str
    caption: str
    media: str
    data: bytes
    width: float


@dataclass(frozen=True, slots=True)
class Part:
    """What one stage found.

    Attributes:
        numbers: plain data, as JSON takes it.
        pictures: by name, in the order in which they are shown.
        told: what there is to say beside them, in sentences.
    """

    numbers: dict[str, Any]
    pictures: dict[str, Picture] = field(default_factory=dict)
    told: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Kept:
    """A part in its file.

    Attributes:
        made_from: everything that decides over the part: seed, inputs by their SHA-256, version.
        part: what was found.
        seconds: that it took.
        date: when it was finished, ISO 8601, UTC.
    """

    made_from: dict[str, Any]
    part: Part
    seconds: float
    date: str


def keep(
    path: Path, made_from: Mapping[str, Any], make: Callable[[], Part], start: float | None = None
) -> Kept:
    """The part in the file `path` where it was made from the same, else a new one, then kept there.

    What comes back was read from the file's bytes in both cases, so that a demo which went on from
    kept parts reports what an uninterrupted one does.

    Args:
        path: of the file.
        made_from: everything that decides over the part, plain data.
        make: the part.
        start: when work for it began, by `time.perf_counter`; now, when omitted.

    Raises PartialError where the file cannot be written.
    """
    start = time.perf_counter() if start is None else start
    expected = msgspec.json.decode(msgspec.json.encode(made_from))  # as it will be read back
    kept = _read(path)
    if kept is not None and kept.made_from == expected:
        return kept
    part = make()
    now = datetime.now(UTC).isoformat(timespec="seconds")
    made = Kept(expected, part, round(time.perf_counter() - start, 2), now)
    content = msgspec.json.encode(made)
    with atomic_file(path, PartialError, REMEDY) as temporary:
        temporary.write_bytes(content)
    return msgspec.json.decode(content, type=Kept)


def _read(path: Path) -> Kept | None:
    """What lies at `path`; None where nothing does, or nothing that can be read."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Kept)
    except (OSError, msgspec.MsgspecError):
        return None


def drawn_picture(drawn: CaptionedFigure, alt: str) -> Picture:
    """A matplotlib figure as SVG, which is sharp on paper."""
    width = float(drawn.figure.get_figwidth())
    return Picture(alt, drawn.caption, SVG, _svg(drawn.figure), width)


def _svg(figure: Any) -> bytes:
    """The file of a figure; equal figures give equal bytes."""
    file = io.BytesIO()
    with require("matplotlib", EXTRA).rc_context({"svg.hashsalt": "eitskin"}):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()


def drawn_pictures(
    drawn: Mapping[str, tuple[CaptionedFigure | NoFigure, str]],
) -> dict[str, Picture]:
    """The figures with their alternative texts as SVG; those that are absent are left out."""
    return {
        name: drawn_picture(figure, alt)
        for name, (figure, alt) in drawn.items()
        if isinstance(figure, CaptionedFigure)
    }
