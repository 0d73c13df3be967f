"""Tutorials run as written, notebooks from top to bottom, without Jupyter."""

import json
import re
import runpy
import shlex
from pathlib import Path

import pytest
from command_line import run

DOCS = Path(__file__).resolve().parents[2] / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
BLOCK = re.compile(r"^```(python|bash|toml)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_it_runs_as_written(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scope: dict[str, object] = {"__name__": "__main__"}
    for language, body in BLOCK.findall(page.read_text(encoding="utf-8")):
        if language == "toml":
            name = re.match(r"# (\S+\.toml)", body)[1]
            (tmp_path / name).write_text(body)
        elif language == "python":
            exec(compile(body, str(page), "exec"), scope)  # noqa: S102
        else:
            for line in body.splitlines():
                _, *words = shlex.split(line, comments=True)
                ran = run(*words)
                assert ran.exit_code == 0, f"{line}: {ran.stderr}"


def test_each_says_what_the_reader_will_have_and_how_long_it_takes():
    assert len(TUTORIALS) == 4
    for page in TUTORIALS:
        first = page.read_text(encoding="utf-8").split("\n\n")[1]
        assert re.search(r"minutes", first), page.name


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


def test_all_notebooks_are_on_the_map():
    page = (DOCS / "index.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) == 3
    for path in NOTEBOOKS:
        assert f"(notebooks/{path.name})" in page
