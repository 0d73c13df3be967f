"""Every message of docs/how-to/troubleshooting.md occurs, with the exit code of its section."""

import ast
import errno
import re
import sys
from functools import cache
from pathlib import Path

import pytest
from typer.testing import CliRunner

from eitskin import errors
from eitskin.cli import entry
from eitskin.cli.commands import simulate
from eitskin.cli.main import app
from eitskin.datasets import Recipe, open_dataset, read_recording
from eitskin.errors import DeviceError, PartialError
from eitskin.files import atomic_folder
from eitskin.hardware import open_board
from eitskin.hardware.boards.port import remedy
from eitskin.simulator import Scene

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "how-to" / "troubleshooting.md"
SECTIONS = re.split(r"^## .*exit code (\d+)$", PAGE.read_text(), flags=re.MULTILINE)[1:]
ROWS = [
    (int(code), message)
    for code, text in zip(SECTIONS[::2], SECTIONS[1::2], strict=True)
    for message in re.findall(r"^\| `(.+?)` \|", text, re.MULTILINE)
]


def constant_text(node) -> str:
    """Text of an expression, without what it puts into it."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    parts = node.values if isinstance(node, ast.JoinedStr) else ()
    return "".join(map(constant_text, parts))


@cache
def written_texts():
    """Texts of the source, each with the exit code of the error that is made of it, or None."""
    return set(_written_texts())


def _written_texts():
    rooms = {path.parent for path in ROOT.glob("*/__init__.py")}
    for path in sorted(path for room in rooms for path in room.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            kind = getattr(getattr(node, "func", None), "id", "")
            if kind.endswith("Error") and node.args:
                code = getattr(getattr(errors, kind, None), "exit_code", 2)
                yield constant_text(node.args[0]), code
            elif isinstance(node, ast.JoinedStr | ast.Constant):
                yield constant_text(node), None


def read_as(read, name):
    """Provokes what `read` says of a file `name` with a text."""

    def with_text(text):
        def provoke(folder):
            (folder / name).write_text(text)
            read(folder / name)

        return provoke

    return with_text


scene = read_as(lambda path: simulate.command(path, resolution="fast"), "scene.toml")


def no_permission(_):
    # Whoever runs the tests may have every right, so the system's own words are given.
    said = remedy(PermissionError(errno.EACCES, "Permission denied"))
    raise DeviceError(f"serial:X: cannot open the port: {said}")


def no_room(folder):
    with atomic_folder(folder / "a", PartialError, "make room, or choose another place"):
        raise OSError(errno.ENOSPC, "No space left on device")


# What begins with these words has no text of its own in the source.
PROVOKED = {
    "cannot read ": lambda folder: Scene.from_toml(folder / "none.toml"),
    "...: expected a finite": scene("[bend]\nangle_deg = nan\n"),
    "sensor: a design file": read_as(Recipe.from_toml, "recipe.toml")(
        'name = "a"\nsensor = { file = "six.toml" }\n'
    ),
    "... is not a complete": open_dataset,
    "cannot find the": read_as(read_recording, "a.csv")("w0,w1\n1,2\n"),
    "...: cannot open the port: there is none": lambda _: open_board("serial:/dev/none-such"),
    "...: cannot open the port: another": lambda _: open_board("virtual:?faults=port_in_use"),
    "...: cannot open the port: no permission": no_permission,
    "cannot write": no_room,
}


@pytest.mark.slow
@pytest.mark.parametrize(("code", "message"), ROWS)
def test_the_message_occurs(code, message, tmp_path):
    parts = message.split("...")
    pattern = re.compile(".*".join(map(re.escape, parts)), re.DOTALL)
    beginnings = [each for each in PROVOKED if message.startswith(each)]
    if not beginnings:
        longest = max(re.split(r"\.\.\.|\d[\d.]*%?", message), key=len).strip()
        near = [each for each in written_texts() if all(part in each[0] for part in parts)]
        codes = {known for text, known in near if pattern.search(text)}
        assert code in codes or any(longest in text for text, _ in written_texts())
        return
    with pytest.raises(errors.EitskinError) as caught:
        PROVOKED[max(beginnings, key=len)](tmp_path)
    assert pattern.search(str(caught.value)), str(caught.value)
    assert caught.value.exit_code == code


def test_each_is_listed_once():
    assert len(ROWS) == len(set(ROWS)) > len(PROVOKED)


class Interrupts:
    """Has Ctrl-C come when `eitskin.cli.main` is about to be loaded."""

    def find_spec(self, name, *_):
        if name == "eitskin.cli.main":
            raise KeyboardInterrupt


def test_ctrl_c_while_the_commands_load_says_so(monkeypatch, capsys):
    monkeypatch.delattr("eitskin.cli.main")
    monkeypatch.delitem(sys.modules, "eitskin.cli.main")
    monkeypatch.setattr(sys, "meta_path", [Interrupts(), *sys.meta_path])
    with pytest.raises(SystemExit) as ended:
        entry.run()
    assert ended.value.code == 130
    assert capsys.readouterr().err == "eitskin: interrupted\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "extras"),
    [
        ("bench paper", "training,bench"),
        ("bench layouts", "bench"),
        ("bench speed", "training,bench"),
        ("bench accuracy", "bench"),
        ("bench all", "training,bench"),
        ("train data --out a.eitmodel", "training"),
        ("demo", "training,view"),
    ],
)
def test_all_that_is_missing_is_named_before_the_work(arguments, extras, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("torch", "safetensors", "matplotlib"):
        monkeypatch.setitem(sys.modules, name, None)
    ran = CliRunner().invoke(app, arguments.split())
    assert isinstance(ran.exception, ImportError)
    assert str(ran.exception).endswith(f"pip install 'eitskin[{extras}]'")
    assert not list(tmp_path.iterdir())
