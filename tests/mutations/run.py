"""Break formulas one at a time in a copy of the tree, and see that tests fail.

    python tests/mutations/run.py [--seed 0] [--jobs 2] [--only WORDS ...]

`bugs.toml` lists a few bugs with the test that must notice each. Wrong formulas are drawn by a seed
(`drawing.py`); the tests that may notice these are those of the folder and those that name the
module. A mutation survives where these pass all the same: then a test is missing, or the mutation
changes nothing, which `equivalent.toml` explains.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from mutations.drawing import Drawn, draw  # noqa: E402

BUGS = Path(__file__).with_name("bugs.toml")
EQUIVALENT = Path(__file__).with_name("equivalent.toml")
ROOMS = ("geometry", "simulator", "datasets", "training", "hardware", "cli", "benchmarks")
FOLDERS = (".types", "eitskin", *ROOMS, "docs", "tests")
FILES = ("pyproject.toml", "README.md", "CHANGELOG.md", "Makefile")  # that tests read, too
PASSED, FAILED, NO_TESTS = 0, 1, 5  # exit codes of pytest; others mean that nothing was tested
WORDS = {FAILED: "killed", PASSED: "SURVIVED"}
MAX_SECONDS = 300, 3600  # for one test, and for all of a pass: those that hang have failed
# Marks of tests that run in turn, and EITSKIN_PLAIN: to compile takes longer than quick tests.
PASSES = (("not slow", "1"), ("not slow", ""), ("slow", ""))
SOLVERS = ("geometry", "simulator")  # rooms that solutions of presses depend on
WRONG = "wrong"  # folder of their solutions


@dataclass(frozen=True, slots=True)
class Mutation:
    """One wrong formula.

    Attributes:
        what: is wrong with it.
        file: that it is in, from the root of the tree.
        text: of the file with it.
        tests: files in `tests`, or single tests of theirs, of which one must fail.
    """

    what: str
    file: str
    text: str
    tests: tuple[str, ...]


def listed_bugs() -> list[Mutation]:
    """The bugs of the list; raises ValueError where the text of one is not there once."""
    return [_listed(**entry) for entry in _entries(BUGS, "bugs")]


def _listed(what: str, file: str, old: str, new: str, test: str) -> Mutation:
    text = (ROOT / file).read_text(encoding="utf-8")
    if (count := text.count(old)) != 1:
        raise ValueError(f"{what}: {old!r} is {count} times in {file}; mend {BUGS.name}")
    return Mutation(what, file, text.replace(old, new), (test,))


def _entries(path: Path, name: str) -> list[dict[str, Any]]:
    return list(tomllib.loads(path.read_text(encoding="utf-8"))[name])


def drawn_mutations(seed: int) -> list[Mutation]:
    """Mutations of a draw with the test files that may notice them."""
    explained = {(each["old"], each["new"]) for each in _entries(EQUIVALENT, "equivalent")}
    return [
        Mutation(each.what, each.file, each.text, _nearest(each))
        for each in draw(ROOT, seed)
        if (each.old, each.new) not in explained
    ]


def _nearest(drawn: Drawn) -> tuple[str, ...]:
    """Test files of the folder that mirrors the statement's, those that name its module first."""
    mirror = re.sub("^eitskin/", "shared/", drawn.file)
    folder, module = ROOT / "tests" / Path(mirror).parent, Path(mirror).stem
    while not (found := sorted(folder.glob("test_*.py"))):
        folder = folder.parent
    others = (ROOT / "tests" / Path(mirror).parts[0]).rglob("test_*.py")
    named = [path for path in sorted(others) if module in path.read_text(encoding="utf-8")]
    files = sorted(named, key=lambda path: path.parent != folder) + found
    return tuple(dict.fromkeys(str(path.relative_to(ROOT / "tests")) for path in files))


def copied(folder: Path) -> Path:
    """A copy of the tree in `folder`, whose packages are imported from there."""
    ignored = shutil.ignore_patterns("__pycache__", ".pytest_cache")
    for name in FOLDERS:
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=ignored)
    for name in FILES:
        shutil.copy(ROOT / name, folder)
    return folder


def tested(tree: Path, mutation: Mutation) -> int:
    """Exit code of pytest for the mutation's tests; a changed solver begins without solutions."""
    environment = os.environ | {
        "EITSKIN_CACHE": str(tree / (WRONG if mutation.file.startswith(SOLVERS) else "solved")),
        "PYTHONPATH": os.pathsep.join([str(tree / ".types"), str(tree / "tests")]),
    }
    # -P: the copy's own eitskin/, which has no rooms, must not come before .types.
    command = [sys.executable, "-P", "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += [f"--timeout={MAX_SECONDS[0]}", *(f"tests/{test}" for test in mutation.tests)]
    codes = []
    for which, plain in PASSES:
        try:
            done = subprocess.run(
                [*command, "-m", which],
                cwd=tree,
                env=environment | {"EITSKIN_PLAIN": plain},
                capture_output=True,
                text=True,
                check=False,
                timeout=MAX_SECONDS[1],
            )
        except subprocess.TimeoutExpired:
            return FAILED
        if done.returncode not in (PASSED, NO_TESTS):
            if done.returncode != FAILED:
                print(done.stdout[-2000:], done.stderr[-2000:], sep="\n")  # noqa: T201
            return done.returncode
        codes.append(done.returncode)
    return min(codes)  # with no test of either kind nothing was tested


def broken(tree: Path, mutation: Mutation) -> int:
    """Exit code of the mutation's tests while it is in the tree."""
    path = tree / mutation.file
    sound = path.read_text(encoding="utf-8")
    try:
        _write(path, mutation.text)
        return tested(tree, mutation)
    finally:
        _write(path, sound)
        shutil.rmtree(tree / WRONG, ignore_errors=True)


def _write(path: Path, text: str) -> None:
    """Write a module; what was compiled of it may look as young and as long."""
    path.write_text(text, encoding="utf-8")
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        compiled.unlink()


def main() -> int:
    """Try all; 1 where a mutation survives, 2 where one could not be tried."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=2, help="how many are tried at once")
    parser.add_argument("--only", nargs="*", default=[""], help="words of what is to be tried")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    options = parser.parse_args()
    mutations = [
        each
        for each in (*listed_bugs(), *drawn_mutations(options.seed))
        if any(words in f"{each.file}: {each.what}" for words in options.only)
    ]
    every = tuple(sorted({test for mutation in mutations for test in mutation.tests}))
    no_change = Mutation("nothing is wrong", FILES[0], (ROOT / FILES[0]).read_text(), every)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutations-") as temporary:
        trees: Queue[Path] = Queue()
        for number in range(options.jobs):
            trees.put(copied(Path(temporary) / str(number)))

        def tried(mutation: Mutation) -> int:
            tree = trees.get()
            try:
                code = broken(tree, mutation)
            finally:
                trees.put(tree)
            word = WORDS.get(code, "NOT TRIED")
            print(f"{word:9} {mutation.file}: {mutation.what}", flush=True)  # noqa: T201
            return code

        with ThreadPoolExecutor(options.jobs) as pool:
            *codes, sound = pool.map(tried, [*mutations, no_change])
    killed, seconds = codes.count(FAILED), time.monotonic() - began
    print(f"{killed} of {len(codes)} mutations killed in {seconds:.0f} s")  # noqa: T201
    if sound != PASSED:
        print("the tests fail without any mutation: nothing is proved")  # noqa: T201
    if sound != PASSED or any(code not in WORDS for code in codes):
        return 2
    return 0 if killed == len(codes) else 1


if __name__ == "__main__":
    sys.exit(main())
