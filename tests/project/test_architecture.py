"""Architecture, and the size of every package, against the code."""

import ast
import re
import sys
from functools import cache
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
ROW = re.compile(r"^\| `(\w+)` \| ([\d,]+) \| ([\d,]+) \| (\d*) ?\|$", re.MULTILINE)
BUDGET = {
    name: [int(n.replace(",", "") or 0) for n in numbers] for name, *numbers in ROW.findall(PAGE)
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


@pytest.mark.slow
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


def test_the_picture_shows_every_folder_and_every_place_for_a_change_is_there():
    picture = PAGE.split("```")[1]
    for room in ROOMS:
        assert f" {room}/ " in picture, room
        if room == "benchmarks":
            continue
        for folder in (path.parent for path in (ROOT / room).glob("*/__init__.py")):
            assert folder.name in picture, f"{room}/{folder.name} is not in the picture"
    for place in re.findall(r"`((?:\w+/)+(?:\w+\.py)?)`", PAGE):
        assert (ROOT / place).exists(), place
    assert len(WALKS) == 4
    assert all(len(files) > 10 for files in WALKS.values())


@pytest.fixture(scope="module")
def depth():
    """Length of the longest chain of imports that begins at a module, lazy ones included."""
    import grimp

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / ".types")  # where the packages lie under one folder
        patch.delitem(sys.modules, "eitskin")
        graph = grimp.build_graph("eitskin", cache_dir=None)

    @cache
    def chain(module):
        imported = graph.find_modules_directly_imported_by(module)
        return 1 + max(map(chain, imported), default=0)

    return lambda name: max(chain(m) for m in graph.modules if m.split(".")[1:2] == [name])


def test_every_package_has_a_budget():
    assert {"eitskin", "tests"} < set(BUDGET)
    assert {path.parent.name for path in ROOT.glob("*/__init__.py")} <= set(BUDGET)


@pytest.mark.parametrize("name", BUDGET)
def test_no_package_is_over_its_budget(name, depth):
    """Whoever adds takes something out, or raises the number in the same commit with its reason."""
    modules = sorted((ROOT / name).rglob("*.py"))
    lines = sum(len(module.read_text(encoding="utf-8").splitlines()) for module in modules)
    max_lines, max_modules, max_depth = BUDGET[name]
    assert lines <= max_lines, f"{name}: {lines} lines, {max_lines} allowed"
    assert len(modules) <= max_modules, f"{name}: {len(modules)} modules, {max_modules} allowed"
    if max_depth:
        assert depth(name) <= max_depth
