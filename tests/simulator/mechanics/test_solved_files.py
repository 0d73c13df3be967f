"""Files of solutions: solved by one process, whatever others do meanwhile."""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from eitskin.simulator.mechanics import solved_files

pytest.importorskip("fcntl", reason="locks of files are those of POSIX")

# Asks for the solution in argv[1]; says `looked` whenever it has looked for the file, and
# `solving`, and solves when a line comes.
ASKER = """
import sys
from functools import partial
from pathlib import Path
import numpy as np
from eitskin.simulator.mechanics import solved_files

path = Path(sys.argv[1])
def solve():
    print("solving", flush=True)
    sys.stdin.readline()
    return {"x": np.array([float(sys.argv[2])])}
def read():
    found = solved_files.read(path)
    print("looked", flush=True)
    return found
write = partial(solved_files.write, path)
print(float(solved_files.kept(path, read, solve, write)["x"][0]), flush=True)
"""


@pytest.fixture
def ask(tmp_path):
    """Function that starts a process which asks for one solution, and would find a number."""
    started = []

    def start(number):
        path = tmp_path / "kept.npz"
        command = [sys.executable, "-P", "-c", ASKER, str(path), str(number)]
        pipe = subprocess.PIPE
        started.append(subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True))
        assert started[-1].stdout.readline() == "looked\n"
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def said(process, lines):
    return [process.stdout.readline().strip() for _ in range(lines)]


def go_on(process):
    process.stdin.write("\n")
    process.stdin.flush()


def test_others_wait_for_the_one_that_solves(ask, tmp_path) -> None:
    first = ask(1)
    assert said(first, 2) == ["looked", "solving"]
    second = ask(2)
    go_on(first)
    assert said(first, 1) == ["1.0"]
    assert said(second, 2) == ["looked", "1.0"]
    assert {path.name for path in tmp_path.iterdir()} == {"kept.npz"}


def test_when_the_one_that_solves_is_killed_another_solves(ask) -> None:
    first = ask(1)
    assert said(first, 2) == ["looked", "solving"]
    second = ask(2)
    os.kill(first.pid, signal.SIGKILL)
    assert said(second, 2) == ["looked", "solving"]
    go_on(second)
    assert said(second, 1) == ["2.0"]


def test_a_folder_that_cannot_be_written_lets_each_solve(tmp_path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    path = blocked / "kept.npz"
    found = solved_files.kept(
        path,
        partial(solved_files.read, path),
        lambda: {"x": np.ones(2)},
        partial(solved_files.write, path),
    )
    assert found["x"].tolist() == [1.0, 1.0]
    assert not Path(path).exists()


def test_a_failed_solution_leaves_no_lock(tmp_path) -> None:
    path = tmp_path / "kept.npz"

    def fail():
        raise ValueError("no equilibrium")

    for _ in range(2):
        with pytest.raises(ValueError, match="no equilibrium"):
            solved_files.kept(path, lambda: None, fail, lambda _: None)
    assert not list(tmp_path.iterdir())


def test_a_damaged_file_is_solved_again(tmp_path) -> None:
    path = tmp_path / "kept.npz"
    solved_files.write(path, {"x": np.arange(300.0)})
    good = path.read_bytes()
    found = []
    for place in range(0, len(good), 5):
        path.write_bytes(good[:place] + bytes([good[place] ^ 0x55]) + good[place + 1 :])
        found.append(solved_files.read(path))
    assert found.count(None) > len(found) // 2
    assert all(each is None or set(each) <= {"x"} for each in found)
