"""Wrong options of every command and wrong arguments of every public name, drawn by a seed.

Each is taken, or refused by one error of the package; anything else (a raw exception, an endless
loop, an open file or a thread that stays) fails with the number of its trial. The environment
variable EITSKIN_TRIALS asks for more trials than the few of the suite.
"""

import functools
import os
import random
import shlex
import shutil
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
import typer
import wrong_arguments
from typer.testing import CliRunner

from eitskin.cli.main import app
from eitskin.datasets import save_dataset
from eitskin.errors import EitskinError
from eitskin.geometry import SensorDesign

import small_dataset

pytestmark = pytest.mark.slow

MAX_SECONDS = 60  # of processor time of a trial
MAX_LEFT = 40  # files and threads that all trials leave behind
TEXTS = (
    *("", " ", "a" * 300, "\0", "\x1b[2J", "\u202e", "1" * 5000, "9" * 20, "a b"),
    *"- -- ../.. /proc/self/mem -5 1e400 nan inf 0 0.5 x:y : ::1 [ $(id)".split(),  # noqa: SIM905
    *"pairwise:8 adjacent:1e9 coarse true {} 0-4 1,2,3 virtual:?seed=-5 set none".split(),  # noqa: SIM905
)
SOUND = {
    "scene": "scene.toml",
    "recipe": "quick",
    "model": "reference.eitmodel",
    "files": "log.csv",
    "design": "design.toml",
    "--board": "virtual:?speed=max&seed=1",
    "--out": "new",
}
ENDLESS = ("bench", "demo", "virtual-board")  # commands that do not end soon by themselves
SERVING = ("--page", "--page-port", "--page-host", "--page-folder", "--ros2", "--picture")


@functools.cache
def commands():
    """Words and parameters of every command that ends by itself."""
    found = []

    def walk(command, words):
        for name, inner in getattr(command, "commands", {}).items():
            walk(inner, (*words, name))
        if not hasattr(command, "commands") and words[0] not in ENDLESS:
            found.append((words, command.params))

    walk(typer.main.get_command(app), ())
    return found


def options(rng, folder):
    """Run a command with wrong values of its options."""
    words, parameters = rng.choice(commands())
    line = list(words)
    for parameter in parameters:
        name = parameter.opts[0]
        if name.startswith("--") and name not in ("--out", "--board") and rng.random() < 0.75:
            continue
        if name in SERVING:
            continue
        value = rng.choice(TEXTS) if rng.random() < 0.4 else SOUND.get(name, "set")
        if getattr(parameter, "is_flag", False) or "bool" in str(getattr(parameter, "type", "")):
            line.append(name)
        elif name.startswith("-"):
            line += [name, value]
        else:
            line.append(value)
    if words[0] in ("live", "check", "tare", "reconstruct") and "--frames" not in line:
        line += ["--frames", "2"]
    if words == ("generate",):
        line.append("--dry-run")
    error = CliRunner().invoke(app, line, input="").exception
    # An error that names its file is answered by eitskin.cli.entry.
    named = isinstance(error, OSError) and error.filename is not None
    if not (error is None or named or isinstance(error, EitskinError | SystemExit | ImportError)):
        error.add_note(shlex.join(line)[:600])
        raise error
    shutil.rmtree(folder / "new", ignore_errors=True)
    (folder / "new").unlink(missing_ok=True)


def left():
    """Numbers of threads and of open files."""
    return np.array([threading.active_count(), len(list(Path("/dev/fd").iterdir()))])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The files that trials name, and work beside them."""
    save_dataset(small_dataset.make(6, status=np.zeros((6, 28))), tmp_path / "set")
    SensorDesign.reference().to_toml(tmp_path / "design.toml")
    (tmp_path / "scene.toml").write_text("[[touches]]\nx = 0.05\ny = 0.02\n")
    (tmp_path / "log.csv").write_text("v0,v1,x,y\n" + "1,2,0.01,0.02\n" * 12)
    monkeypatch.chdir(tmp_path)
    signal.signal(signal.SIGPROF, signal.default_int_handler)
    yield tmp_path
    signal.setitimer(signal.ITIMER_PROF, 0)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "attack", "trials"),
    [("options", options, 20), ("arguments", wrong_arguments.attack, 60)],
)
def test_wrong_options_and_arguments_are_taken_or_refused(name, attack, trials, folder):
    before = left()
    for number in range(int(os.environ.get("EITSKIN_TRIALS", trials))):
        signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)
        try:
            attack(random.Random(f"{name} 0 {number}"), folder)
        except (Exception, KeyboardInterrupt) as error:
            error.add_note(f"trial {number}")
            raise
    assert (left() - before).max() < MAX_LEFT
