"""Extras: what is installed without any, and what a robot's computer needs to run a pipeline."""

import ast
import importlib
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
ROOMS = ("eitskin", "geometry", "simulator", "datasets", "training", "hardware", "cli")
LAZY = {"numba", "starlette", "torch", "uvicorn"}  # in modules imported where they are used
OLD = ROOT / "tests" / "data" / "v0.1" / "saved.zip"


def distributions(*extras: str) -> set[str]:
    """Names of what is installed with these extras, without what those depend on."""
    wanted = list(PROJECT["dependencies"])
    names = list(extras)
    for extra in names:
        for each in PROJECT["optional-dependencies"][extra]:
            if own := re.match(r"eitskin\[(.*)\]", each):
                names += own[1].split(",")
            else:
                wanted.append(each)
    return {re.match(r"[\w-]+", each)[0].lower().replace("_", "-") for each in wanted}


def imported_at_the_top(path: Path) -> set[str]:
    """Packages that a module imports when it is imported itself."""
    names = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            names |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


@pytest.mark.slow
def test_modules_import_only_what_is_installed_without_extras() -> None:
    """Packages that others happen to bring along may go: a new typer no longer brings click."""
    given, own = packages_distributions(), {"eitskin", *sys.stdlib_module_names}
    allowed = distributions()
    for path in (path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        for name in imported_at_the_top(path) - own - LAZY:
            found = {each.lower().replace("_", "-") for each in given.get(name, [name])}
            assert found & allowed, f"{path.relative_to(ROOT)} imports {name}"


@pytest.mark.slow
def test_pipelines_run_with_the_extra_live_alone(tmp_path) -> None:
    """A joint pipeline on a virtual board, and the paper's and touch positions of version 0.1.

    Opening a pipeline computes its golden frames, which go through all of its networks.
    """
    with zipfile.ZipFile(OLD) as archive:
        archive.extractall(tmp_path)
    everything = set().union(*(distributions(each) for each in PROJECT["optional-dependencies"]))
    left_out = everything - distributions("live")
    assert {"torch", "scikit-learn", "pyvista", "matplotlib", "numba"} <= left_out
    blocked = [
        name
        for name, given in packages_distributions().items()
        if {each.lower().replace("_", "-") for each in given} & left_out
    ]
    code = f"""
import sys
sys.modules.update(dict.fromkeys({[*blocked, "h5py"]!r}))
from eitskin.training.pipeline.pipeline import open_pipeline
for name in ("paper", "positions"):
    print(sorted(open_pipeline(f"{{name}}.eitmodel").targets.states))
open_pipeline("reference.eitmodel")
assert "skfem" not in sys.modules, "an estimate needs no finite elements"
sys.argv = "eitskin live reference.eitmodel --board virtual:?speed=max --frames 1 --json -q".split()
from eitskin.cli.entry import run
run()
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[:2] == ["['bend', 'idle', 'touch']", "[]"]
    assert '"state": "idle"' in done.stdout


# Lazy public names: what a stub lists is there, and is imported on first access only


STUB = """
from lazy_package.first import One as One
from lazy_package.first import Two as Two
from lazy_package.second import Three as Three
from lazy_package.second import Absent as Absent
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of two modules; its stub names one thing that the second does not define."""
    folder = tmp_path / "lazy_package"
    folder.mkdir()
    (folder / "__init__.py").write_text(
        "from eitskin.extras import lazy_exports\n"
        "__all__, __getattr__, __dir__ = lazy_exports(__name__, __file__)\n"
    )
    (folder / "__init__.pyi").write_text(STUB)
    (folder / "first.py").write_text("class One: ...\nclass Two: ...\n")
    (folder / "second.py").write_text("Three = object()\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("lazy_package")
    for name in [name for name in sys.modules if name.partition(".")[0] == "lazy_package"]:
        del sys.modules[name]


def test_the_names_are_those_of_the_stub(package) -> None:
    assert package.__all__ == ["Absent", "One", "Three", "Two"]
    assert set(package.__all__) < set(dir(package))


def test_a_module_is_imported_when_one_of_its_names_is_asked_for(package) -> None:
    assert "lazy_package.first" not in sys.modules
    assert package.One.__module__ == "lazy_package.first"
    assert "lazy_package.first" in sys.modules
    assert "lazy_package.second" not in sys.modules


def test_a_name_is_looked_up_once(package, monkeypatch) -> None:
    assert "Three" not in vars(package)
    found = package.Three
    assert vars(package)["Three"] is found
    monkeypatch.delitem(vars(package), "__getattr__")
    assert package.Three is found


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Four", "'lazy_package' has no attribute 'Four'"),
        ("Absent", r"'lazy_package\.second' has no attribute 'Absent'"),
    ],
)
def test_a_name_absent_from_the_stub_or_from_its_module_is_missing(package, name, message) -> None:
    with pytest.raises(AttributeError, match=message):
        getattr(package, name)
