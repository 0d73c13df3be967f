"""Every notebook runs from top to bottom, without Jupyter; each asserts its own numbers."""

import json
import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def outputs(book):
    """Texts that the cells print, in order, without their numbers; and the number of figures."""
    found = [each for cell in book["cells"] for each in cell.get("outputs", ())]
    texts = ["".join(each["text"]) for each in found if each["output_type"] == "stream"]
    return [re.sub(r"[-\d. ]+", " ", text) for text in texts], len(found) - len(texts)


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_its_cells_run_in_order_and_print_what_is_stored(path):
    pytest.importorskip("matplotlib")
    book = json.loads(path.read_text(encoding="utf-8"))
    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    run = runpy.run_path(str(path.with_name("run.py")), run_name="run")["run"]
    assert outputs(run(book)) == outputs(book), "run docs/notebooks/run.py"
    assert outputs(book)[0]
    assert "assert " in "".join("".join(each["source"]) for each in book["cells"])


def test_all_are_on_the_map():
    page = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) == 3
    for path in NOTEBOOKS:
        assert f"(notebooks/{path.name})" in page
