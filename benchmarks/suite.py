"""Suite of all benchmarks, run one after the other: `eitskin bench all`."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from eitskin.benchmarks.results import RESULTS, read_results
from eitskin.geometry import ConfigurationError, DataError

EITSKIN = (sys.executable, "-c", "from eitskin.cli.main import run; run()")
Start = Callable[[Sequence[str]], int]
"""Runs a command and gives its exit status."""
LONG = 10.0
"""Minutes beyond which a benchmark is left out, unless long ones are asked for."""


@dataclass(frozen=True, slots=True)
class Benchmark:
    """Benchmark of the suite: a command of `eitskin bench`.

    Attributes:
        name: name of the command, and of the folder of its results.
        minutes: minutes that all of it takes, by estimate; decides which are long.
        options: besides the seed; `{out}` stands for the folder of all results,
            `{data}` for that of real recordings.
        seeded: whether it takes a seed.
        needs: a path without which it cannot run, with the same stand-ins.
    """

    name: str
    minutes: float
    options: tuple[str, ...] = ("--out", "{out}")
    seeded: bool = False
    needs: str = ""

    @property
    def long(self) -> bool:
        """Whether the benchmark takes so long that it runs only on request."""
        return self.minutes > LONG

    def arguments(self, places: Mapping[str, str], seed: int, quick: bool) -> list[str]:
        """Arguments after `eitskin`."""
        arguments = [part.format_map(places) for part in self.options]
        seeds = ["--seed", str(seed)] if self.seeded else []
        return ["bench", self.name, *seeds, *arguments, *(["--quick"] if quick else [])]


ALL = (
    Benchmark("accuracy", 3, seeded=True),
    Benchmark("stability", 6, seeded=True),
    Benchmark("world", 8, seeded=True),
    Benchmark("speed", 5, seeded=True),
    Benchmark("paper", 40, ("--out", "{out}", "--seeds", "2", "--paper-seeds", "1")),
    Benchmark("recordings", 8, ("{data}", "--out", "{out}"), needs="{data}/ohmc8.mat"),
    Benchmark("tank", 10, ("{data}/KTC2023", "--out", "{out}"), needs="{data}/KTC2023"),
    Benchmark("transfer", 8, seeded=True),
    Benchmark("life", 8, seeded=True),
    Benchmark("methods", 10, seeded=True),
    Benchmark("layouts", 15),
)


def select_benchmarks(only: Sequence[str] | None, long: bool) -> list[Benchmark]:
    """Benchmarks by name, or all except long ones; raises ConfigurationError for other names."""
    names = [each.name for each in ALL]
    for name in only or ():
        if name not in names:
            raise ConfigurationError(f"no benchmark {name!r}; there are: {', '.join(names)}")
    return [each for each in ALL if (each.name in only if only else long or not each.long)]


@dataclass(frozen=True, slots=True)
class CompletedBenchmark:
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
) -> Iterator[CompletedBenchmark]:
    """Run benchmarks in turn, each in a process of its own, and go on after one that failed.

    Results in `out` of the same version and, where one is taken, seed, are kept unless `fresh`.
    `data` is the folder of real recordings; `start` runs a command, a process when omitted.
    """
    for each in benchmarks:
        places = {"out": str(out.absolute()), "data": str(data and data.absolute())}
        needs, path = each.needs.format_map(places), out / each.name / RESULTS
        if not fresh and _is_there(path, seed if each.seeded else None, quick):
            yield CompletedBenchmark(each.name, "kept", "the same version and seed")
        elif "{data}" in each.needs and data is None:
            yield CompletedBenchmark(
                each.name, "left out", "needs real recordings; give their folder as --data"
            )
        elif needs and not Path(needs).exists():
            yield CompletedBenchmark(each.name, "left out", f"needs {needs}")
        else:
            began = time.perf_counter()
            status = (start or run_process)([*EITSKIN, *each.arguments(places, seed, quick)])
            why = f"exit status {status}" if status else ""
            outcome = "failed" if why else "measured"
            yield CompletedBenchmark(each.name, outcome, why, time.perf_counter() - began)


def run_process(command: Sequence[str]) -> int:
    """Run a command until it ends."""
    return subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode  # noqa: S603


def _is_there(path: Path, seed: int | None, quick: bool) -> bool:
    """Whether a file has the results that a run would give again."""
    try:
        return path.is_file() and read_results(path).answers(seed, quick)
    except DataError:
        return False
