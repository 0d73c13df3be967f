"""Tables of results as CSV, whole and with what they were measured with."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eitskin.files import atomic_file


def write_table(path: Path, rows: Sequence[dict[str, Any]], comment: str) -> None:
    """Write rows with a header, after a line that begins with # and says how they were measured.

    Raises ConfigurationError where the file cannot be written; what was there is kept.
    """
    text = io.StringIO()
    text.write(f"# {comment}\n")
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with atomic_file(path) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")
