"""Results of a benchmark, as they are written to its folder `OUT/NAME` and shown; and the suite.

results.json has the figures by name, and what they were measured with; table.csv holds the rows;
pictures stand next to them. All benchmarks write through here, each file whole.
"""

import csv
import io
import math
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
from rich import box
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType
from rich.markup import escape
from rich.table import Table

from eitskin.datasets.store.folder import make_folder
from eitskin.extras import require
from eitskin.files import atomic_file
from eitskin.geometry import ConfigurationError, DataError
from eitskin.provenance import Provenance

NUMBER = re.compile(r"[-+]?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e[-+]?\d+)?")
RESULTS, TABLE, INDEX = "results.json", "table.csv", "index.md"
Points = Mapping[str, Sequence[tuple[float, float]]]
"""Points (x, y) by label."""
Columns = Mapping[str, tuple[str, str, int | float]]
"""Key, format and factor of the values of a column, by its heading."""
Watch = Callable[[str, Sequence[Any]], Iterable[Any]]
"""Gives back the items that its text is about; shows progress where wanted."""
Progress = Callable[[str, int, int], None]
"""Is called with the work that its text is about how much of how much is done."""


@dataclass(frozen=True, slots=True)
class Results:
    """Results of one run of one benchmark.

    Attributes:
        name: name of the benchmark, and of its folder.
        command: command that makes it again.
        provenance: machine, versions, seed and date.
        seconds: seconds that the run took [s]; None where that was not noted.
        quick: whether fewer and smaller cases had to do; such figures are not for quoting.
        figures: figures by name, whose end says the unit; finite ones alone.
    """

    name: str
    command: str
    provenance: Provenance
    seconds: float | None = None
    quick: bool = False
    figures: dict[str, float] = field(default_factory=dict)

    def answers(self, seed: int | None, quick: bool) -> bool:
        """Whether a run with the installed versions would give the same figures.

        With this seed, or with any where it is None.
        """
        mine = self.provenance
        now = Provenance.now(mine.seed if seed is None else seed)
        return (mine.seed, mine.packages) == (now.seed, now.packages) and self.quick <= quick


@dataclass(frozen=True, slots=True)
class ReportTable:
    """Table as it is shown: headings, rows of cells, and how many first columns name a row.

    It goes on below, after those columns again, where the terminal is too narrow for all.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    names: int = 1

    @classmethod
    def from_rows(
        cls,
        rows: Sequence[Mapping[str, Any]],
        columns: Columns,
        names: int = 1,
    ) -> "ReportTable":
        """Table of values by their columns; cells are empty where a row has no value."""
        cells = [
            tuple(
                "" if (value := row.get(key)) is None else f"{factor * value:{digits}}"
                for key, digits, factor in columns.values()
            )
            for row in rows
        ]
        return cls(tuple(columns), cells, names)

    def figures(self, title: str = "") -> Iterator[tuple[str, float]]:
        """First number of each cell but the first of its row, by `title / first / heading`."""
        for label, *cells in self.rows:
            for heading, cell in zip(self.headings[1:], cells, strict=True):
                if number := NUMBER.search(cell):
                    key = " / ".join(filter(None, (title, label, heading)))
                    yield key, float(number[0].replace(",", ""))

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        """Parts of as many columns as fit, at least one each."""
        start, count = self.names, len(self.headings)
        while start < count:
            end = start + 1
            while end < count and self._width(console, start, end + 1) <= options.max_width:
                end += 1
            yield self._part(start, end)
            start = end

    def _width(self, console: Console, start: int, end: int) -> int:
        unbounded = console.options.update(width=10_000)
        return console.measure(self._part(start, end), options=unbounded).maximum

    def _part(self, start: int, end: int) -> Table:
        table = Table(box=box.SIMPLE, pad_edge=False)
        for number in (*range(self.names), *range(start, end)):
            justify: JustifyMethod = "left" if number < self.names else "right"
            table.add_column(escape(self.headings[number]), justify=justify)
        for row in self.rows:
            table.add_row(*map(escape, (*row[: self.names], *row[start:end])))
        return table


@dataclass(frozen=True, slots=True)
class Report:
    """One run of one benchmark: its results, and how they are shown.

    Attributes:
        results: results of the run.
        rows: rows of table.csv; the figures themselves where there are none.
        tables: tables as shown.
        sentences: sentences below the tables.
        plots: functions that draw each picture into a path, by the picture's name.
        failed: whether the run found something wrong.
    """

    results: Results
    rows: Sequence[dict[str, Any]] = ()
    tables: Sequence[ReportTable] = ()
    sentences: Sequence[str] = ()
    plots: Mapping[str, Callable[[Path], object]] = field(default_factory=dict)
    failed: bool = False

    def write(self, out: Path) -> list[Path]:
        """Write `out/NAME/`: pictures and table first, results.json last, which vouches for all.

        Returns all paths. Raises ConfigurationError where one cannot be written; the old stays.
        """
        folder, results = out / self.results.name, self.results
        make_folder(folder)
        for name, draw in self.plots.items():
            with atomic_file(folder / name) as temporary:
                draw(temporary)
        rows = self.rows or [{"figure": k, "value": v} for k, v in results.figures.items()]
        text = io.StringIO()
        text.write(f"# {results.provenance}\n")
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        with atomic_file(folder / TABLE) as temporary:
            temporary.write_text(text.getvalue(), encoding="utf-8")
        with atomic_file(folder / RESULTS) as temporary:
            content = msgspec.json.format(msgspec.json.encode(results), indent=1)
            temporary.write_bytes(content + b"\n")
        return [folder / name for name in (*self.plots, TABLE, RESULTS)]


def make_results(
    name: str,
    figures: Iterable[tuple[str, float]],
    *,
    began: float,
    seed: int = 0,
    quick: bool = False,
    options: str = "",
) -> Results:
    """Results of a run of `eitskin bench NAME` that ends now.

    Figures that are no numbers are left out. It began at `began`, by `time.perf_counter()` [s];
    `options` are those of the command, where they are more than a seed.
    """
    words = ["eitskin bench", name, options or f"--seed {seed}", "--quick" * quick]
    return Results(
        name=name,
        command=" ".join(filter(None, words)),
        provenance=Provenance.now(seed),
        seconds=time.perf_counter() - began,
        quick=quick,
        figures={key: value for key, value in figures if math.isfinite(value)},
    )


def read_results(path: Path) -> Results:
    """Results read from a file; raises DataError where the file holds none."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Results)
    except (OSError, msgspec.DecodeError) as error:
        raise DataError(
            f"expected the results of a benchmark in {path}: {error}; run it again with --fresh"
        ) from error


