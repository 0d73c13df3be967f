"""Suite of all benchmarks, run one after the other: `eitskin bench all`."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from eitskin.benchmarks.markdown_tables import figures
from eitskin.benchmarks.results import RESULTS, Results, read_results, write_results
from eitskin.datasets.store.folder import make_folder
from eitskin.errors import DataError
from eitskin.provenance import Provenance

EITSKIN = (sys.executable, "-c", "from eitskin.cli.main import run; run()")
Start = Callable[[Sequence[str]], int]
"""Runs a command and gives its exit status."""
LONG = 10.0
"""Minutes beyond which a benchmark is left out, unless long ones are asked for."""


@dataclass(frozen=True, slots=True)
class Benchmark:
    """Benchmark of the suite: a command of `eitskin bench`.

    Attributes:
        name: of the command, and of the folder of its results.
        minutes: that all of it takes, by estimate; decides which are long.
        options: besides the seed; `{out}` stands for the folder of all results, `{own}` for that of
            its own, `{data}` for that of real recordings.
        report: the file in its folder that it writes a report to, whose tables become results;
            empty where it writes results itself.
        seeded: whether it takes a seed.
        needs: a path without which it cannot run, with the same stand-ins.
    """

    name: str
    minutes: float
    options: tuple[str, ...] = ("--out", "{out}")
    report: str = ""
    seeded: bool = False
    needs: str = ""

    @property
    def long(self) -> bool:
        """Whether the benchmark takes so long that it runs only on request."""
        return self.minutes > LONG

    def arguments(self, places: Mapping[str, str], seed: int, quick: bool) -> list[str]:
        """Arguments after `eitskin`."""
        given = [part.format_map(places) for part in self.options]
        seeds = ["--seed", str(seed)] if self.seeded else []
        return ["bench", self.name, *seeds, *given, *(["--quick"] if quick else [])]


ALL = (
    Benchmark("accuracy", 3, seeded=True),
    Benchmark("stability", 6, seeded=True),
    Benchmark("world", 8, seeded=True),
    Benchmark("speed", 5, seeded=True),
    Benchmark("paper", 40, ("--out", "{out}", "--seeds", "2", "--paper-seeds", "1")),
    Benchmark("transfer", 8, seeded=True),
    Benchmark("layouts", 90, ("--out", "{own}"), report="layouts.md"),
)


@dataclass(frozen=True, slots=True)
class Done:
    """Outcome of one benchmark: "measured", "kept", "left out" or "failed", and why."""

    name: str
    outcome: str
    why: str = ""
    seconds: float = 0.0


def run_all(
    benchmarks: Sequence[Benchmark],
    out: Path,
    seed: int,
    *,
    quick: bool,
    fresh: bool,
    data: Path | None,
    start: "Start | None" = None,
) -> Iterator[Done]:
    """Run benchmarks in turn, each in a process of its own, and go on after one that failed.

    Args:
        benchmarks: which.
        out: folder of the results.
        seed: of those that take one.
        quick: fewer and smaller cases.
        fresh: run also what is there from the same version and, where one is taken, seed.
        data: folder of real recordings; None without.
        start: runs a command; in a process of its own when omitted.
    """
    for each in benchmarks:
        folder = (out / each.name).absolute()
        places = {
            "out": str(out.absolute()),
            "own": str(folder),
            "data": str(data and data.absolute()),
        }
        needs = each.needs.format_map(places)
        if not fresh and _is_there(folder / RESULTS, seed if each.seeded else None, quick):
            yield Done(each.name, "kept", "the same version and seed")
        elif "{data}" in each.needs and data is None:
            yield Done(each.name, "left out", "needs real recordings; give their folder as --data")
        elif needs and not Path(needs).exists():
            yield Done(each.name, "left out", f"needs {needs}")
        else:
            began = time.perf_counter()
            why = _run(each, places, seed, quick, start or run_process)
            outcome = "failed" if why else "measured"
            yield Done(each.name, outcome, why, time.perf_counter() - began)


def _run(each: Benchmark, places: Mapping[str, str], seed: int, quick: bool, start: Start) -> str:
    """Run one benchmark; returns the reason of a failure, or an empty text."""
    folder = Path(places["own"])
    make_folder(folder)
    began = time.perf_counter()
    status = start([*EITSKIN, *each.arguments(places, seed, quick)])
    if status:
        return f"exit status {status}"
    if not each.report:
        return ""
    found = figures((folder / each.report).read_text(encoding="utf-8"))
    if not found:
        return f"no figures in {folder / each.report}"
    said = {"out": "OUT", "own": f"OUT/{each.name}", "data": "DATA"}
    results = Results(
        name=each.name,
        command=" ".join(["eitskin", *each.arguments(said, seed, quick)]),
        provenance=Provenance.now(seed),
        seconds=time.perf_counter() - began,
        quick=quick,
        figures=found,
    )
    write_results(results, folder.parent)
    return ""


def run_process(command: Sequence[str]) -> int:
    """Run a command until it ends."""
    return subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode  # noqa: S603


def _is_there(path: Path, seed: int | None, quick: bool) -> bool:
    """Whether a file has the results that a run would give again."""
    try:
        return path.is_file() and read_results(path).answers(seed, quick)
    except DataError:
        return False
