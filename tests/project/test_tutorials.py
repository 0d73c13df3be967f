"""Tutorials, notebooks and scripts of the gallery run as written; pictures are of today's code."""

import json
import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest
from command_line import run

from eitskin.training import NetworkSettings

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
BLOCK = re.compile(r"^```(python|bash|toml)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
GALLERY = DOCS / "gallery"
DRAW = runpy.run_path(str(GALLERY / "draw.py"), run_name="draw")
NOTES = json.loads((GALLERY / "drawn.json").read_text())
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")
PAGES = [ROOT / "README.md", *DOCS.rglob("*.md")]
IMAGE = re.compile(r"!\[[^]]*\]\(([^)#\s]+)\)")


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_it_runs_as_written(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # A tenth of the steps, which are many for few frames.
    monkeypatch.setattr(NetworkSettings, "count_epochs", lambda settings, _: settings.epochs)
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
                run(*words, code=0)


def test_pages_say_what_the_reader_will_have_and_notebooks_and_pictures_are_shown():
    assert len(TUTORIALS) == 4
    for page in TUTORIALS:
        first = page.read_text(encoding="utf-8").split("\n\n")[1]
        assert re.search(r"minutes", first), page.name
    page = (DOCS / "index.md").read_text(encoding="utf-8")
    assert len(NOTEBOOKS) == 3
    for path in NOTEBOOKS:
        assert f"(notebooks/{path.name})" in page
    shown = {
        (page.parent / each).resolve() for page in PAGES for each in IMAGE.findall(page.read_text())
    }
    found = [*DOCS.rglob("*.png"), *DOCS.rglob("*.gif")]
    pictures = {path for path in found if path.parent.name != "api"}  # `make docs` writes there
    assert pictures == {path for path in shown if path.suffix in (".png", ".gif")}
    stems = {path.stem.removesuffix("_setup") for path in pictures}
    assert stems == set(NOTES)


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


@pytest.fixture
def run_script(monkeypatch):
    """Runs a script as `python SCRIPT ARGUMENTS` would, in this process; its look ends with it."""
    rc_context = pytest.importorskip("matplotlib").rc_context
    monkeypatch.syspath_prepend(str(GALLERY))
    monkeypatch.delitem(sys.modules, "style", raising=False)

    def run(script, *arguments):
        monkeypatch.setattr(sys, "argv", [str(script), *map(str, arguments)])
        with rc_context():
            runpy.run_path(str(script), run_name="__main__")
        sys.modules.pop("style", None)  # sets the look as it is imported

    return run


def same_numbers(now, then):
    """Whether two texts are equal up to the rounding of their numbers."""
    if NUMBER.sub("", now) != NUMBER.sub("", then):
        return False
    return all(
        float(a) == pytest.approx(float(b), rel=0.01, abs=1.5 * 10.0 ** -len(b.partition(".")[2]))
        for a, b in zip(NUMBER.findall(now), NUMBER.findall(then), strict=True)
    )


@pytest.mark.slow
@pytest.mark.parametrize("script", DRAW["SCRIPTS"], ids=lambda path: path.stem)
def test_its_numbers_are_those_that_its_picture_was_drawn_with(script, run_script, capsys):
    run_script(script)
    now, then = capsys.readouterr().out.splitlines(), NOTES[script.stem]["numbers"]
    assert len(now) == len(then) > 0
    assert all(map(same_numbers, now, then)), "physics or pipeline changed: `make pictures`"


@pytest.mark.parametrize("script", [*DRAW["SCRIPTS"], DRAW["MUJOCO"]], ids=lambda path: path.stem)
def test_its_picture_was_drawn_by_it_as_it_is_now(script):
    assert DRAW["digest"](script) == NOTES[script.stem]["digest"], "run `make pictures`"
