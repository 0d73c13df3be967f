"""What is installed: every module of the tree, and nothing heavy where it is not needed."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("geometry", "simulator", "datasets", "training", "hardware", "cli", "benchmarks")
HEAVY = (
    "torch",
    "pyvista",
    "matplotlib",
    "serial",
    "sklearn",
    "skimage",
    "safetensors",
    "h5py",
    "trimesh",
    "pytetwild",
    "pyeit",
)


def test_the_wheel_holds_every_module_of_the_tree(tmp_path) -> None:
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path)]
    done = subprocess.run([*build, str(ROOT)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    assert "eitskin/training/reference.eitmodel/weights.safetensors" in held
    wanted = {
        f"eitskin/{path.relative_to(ROOT).as_posix()}"
        for folder in FOLDERS
        for pattern in ("*.py", "py.typed", "*/*.toml", "firmware/*.[ch]", "web/*")
        for path in (ROOT / folder).glob(pattern)
    }
    assert len(wanted) > 30
    assert wanted <= held, sorted(wanted - held)
    assert not [name for name in held if name.startswith(FOLDERS)]


@pytest.mark.parametrize("package", ["eitskin.geometry", "eitskin.simulator"])
def test_the_simulator_loads_no_heavy_package(package) -> None:
    code = f"import {package}, sys; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_missing_extra_is_named() -> None:
    from eitskin.geometry.optional import require

    with pytest.raises(ImportError, match=r"pip install 'eitskin\[view\]'"):
        require("a_package_that_is_not_there", "view")
