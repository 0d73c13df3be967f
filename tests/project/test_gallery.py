"""Every script of the gallery runs from top to bottom; each asserts its own numbers."""

import runpy
import sys
from pathlib import Path

import pytest

GALLERY = Path(__file__).resolve().parents[2] / "docs" / "gallery"
SCRIPTS = sorted(path for path in GALLERY.glob("*.py") if path.stem != "style")


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


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_the_script_runs_and_its_numbers_hold(script, run, capsys):
    run(script)
    assert capsys.readouterr().out.strip(), "it says what it found"


@pytest.mark.slow
def test_a_picture_is_drawn_into_the_folder_that_is_given(run, tmp_path):
    run(GALLERY / "presses.py", tmp_path / "pictures")
    picture = tmp_path / "pictures" / "presses.png"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_each_script_is_shown_with_its_picture():
    page = (GALLERY / "README.md").read_text()
    for script in SCRIPTS:
        assert (GALLERY / f"{script.stem}.png").is_file(), "run `make gallery`"
        assert f"({script.name})" in page
        assert f"({script.stem}.png)" in page
