"""Run notebooks, all or those named, and store what their cells print and draw; `make pages`."""

import base64
import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib as mpl

HERE = Path(__file__).resolve().parent
Cell = dict[str, Any]


def outputs(source: str, names: dict[str, Any]) -> list[Cell]:
    """Outputs of a cell that runs in a namespace: its text, then its figures."""
    from matplotlib import pyplot as plt

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(source, "cell", "exec"), names)  # noqa: S102
    text = printed.getvalue().splitlines(keepends=True)
    found: list[Cell] = []
    if text:
        found.append({"name": "stdout", "output_type": "stream", "text": text})
    for number in plt.get_fignums():
        file = io.BytesIO()
        plt.figure(number).savefig(
            file, format="png", dpi=100, bbox_inches="tight", metadata={"Software": None}
        )
        image = {"image/png": base64.b64encode(file.getvalue()).decode()}
        found.append({"data": image, "metadata": {}, "output_type": "display_data"})
    plt.close("all")
    return found


def run(book: dict[str, Any]) -> dict[str, Any]:
    """Notebook with the outputs of its cells, which run in a folder of their own."""
    mpl.use("Agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    cells = []
    count, here = 0, Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            for cell in book["cells"]:
                done = dict(cell)
                if cell["cell_type"] == "code":
                    count += 1
                    found = outputs("".join(cell["source"]), names)
                    done |= {"execution_count": count, "outputs": found}
                cells.append(done)
        finally:
            os.chdir(here)
    return book | {"cells": cells}


if __name__ == "__main__":
    for path in sorted(HERE.glob("*.ipynb")):
        if len(sys.argv) == 1 or path.stem in sys.argv[1:]:
            book = run(json.loads(path.read_text(encoding="utf-8")))
            text = json.dumps(book, indent=1, ensure_ascii=False) + "\n"
            path.write_text(text, encoding="utf-8")
