"""Every notebook runs from top to bottom, without Jupyter; each asserts its own numbers."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
LINK = re.compile(r"\]\(([^)#\s]+)")


def cells(path, kind):
    """Sources of the cells of a kind, in order."""
    book = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(each["source"]) for each in book["cells"] if each["cell_type"] == kind]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_its_cells_run_in_order_and_its_numbers_hold(path, tmp_path, monkeypatch, capsys):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    for number, source in enumerate(cells(path, "code"), 1):
        exec(compile(source, f"{path.name}, cell {number}", "exec"), names)  # noqa: S102
    plt.close("all")
    assert capsys.readouterr().out.strip(), "it says what it found"
    assert "assert " in "".join(cells(path, "code"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_stored_without_outputs_as_the_format_asks(path):
    book = json.loads(path.read_text(encoding="utf-8"))
    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    identifiers = [each["id"] for each in book["cells"]]
    assert len(set(identifiers)) == len(identifiers)
    for each in book["cells"]:
        assert each["cell_type"] in ("code", "markdown")
        assert re.fullmatch(r"[a-zA-Z0-9_-]{1,64}", each["id"])
        assert each["metadata"] == {}
        if each["cell_type"] == "code":
            assert each["outputs"] == []
            assert each["execution_count"] is None


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_its_links_lead_to_pages(path):
    for target in LINK.findall("".join(cells(path, "markdown"))):
        assert (path.parent / target).resolve().is_file(), target


def test_all_are_on_the_map():
    page = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) == 3
    for path in NOTEBOOKS:
        assert f"(notebooks/{path.name})" in page
