"""Every script of the gallery runs from top to bottom, and its pictures are of today's code."""

import json
import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
GALLERY = ROOT / "docs" / "gallery"
DRAW = runpy.run_path(str(GALLERY / "draw.py"), run_name="draw")
NOTES = json.loads((GALLERY / "drawn.json").read_text())
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")
PAGES = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
IMAGE = re.compile(r"!\[[^]]*\]\(([^)#\s]+)\)")


@pytest.fixture
def run(monkeypatch):
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
        float(a) == pytest.approx(float(b), rel=0.01, abs=10.0 ** -len(b.partition(".")[2]))
        for a, b in zip(NUMBER.findall(now), NUMBER.findall(then), strict=True)
    )


@pytest.mark.slow
@pytest.mark.parametrize("script", DRAW["SCRIPTS"], ids=lambda path: path.stem)
def test_its_numbers_are_those_that_its_picture_was_drawn_with(script, run, capsys):
    run(script)
    now, then = capsys.readouterr().out.splitlines(), NOTES[script.stem]["numbers"]
    assert len(now) == len(then) > 0
    assert all(map(same_numbers, now, then)), "physics or pipeline changed: `make pictures`"


@pytest.mark.parametrize("script", [*DRAW["SCRIPTS"], DRAW["MUJOCO"]], ids=lambda path: path.stem)
def test_its_picture_was_drawn_by_it_as_it_is_now(script):
    assert DRAW["digest"](script) == NOTES[script.stem]["digest"], "run `make pictures`"


def test_every_picture_is_shown_and_drawn_by_a_script():
    shown = {
        (page.parent / each).resolve() for page in PAGES for each in IMAGE.findall(page.read_text())
    }
    found = [*(ROOT / "docs").rglob("*.png"), *(ROOT / "docs").rglob("*.gif")]
    pictures = {path for path in found if path.parent.name != "api"}  # `make docs` writes there
    assert pictures == {path for path in shown if path.suffix in (".png", ".gif")}
    stems = {path.stem.removesuffix("_setup") for path in pictures}
    assert stems == set(NOTES)
