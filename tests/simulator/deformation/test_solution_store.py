"""Store of solutions: solved by one process, whatever others do meanwhile, and kept whole."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from eitskin.errors import PartialError
from eitskin.simulator.deformation import solution_store as store
from eitskin.simulator.deformation.solution_store import Problem, load_or_solve, processes

# Asks for a solution; says `looked` when it has looked for the file, and `solving`, and solves when
# a line comes.
ASKER = """
import sys
import numpy as np
from eitskin.simulator.deformation import solution_store as store

def solve(_):
    print("solving", flush=True)
    sys.stdin.readline()
    return {"x": np.array([float(sys.argv[1])])}
load = store._load
def looking(path, make):
    found = load(path, make)
    if path.parent == store.cache_folder():
        print("looked", flush=True)
    return found
store._load = looking
print(float(store.load_or_solve(store.Problem("kept", {}, solve), dict)["x"][0]), flush=True)
"""


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("EITSKIN_CACHE", str(tmp_path))
    return tmp_path


@pytest.fixture
def ask(cache):  # noqa: ARG001
    """Function that starts a process which asks for one solution, and would find a number."""
    started = []

    def start(number):
        command = [sys.executable, "-P", "-c", ASKER, str(number)]
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


def test_when_the_one_that_solves_is_killed_another_solves(ask) -> None:
    first = ask(1)
    assert said(first, 2) == ["looked", "solving"]
    second = ask(2)
    os.kill(first.pid, signal.SIGKILL)
    assert said(second, 2) == ["looked", "solving"]
    go_on(second)
    assert said(second, 1) == ["2.0"]


def test_another_waits_for_the_one_that_solves_and_takes_its_solution(ask) -> None:
    first = ask(1)
    assert said(first, 2) == ["looked", "solving"]
    second = ask(2)
    go_on(first)
    assert said(first, 1) == ["1.0"]
    assert said(second, 2) == ["looked", "1.0"]


def problem(values, **description) -> Problem:
    return Problem("kept", description, lambda _: {"x": np.asarray(values)})


def test_a_folder_that_cannot_be_written_lets_each_solve(cache, monkeypatch) -> None:
    (cache / "file").write_text("")
    monkeypatch.setenv("EITSKIN_CACHE", str(cache / "file"))
    assert load_or_solve(problem([1.0, 1.0]), dict)["x"].tolist() == [1.0, 1.0]
    assert load_or_solve(problem([2.0]), dict)["x"].tolist() == [2.0]


def test_a_failed_solution_leaves_no_file_and_no_lock(cache) -> None:
    def fail(_):
        raise ValueError("no equilibrium")

    for _ in range(2):
        with pytest.raises(ValueError, match="no equilibrium"):
            load_or_solve(Problem("kept", {}, fail), dict)
    assert not [*cache.iterdir()]


@pytest.mark.usefixtures("cache")
def test_arrays_are_read_back_bit_by_bit() -> None:
    arrays = [np.array(0.1), np.arange(300.0).reshape(20, 15), np.zeros((0, 3))]
    arrays += [np.linspace(0, 1, 7, dtype=np.float32), np.arange(12).reshape(3, 4)]
    for number, values in enumerate(arrays):
        load_or_solve(problem(values, number=number), dict)
        found = load_or_solve(problem(None, number=number), dict)["x"]
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found, values)


def test_a_damaged_file_is_solved_again(cache) -> None:
    load_or_solve(problem(np.arange(300.0)), dict)
    (path,) = cache.glob("*.npz")
    good, found = path.read_bytes(), []
    for place in range(0, len(good), 5):
        path.write_bytes(good[:place] + bytes([good[place] ^ 0x55]) + good[place + 1 :])
        found.append(store._read(path))
    assert found.count(None) > len(found) // 2
    path.write_bytes(good[: len(good) // 2])
    assert load_or_solve(problem(np.ones(2)), dict)["x"].tolist() == [1.0, 1.0]
    path.unlink()
    os.mkfifo(path)
    assert load_or_solve(problem(np.ones(2)), dict)["x"].tolist() == [1.0, 1.0]
    assert path.is_file()


def test_everything_missing_is_solved_once_and_reported(cache) -> None:
    problems, reports = [problem([n], number=n) for n in (1.0, 2.0, 1.0)], []

    def solve(report):
        for part in (1, 2):
            report(part, 2)
        return {}

    problems.append(Problem("parts", {}, solve))
    same = {problem([], a=a).name for a in (1.0, 1.0 + 1e-12, 1.0 + 1e-8, "one", {"b": 1.0})}
    assert len(same) == 4  # by nine digits
    store.prepare(problems, lambda *done: reports.append(done))
    assert reports == [(5, 6), (6, 6)]
    assert store.missing(problems) == {}
    assert len(list(cache.glob("*.npz"))) == 3
    store.prepare(problems, lambda *_: pytest.fail("nothing is missing"))


def test_a_process_that_dies_is_reported_in_words() -> None:
    with pytest.raises(PartialError, match=r"__main__"), processes(2) as run:
        list(run(os._exit, [1]))
