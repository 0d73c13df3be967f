"""Packaging: the wheel has every module, imports load nothing needlessly, extras suffice."""

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

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("geometry", "simulator", "datasets", "training", "hardware", "cli", "benchmarks")
FOLDERS = ("eitskin", *ROOMS)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LAZY = {"numba", "starlette", "torch", "uvicorn"}  # in modules imported where they are used
OLD = ROOT / "tests" / "data" / "v0.1" / "saved.zip"
HEAVY = {"torch", "numba", "pyvista", "matplotlib", "serial", "sklearn", "skimage"}
HEAVY |= {"safetensors", "h5py", "trimesh", "pytetwild", "pyeit"}
# Each after those above it.
STEPS = {
    "eitskin": "import eitskin",
    "rooms": "import eitskin." + ", eitskin.".join(ROOMS),
    "frames": "import eitskin.simulator; from eitskin.simulator import Frame, Protocol",
    "simulator": "from eitskin.geometry import *; from eitskin.simulator import *",
    "scenes": "Simulator(SensorDesign.reference(), 'fast').measure_all([Scene()])",
    "datasets": "import eitskin.datasets",
}


def test_the_wheel_holds_every_module_of_the_tree(tmp_path) -> None:
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path)]
    done = subprocess.run([*build, str(ROOT)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    assert "eitskin/training/reference.eitmodel/weights.safetensors" in held
    patterns = (
        "*.py",
        "*.pyi",
        "py.typed",
        "*.toml",
        "library/*.npz",
        "firmware/*.[ch]",
        "nucleo_f411/*.*",
        "include/*.h",
        "*.css",
        "web/*",
        "foxglove.json",
    )
    files = {
        path.relative_to(ROOT).as_posix()
        for folder in FOLDERS
        for pattern in patterns
        for path in (ROOT / folder).rglob(pattern)
    }
    wanted = {f"eitskin/{name.removeprefix('eitskin/')}" for name in files}
    assert len(wanted) > 200
    assert wanted <= held, sorted(wanted - held)
    assert not [name for name in held if name.startswith(ROOMS)]


def test_type_checkers_see_every_module_and_none_is_too_long():
    """`.types/eitskin` links to every file of the shared package and to every room."""
    links = {path.name: path.resolve() for path in (ROOT / ".types" / "eitskin").iterdir()}
    shared = {path.name: path for path in (ROOT / "eitskin").iterdir() if path.is_file()}
    assert links == shared | {room: ROOT / room for room in ROOMS}
    modules = [path for folder in (*FOLDERS, "tests") for path in (ROOT / folder).rglob("*.py")]
    assert len(modules) > 300
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules}
    most = {path: 505 if path.is_relative_to(ROOT / "tests") else 490 for path in lines}
    assert {path.name: count for path, count in lines.items() if count > most[path]} == {}


def test_imports_load_only_the_packages_that_they_need() -> None:
    """Modules in memory after each step of one process: rooms load nothing, torch comes last."""
    told = "import sys; print(*sys.modules)"
    code = "\n".join(f"{step}; {told}" for step in STEPS.values())
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    loaded = {step: set(line.split()) for step, line in zip(STEPS, lines, strict=True)}
    assert {name for name in loaded["eitskin"] if name.startswith("eitskin.")} == {"eitskin.extras"}
    heavy = HEAVY | {"numpy", "scipy", "skfem", "msgspec", "typer"}
    assert not loaded["rooms"] & heavy
    assert loaded["frames"] & {"scipy", "skfem", "numpy"} == {"numpy"}
    assert not loaded["simulator"] & HEAVY
    assert "torch" not in loaded["scenes"]
    assert not loaded["datasets"] & {"torch", "dask"}


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


def test_modules_import_only_what_is_installed_without_extras() -> None:
    """Packages that others happen to bring along may go: a new typer no longer brings click."""
    given, own = packages_distributions(), {"eitskin", *sys.stdlib_module_names}
    allowed = distributions()
    for path in (path for room in FOLDERS[:-1] for path in (ROOT / room).rglob("*.py")):
        for name in imported_at_the_top(path) - own - LAZY:
            found = {each.lower().replace("_", "-") for each in given.get(name, [name])}
            assert found & allowed, f"{path.relative_to(ROOT)} imports {name}"


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
