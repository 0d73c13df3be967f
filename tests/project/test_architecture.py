"""Architecture against the code."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("geometry", "simulator", "datasets", "training", "hardware", "cli", "benchmarks")
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
FILE = re.compile(r"`([a-z0-9_]+(?:/[a-z0-9_]+)*\.(?:py|js))`")
WALKS = {
    section.partition("\n")[0]: FILE.findall(section)
    for section in re.split(r"^## ", PAGE, flags=re.MULTILINE)
    if section.startswith("From ")
}


def exported() -> dict[str, str]:
    """File of each public name, as `room.Name`."""
    return {
        f"{stub.parent.name}.{alias.name}": f"{node.module[8:].replace('.', '/')}.py"
        for stub in ROOT.glob("*/__init__.pyi")
        for node in ast.parse(stub.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }


EXPORTED = exported()


def imported(file: str) -> set[str]:
    """Files that a file imports from, lazily too, or by the name of a room."""
    source = (ROOT / file).read_text(encoding="utf-8")
    if file.endswith(".js"):
        names = re.findall(r'from "\./(\w+\.js)"', source)
        return {f"{file.rpartition('/')[0]}/{name}" for name in names}
    paths = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module:
            module = node.module.removeprefix("eitskin.").replace(".", "/")
            paths |= {f"{module}.py", *(f"{module}/{each.name}.py" for each in node.names)}
    named = {EXPORTED[n] for n in re.findall(r"\b\w+\.\w+", source) if n in EXPORTED}
    return {*paths, *named, *(f"eitskin/{path}" for path in paths)}


def test_there_are_four_walks() -> None:
    assert len(WALKS) == 4
    assert all(len(files) > 10 for files in WALKS.values())


@pytest.mark.parametrize("walk", WALKS)
def test_every_file_of_a_walk_is_imported_by_one_before_it(walk) -> None:
    """A page that a browser loads is named by the server's folder, not by an import."""
    files = WALKS[walk]
    known = imported(files[0])
    for file in files[1:]:
        assert (ROOT / file).is_file(), f"{walk}: {file} is gone; mend docs/architecture.md"
        entrance = file.endswith("/main.js")
        assert entrance or file in known, f"{walk}: nothing before {file} imports it"
        known |= imported(file)


def test_the_picture_shows_every_folder_of_every_room() -> None:
    picture = PAGE.split("```")[1]
    for room in ROOMS:
        assert f" {room}/ " in picture, room
        if room == "benchmarks":
            continue
        for folder in (path.parent for path in (ROOT / room).glob("*/__init__.py")):
            assert folder.name in picture, f"{room}/{folder.name} is not in the picture"


def test_every_place_for_a_change_is_there() -> None:
    for place in re.findall(r"`((?:\w+/)+(?:\w+\.py)?)`", PAGE):
        assert (ROOT / place).exists(), place
