"""Every tutorial runs as written: files, commands and Python, one after the other."""

import re
import shlex
from pathlib import Path

import pytest
from command_line import run

TUTORIALS = sorted((Path(__file__).resolve().parents[2] / "docs" / "tutorials").glob("*.md"))
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