def found_results(out: Path) -> Iterator[Results]:
    """All results under a folder, by name."""
    for path in sorted(out.glob(f"*/{RESULTS}")):
        yield read_results(path)


def write_index(out: Path, left_out: Mapping[str, str] | None = None) -> Path:
    """Write index.md: all results with their dates and files, and benchmarks left out, with why."""
    lines = ["# Measured", "", "| benchmark | figures | seconds | seed | date | files |"]
    lines.append("|---" * 6 + "|")
    machines = set()
    for one in found_results(out):
        packages = ", ".join(" ".join(item) for item in one.provenance.packages.items())
        made = f"{one.provenance.machine}; Python {one.provenance.python}, {packages}"
        machines.add(f"- {made}")
        files = sorted(p.name for p in (out / one.name).iterdir() if p.is_file())
        links = ", ".join(f"[{name}]({one.name}/{name})" for name in files)
        date, name = one.provenance.date, f"{one.name}{', quick' if one.quick else ''}"
        seconds = "" if one.seconds is None else f"{one.seconds:.0f}"
        cells = (name, len(one.figures), seconds, one.provenance.seed, date, links)
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    if left_out:
        lines += ["", *(f"- `{name}` left out: {why}" for name, why in left_out.items())]
    lines += ["", *sorted(machines), ""]
    with atomic_file(out / INDEX) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")
    return out / INDEX


def plot_errors(
    path: Path,
    panels: Mapping[str, Points],
    x: str,
    y: str,
    limits: Mapping[str, float] | None = None,
    ticks: Sequence[str] = (),
    joined: bool = True,
) -> None:
    """Plot points by label, a panel for each title, on logarithmic scales into a PNG file.

    `limits` are marked values of y by name; `ticks` names of x = 0, 1, ..., on linear scales.
    Points of a label are joined by lines unless they are of unlike cases.
    """
    ticker = require("matplotlib.ticker", "bench")
    figure = require("matplotlib.figure", "bench").Figure(
        figsize=(8.0 * len(panels), 5.4), layout="constrained"
    )
    grid = figure.subplots(1, len(panels), squeeze=False, sharex=True)
    for axes, (title, series) in zip(grid.ravel(), panels.items(), strict=True):
        for number, (label, points) in enumerate(series.items()):
            ordered = list(zip(*sorted(points), strict=True)) or [(), ()]
            style = "os^"[number // 10 % 3] + ("-" if joined else "")  # colours repeat after ten
            (axes.plot if ticks else axes.loglog)(*ordered, style, ms=4, lw=0.8, label=label)
        for name, value in (limits or {}).items():
            axes.axhline(value, color="#999999", linewidth=0.8, linestyle=(0, (4, 3)))
            axes.text(0.01, 1.04 * value, name, transform=axes.get_yaxis_transform())
        axes.set(xlabel=x, ylabel=y, title=title)
        if ticks:
            axes.set_xticks(range(len(ticks)), ticks)
        for axis in () if ticks else (axes.xaxis, axes.yaxis):
            axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(ticker.FormatStrFormatter("%g"))
            axis.set_minor_formatter(ticker.NullFormatter())
        axes.grid(visible=True, which="major", color="#e4e4e4", linewidth=0.7)
        axes.spines[["top", "right"]].set_visible(False)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False, fontsize=8)
    figure.savefig(path, dpi=120, facecolor="white", format="png")


# The suite of all benchmarks, one after the other: `eitskin bench all`

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


def peak_memory_mb() -> float:
    """Most memory [MB] that this process has used.

    Without what the parent had used when it began, which `getrusage` counts on Linux.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        return float(status.read_text(encoding="ascii").partition("VmHWM:")[2].split()[0]) / 1e3
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def run_process(command: Sequence[str]) -> int:
    """Run a command until it ends."""
    return subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode  # noqa: S603


def _is_there(path: Path, seed: int | None, quick: bool) -> bool:
    """Whether a file has the results that a run would give again."""
    try:
        return path.is_file() and read_results(path).answers(seed, quick)
    except DataError:
        return False
