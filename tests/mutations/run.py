"""Break core formulas one at a time in a copy of the tree, and see that tests fail.

    python tests/mutations/run.py [--jobs 2] [--only WORDS ...]

What is broken, and by which tests it must be noticed, is listed in `mutations.toml`. A mutation
survives where these pass all the same; then a test is missing.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

ROOT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("mutations.toml")
ROOMS = ("geometry", "simulator", "datasets", "training", "hardware", "cli", "benchmarks")
FOLDERS = (".types", "eitskin", *ROOMS, "tests")
PASSED, FAILED = 0, 1  # exit codes of pytest; others mean that nothing was tested
WORDS = {FAILED: "killed", PASSED: "SURVIVED"}


@dataclass(frozen=True, slots=True)
class Mutation:
    """One wrong formula.

    Attributes:
        what: is wrong with it.
        file: that it is in, from the root of the tree.
        old, new: text that is there once, and what takes its place.
        tests: files in `tests`, or single tests of theirs, of which one must fail.
    """

    what: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    def applied(self, root: Path = ROOT) -> str:
        """The file's text with the mutation; raises ValueError where `old` is not there once."""
        text = (root / self.file).read_text(encoding="utf-8")
        if (count := text.count(self.old)) != 1:
            raise ValueError(
                f"{self.what}: expected {self.old!r} once in {self.file}, found it {count} times; "
                f"mend the entry in {LIST.name}"
            )
        return text.replace(self.old, self.new)


def listed() -> list[Mutation]:
    """All mutations of the list."""
    entries = tomllib.loads(LIST.read_text(encoding="utf-8"))["mutations"]
    return [Mutation(**entry | {"tests": tuple(entry["tests"])}) for entry in entries]


def copied(folder: Path) -> Path:
    """A copy of the tree in `folder`, whose packages are imported from there."""
    ignored = shutil.ignore_patterns("__pycache__", ".pytest_cache")
    for name in FOLDERS:
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def tested(tree: Path, tests: Sequence[str]) -> int:
    """Exit code of pytest for `tests` of a copied tree; presses are solved anew."""
    cache = tree / ".kernels"
    shutil.rmtree(cache, ignore_errors=True)
    environment = os.environ | {
        "EITSKIN_CACHE": str(cache),
        "PYTHONPATH": os.pathsep.join([str(tree / ".types"), str(tree / "tests")]),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    # -P: the copy's own eitskin/, which has no rooms, must not come before .types.
    command = [sys.executable, "-P", "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    paths = [f"tests/{test}" for test in tests]
    done = subprocess.run(
        [*command, *paths], cwd=tree, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode not in (PASSED, FAILED):
        print(done.stdout[-2000:], done.stderr[-2000:], sep="\n")  # noqa: T201
    return done.returncode


def broken(tree: Path, mutation: Mutation) -> int:
    """Exit code of the mutation's tests while it is in the tree."""
    path = tree / mutation.file
    sound = path.read_text(encoding="utf-8")
    try:
        _write(path, mutation.applied(tree))
        return tested(tree, mutation.tests)
    finally:
        _write(path, sound)


def _write(path: Path, text: str) -> None:
    """Write a module; what was compiled of it may look as young and as long."""
    path.write_text(text, encoding="utf-8")
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        compiled.unlink()


def main() -> int:
    """Run the list; 1 where a mutation survives, 2 where one could not be tried."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=2, help="how many are tried at once")
    parser.add_argument("--only", nargs="*", default=[""], help="words of what is to be tried")
    options = parser.parse_args()
    mutations = [each for each in listed() if any(words in each.what for words in options.only)]
    for mutation in mutations:
        mutation.applied()
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutations-") as temporary:
        trees: Queue[Path] = Queue()
        for number in range(options.jobs):
            trees.put(copied(Path(temporary) / str(number)))

        def tried(mutation: Mutation | None) -> int:
            tree = trees.get()
            try:
                if mutation is None:
                    return tested(tree, sorted({test for m in mutations for test in m.tests}))
                code = broken(tree, mutation)
                word = WORDS.get(code, "NOT TRIED")
                print(f"{word:9} {mutation.file}: {mutation.what}", flush=True)  # noqa: T201
                return code
            finally:
                trees.put(tree)

        with ThreadPoolExecutor(options.jobs) as pool:
            *codes, sound = pool.map(tried, [*mutations, None])
    killed, seconds = codes.count(FAILED), time.monotonic() - began
    print(f"{killed} of {len(codes)} mutations killed in {seconds:.0f} s")  # noqa: T201
    if sound != PASSED:
        print("the tests fail without any mutation: nothing is proved")  # noqa: T201
    if sound != PASSED or any(code not in WORDS for code in codes):
        return 2
    return 0 if killed == len(codes) else 1


if __name__ == "__main__":
    sys.exit(main())
