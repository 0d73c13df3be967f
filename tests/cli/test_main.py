"""The command line itself: version, completion, and what is loaded before a command runs."""

import os
import subprocess
import sys
from importlib.metadata import version

import pytest

HEAVY = {"h5py", "matplotlib", "numpy", "pyvista", "scipy", "serial", "skfem", "torch"}


def eitskin(*arguments, **environment):
    command = [sys.executable, "-m", "eitskin", *arguments]
    return subprocess.run(
        command, env=os.environ | environment, capture_output=True, text=True, check=True
    ).stdout


def test_version():
    assert eitskin("--version") == f"eitskin {version('eitskin')}\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "expected"),
    [("eitskin si", {"simulate"}), ("eitskin simulate --se", {"--sensor", "--seed"})],
)
def test_bash_completes_commands_and_options(words, expected):
    code = "import sys; sys.argv[0] = 'eitskin'; from eitskin.cli.main import run; run()"
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    said = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | asked | {"_EITSKIN_COMPLETE": "complete_bash"},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    ).stdout
    assert set(said.split()) == expected


@pytest.mark.slow
def test_heavy_packages_are_loaded_by_commands_only():
    code = "import sys, eitskin.cli.main; print(*{name.partition('.')[0] for name in sys.modules})"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert HEAVY.isdisjoint(loaded)
