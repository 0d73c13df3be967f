"""Extras: what is installed without any, and what a robot's computer needs to run a pipeline."""

import ast
import re
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from eitskin import geometry
from eitskin.extras import lazy_exports
from eitskin.geometry import Disc

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


def test_public_names_are_those_of_the_stub_and_imported_on_first_access() -> None:
    names, get, listed = lazy_exports("eitskin.geometry", geometry.__file__)
    assert names == sorted(geometry.__all__)
    assert set(names) < set(listed())
    assert get("Disc") is vars(geometry)["Disc"] is Disc
    with pytest.raises(AttributeError, match="no attribute 'Four'"):
        get("Four")
