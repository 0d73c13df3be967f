"""Every notebook runs from top to bottom, without Jupyter; each asserts its own numbers."""

import json
import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LINK = re.compile(r"\]\(([^)#\s]+)")


def cells(path, kind):
    """Sources of the cells of a kind, in order."""
    book = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(each["source"]) for each in book["cells"] if each["cell_type"] == kind]


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
    run = runpy.run_path(str(path.with_name("run.py")), run_name="run")["run"]
    assert outputs(run(book)) == outputs(book), "run docs/notebooks/run.py"
    assert outputs(book)[0]
    assert "assert " in "".join(cells(path, "code"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_stored_with_outputs_as_the_format_asks(path):
    book = json.loads(path.read_text(encoding="utf-8"))
    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    identifiers = [each["id"] for each in book["cells"]]
    assert len(set(identifiers)) == len(identifiers)
    for each in book["cells"]:
        assert each["cell_type"] in ("code", "markdown")
        assert re.fullmatch(r"[a-zA-Z0-9_-]{1,64}", each["id"])
        assert each["metadata"] == {}
        if each["cell_type"] == "code":
            assert each["execution_count"] > 0


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_its_links_lead_to_pages(path):
    for target in LINK.findall("".join(cells(path, "markdown"))):
        assert (path.parent / target).resolve().is_file(), target


def test_all_are_on_the_map():
    page = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) == 3
    for path in NOTEBOOKS:
        assert f"(notebooks/{path.name})" in page
