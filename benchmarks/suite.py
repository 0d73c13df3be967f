"""Suite of all benchmarks, run one after the other: `eitskin bench all`.

Most commands of `eitskin bench` write their results themselves. The studies of a checkout,
`python -m eitskin.benchmarks.studies.FOLDER.NAME`, print a report in Markdown, whose tables become
results. An installed wheel has no studies: they are left out there, with the reason.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from eitskin.benchmarks.markdown_tables import figures
from eitskin.benchmarks.results import RESULTS, Results, read_results, write_results
from eitskin.datasets.store.folder import make_folder
from eitskin.errors import DataError
from eitskin.files import atomic_file
from eitskin.provenance import Provenance

EITSKIN = (sys.executable, "-c", "from eitskin.cli.main import run; run()")
REPORT = "report.md"
Start = Callable[[Sequence[str], Path | None], int]
"""Runs a command, its standard output into a file where one is given, and gives its exit status."""


@dataclass(frozen=True, slots=True)
class Benchmark:
    """Benchmark of the suite: a command or a study.

    Attributes:
        name: of the command or module, and of the folder of its results.
        folder: folder of `eitskin.benchmarks.studies` that has its module; empty for a command of
            `eitskin bench`.
        minutes: that all of it takes, by estimate; decides which are long.
        options: besides the seed; `{out}` stands for the folder of all results, `{own}` for that of
            its own, `{data}` for that of real recordings.
        quick: other options for a quick run; None where there is no quick one.
        report: the file in its folder that it writes a report to; empty where it prints one.
        own_results: whether it writes results itself.
        seeded: whether it takes a seed.
        needs: a path without which it cannot run, with the same stand-ins.
    """

    name: str
    folder: str
    minutes: float
    options: tuple[str, ...] = ()
    quick: tuple[str, ...] | None = None
    report: str = ""
    own_results: bool = False
    seeded: bool = False
    needs: str = ""

    @property
    def long(self) -> bool:
        """Whether the benchmark takes so long that it runs only on request."""
        return self.minutes > LONG

    def arguments(self, places: Mapping[str, str], seed: int, quick: bool) -> list[str]:
        """Arguments after `eitskin`, or after `python` for a module."""
        options = self.quick if quick else self.options
        given = [part.format_map(places) for part in options or ()]
        seeds = ["--seed", str(seed)] if self.seeded else []
        start = ["-m", self.module] if self.folder else ["bench", self.name]
        return [*start, *seeds, *given]

    @property
    def module(self) -> str:
        """Name of the module of a study; empty for a command."""
        return self.folder and f"eitskin.benchmarks.studies.{self.folder}.{self.name}"


def has_studies() -> bool:
    """Whether studies are installed: in a checkout, not in a wheel."""
    return find_spec("eitskin.benchmarks.studies") is not None


WHY_NOT = "studies are not in the wheel; run this in a checkout of the repository"
LONG = 10.0
"""Minutes beyond which a benchmark is left out, unless long ones are asked for."""
OUT, OWN = ("--out", "{out}"), ("--out", "{own}")


def _command(name: str, minutes: float, *options: str, seeded: bool = True) -> Benchmark:
    """Benchmark that is a command and writes its results itself."""
    return Benchmark(
        name=name,
        folder="",
        minutes=minutes,
        options=(*OUT, *options),
        quick=(*OUT, "--quick"),
        own_results=True,
        seeded=seeded,
    )


ALL = (
    _command("accuracy", 3),
    _command("stability", 6),
    _command("world", 8),
    _command("speed", 5),
    Benchmark("signals", "physics", 1, ("--pictures", "{own}"), ("--pictures", "{own}")),
    Benchmark("instrument", "boards", 1, (), ()),
    Benchmark("reanalysis", "physics", 1, (), ()),
    Benchmark("specimen_presses", "physics", 9),
    Benchmark("creep", "physics", 1, (), ()),
    Benchmark("cramer_rao", "physics", 3, OWN),
    Benchmark("bends", "physics", 8),
    Benchmark("electrodes", "physics", 6, (), ("coarse",)),
    Benchmark("tank", "data", 3, ("{data}",), needs="{data}/ktc2023_ref.mat"),
    Benchmark(
        "pictures",
        "data",
        3,
        (*OUT, "--tank", "{data}"),
        OUT,
        own_results=True,
        needs="{data}/ktc2023_ref.mat",
    ),
    Benchmark("round_skin", "boards", 3, ("{data}",), needs="{data}/ohmc8.mat"),
    Benchmark("twin", "data", 20, ("{data}",), needs="{data}/ohmc8.mat"),
    Benchmark(
        "adaptation",
        "data",
        8,
        ("{data}", *OUT),
        ("{data}", *OUT, "--draws", "1", "--counts", "5", "50"),
        own_results=True,
        needs="{data}/ohmc8.mat",
    ),
    Benchmark("twin_maps", "data", 3, ("{data}", *OUT), own_results=True, needs="{data}/ohmc8.mat"),
    Benchmark("recordings", "data", 1, ("{data}",), needs="{data}/ohmc8.mat"),
    Benchmark("recipes", "data", 6, OWN, (*OWN, "--frames", "10", "--only", "paper_demo")),
    Benchmark("sensor_check", "boards", 5, (), ("--specimens", "10", "--faulty", "2"), seeded=True),
    Benchmark("ros2_topics", "boards", 1, (), ("--frames", "40")),
    Benchmark("robots", "physics", 2, (), ("--presses", "4", "--seconds", "2"), seeded=True),
    Benchmark("live_rate", "boards", 4, (), ("--frames", "60"), seeded=True),
    Benchmark(
        "realtime",
        "boards",
        4,
        (*OWN, "--speed", "max"),
        (*OWN, "--speed", "max"),
        seeded=True,
    ),
    Benchmark(
        "board_fuzz", "boards", 14, (), ("--bytes", "100000", "--rounds", "1", "--cables", "3")
    ),
    _command("paper", 40, "--seeds", "2", "--paper-seeds", "1", seeded=False),
    _command("transfer", 8),
    Benchmark("twin_response", "data", 8, OUT, (*OUT, "--sensors", "1"), own_results=True),
    Benchmark(
        "methods",
        "data",
        10,
        OWN,
        (*OWN, "--frames", "300", "--specimens", "6", "--presets", "ridge"),
        seeded=True,
    ),
    Benchmark(
        "ablation", "data", 2, ("{out}/paper/seed-1/unseen-touch",), needs="{out}/paper/seed-1"
    ),
    Benchmark("session_starts", "data", 9, (), ("--specimens", "40", "--held-out", "4")),
    Benchmark("stored_references", "data", 4, (), ("--specimens", "2", "--mounted", "1")),
    Benchmark("large_sets", "data", 25, OWN, (*OWN, "--frames", "4000", "--shards", "40")),
    Benchmark("chains", "data", 20, OUT, own_results=True),
    Benchmark("layouts_trained", "layouts", 45, OUT, (*OUT, "--quick"), own_results=True),
    Benchmark("layouts", "", 90, OWN, (*OWN, "--quick"), report="layouts.md"),
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
        if each.folder and not has_studies():
            yield Done(each.name, "left out", WHY_NOT)
        elif quick and each.quick is None:
            yield Done(each.name, "left out", "there is no quick run of it")
        elif not fresh and _is_there(folder / RESULTS, seed if each.seeded else None, quick):
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
    program = EITSKIN[:1] if each.folder else EITSKIN
    command = [*program, *each.arguments(places, seed, quick)]
    if each.own_results:
        status = start(command, None)
        return f"exit status {status}" if status else ""
    began = time.perf_counter()
    report = folder / (each.report or REPORT)
    status = start(command, None) if each.report else _printed(command, report, start)
    if status:
        return f"exit status {status}"
    found = figures(report.read_text(encoding="utf-8"))
    if not found:
        return f"no figures in {report}"
    said = {"out": "OUT", "own": f"OUT/{each.name}", "data": "DATA"}
    shown = ["python" if each.folder else "eitskin", *each.arguments(said, seed, quick)]
    results = Results(
        name=each.name,
        command=" ".join(shown),
        provenance=Provenance.now(seed),
        seconds=time.perf_counter() - began,
        quick=quick and each.quick != each.options,
        figures=found,
    )
    write_results(results, folder.parent)
    return ""


def _printed(command: Sequence[str], report: Path, start: Start) -> int:
    """Run a command whose standard output becomes a file; a failed run keeps the old file."""
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder) / report.name
        status = start(command, printed)
        if not status:
            with atomic_file(report) as temporary:
                temporary.write_bytes(printed.read_bytes())
    return status


def run_process(command: Sequence[str], report: Path | None) -> int:
    """Run a command until it ends; its standard output goes to a file where one is given."""
    if report is None:
        return subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode  # noqa: S603
    with report.open("w", encoding="utf-8") as file:
        return subprocess.run(command, stdout=file, check=False).returncode  # noqa: S603


def _is_there(path: Path, seed: int | None, quick: bool) -> bool:
    """Whether a file has the results that a run would give again."""
    try:
        return path.is_file() and read_results(path).answers(seed, quick)
    except DataError:
        return False
