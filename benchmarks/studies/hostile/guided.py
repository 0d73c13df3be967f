"""Coverage-guided trials of a parser: `python -m eitskin.benchmarks.studies.hostile.guided`.

Inputs are changed as in the other trials, and those that reach lines or branches of the program
that none has reached are kept and changed further. A run begins with the corpus of the tests,
`tests/data/hostile.zip`; with `--keep` the least inputs that reach as much are written there.
Needs `pip install atheris`; tried with version 3.0.0 and Python 3.11 on Linux.
"""

import argparse
import random
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

CORPUS = Path("tests/data/hostile.zip")
LONGEST = 40_000  # bytes of an input
KEPT = 25  # inputs of a kind in the corpus
KEPT_BYTES = 8_000  # of one of these
MODULE = "eitskin.benchmarks.studies.hostile.guided"


def main() -> None:
    """Try one kind, or all in turn, in processes of their own; exit code 1 after a failure."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--only", default="", help="kind, or its beginning")
    arguments.add_argument("--seconds", type=int, default=60, help="for each kind")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--corpus", type=Path, default=CORPUS)
    arguments.add_argument("--keep", action="store_true", help="write what was found to the corpus")
    arguments.add_argument("--in", dest="folder", type=Path, help=argparse.SUPPRESS)
    given, options = arguments.parse_known_args()
    if given.folder:
        guided(given.only, given.folder, options)
        return
    try:
        import atheris  # noqa: F401
    except ImportError:
        print("guided trials are left out, they need atheris: pip install atheris")
        return
    from eitskin.benchmarks.studies.hostile.parsers import PARSERS

    failed = [kind for kind in PARSERS if kind.startswith(given.only) and not _tried(kind, given)]
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


def _tried(kind: str, given: argparse.Namespace) -> bool:
    """Whether all inputs of a kind were read or refused; the one that was not is printed."""
    with tempfile.TemporaryDirectory() as place:
        found, failures = Path(place) / "found", Path(place) / "failure-"
        found.mkdir()
        for number, content in enumerate(seeds(kind, given.corpus)):
            (found / f"{number}").write_bytes(content)
        command = [sys.executable, "-m", MODULE, "--only", kind, "--in", place]
        limits = [f"-max_total_time={given.seconds}", f"-seed={given.seed}", "-timeout=60"]
        options = [*limits, f"-max_len={LONGEST}", "-print_final_stats=1", "-rss_limit_mb=2000"]
        run = subprocess.run(  # noqa: S603 - this module
            [*command, *options, f"-artifact_prefix={failures}", str(found)],
            stderr=subprocess.PIPE,
            text=True,
            check=False,  # what failed is told below
        )
        tried = [line for line in run.stderr.splitlines() if "cov:" in line or "executed" in line]
        print(kind, *(" ".join(line.split()) for line in tried[-2:]), sep="; ", flush=True)
        for failure in Path(place).glob(f"{failures.name}*"):
            print(run.stderr[-3000:], repr(failure.read_bytes()[:1000]), flush=True)
        if given.keep:
            keep(kind, given.corpus, least(kind, found, Path(place)))
        return run.returncode == 0


def guided(kind: str, folder: Path, options: list[str]) -> None:
    """Try inputs of a kind in this process, until libFuzzer ends it."""
    import atheris

    with atheris.instrument_imports(include=["eitskin", "tomllib"]):
        from eitskin.benchmarks.studies.hostile.mutations import damaged, misworded
        from eitskin.benchmarks.studies.hostile.parsers import PARSERS
        from eitskin.errors import EitskinError

    parser = PARSERS[kind]

    def one(content: bytes) -> None:
        with suppress(EitskinError):
            parser.parse(content, folder)

    def changed(content: bytes, most: int, seed: int) -> bytes:
        rng = random.Random(seed)  # noqa: S311
        if rng.random() < 0.5:
            made: bytes = atheris.Mutate(content, most)
            return made
        if parser.name.endswith(".bin"):
            return damaged(rng, content)[:most]
        return misworded(rng, content.decode(errors="replace")).encode()[:most]

    atheris.Setup([sys.argv[0], *options], one, custom_mutator=changed)
    atheris.Fuzz()


def least(kind: str, found: Path, folder: Path) -> list[bytes]:
    """The smallest inputs of those found that reach all lines of eitskin that these reach."""
    from eitskin.benchmarks.studies.hostile.parsers import PARSERS

    contents = sorted((each.read_bytes() for each in found.iterdir()), key=len)
    reached: set[tuple[Any, int]] = set()
    chosen = []
    for content in contents:
        if len(content) <= KEPT_BYTES:
            before = len(reached)
            with _lines(reached), suppress(Exception):
                PARSERS[kind].parse(content, folder)
            if len(reached) > before:
                chosen.append(content)
    return chosen[-KEPT:]


@contextmanager
def _lines(reached: set[tuple[Any, int]]) -> Iterator[None]:
    """Add the lines of eitskin that this process comes by to a set."""

    def line(frame: Any, event: str, _: Any) -> Any:
        if event == "line":
            reached.add((frame.f_code, frame.f_lineno))
        return line

    def call(frame: Any, *_: Any) -> Any:
        return line if str(frame.f_globals.get("__name__")).startswith("eitskin.") else None

    sys.settrace(call)
    try:
        yield
    finally:
        sys.settrace(None)


def seeds(kind: str, corpus: Path) -> list[bytes]:
    """Good inputs of a kind, and those of the corpus."""
    from eitskin.benchmarks.studies.hostile.parsers import PARSERS

    return [*PARSERS[kind].good(), *(kept(corpus).get(kind, []))]


def kept(corpus: Path) -> dict[str, list[bytes]]:
    """Inputs of a corpus by kind; none where there is no such file."""
    found: dict[str, list[bytes]] = {}
    if corpus.is_file():
        with zipfile.ZipFile(corpus) as file:
            for name in file.namelist():
                found.setdefault(name.rpartition("/")[0], []).append(file.read(name))
    return found


def keep(kind: str, corpus: Path, inputs: list[bytes]) -> None:
    """Write the smallest inputs of a kind to the corpus, in which the others stay."""
    everything: dict[str, Any] = kept(corpus) | {kind: inputs}
    with zipfile.ZipFile(corpus, "w", zipfile.ZIP_DEFLATED) as file:
        for each, contents in sorted(everything.items()):
            for number, content in enumerate(contents):
                file.writestr(zipfile.ZipInfo(f"{each}/{number}"), content, zipfile.ZIP_DEFLATED)


if __name__ == "__main__":
    main()
