"""Packaging: the wheel has every module, and imports load no heavy package needlessly."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("geometry", "simulator", "datasets", "training", "hardware", "cli", "benchmarks")
FOLDERS = ("eitskin", *ROOMS)
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


@pytest.mark.slow
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


def test_type_checkers_see_every_module() -> None:
    """`.types/eitskin` links to every file of the shared package and to every room."""
    links = {path.name: path.resolve() for path in (ROOT / ".types" / "eitskin").iterdir()}
    shared = {path.name: path for path in (ROOT / "eitskin").iterdir() if path.is_file()}
    assert links == shared | {room: ROOT / room for room in ROOMS}


@pytest.mark.slow
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


def test_no_module_is_too_long() -> None:
    modules = [path for folder in (*FOLDERS, "tests") for path in (ROOT / folder).rglob("*.py")]
    assert len(modules) > 300
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules}
    most = {path: 505 if path.is_relative_to(ROOT / "tests") else 475 for path in lines}
    assert {path.name: count for path, count in lines.items() if count > most[path]} == {}
