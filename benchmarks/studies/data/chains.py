"""Any sensor through the whole chain, by the commands that a user types.

Run by `python -m eitskin.benchmarks.studies.data.chains --out OUT [--case NAME] [--fresh]`.

Each case is a folder `OUT/chains/NAME` with a design, a recipe and two scenes. In it the commands
run one after the other: a picture of the mesh, simulated frames, a trained pipeline and its errors,
the sensor check and a live session on a virtual board, a picture of one press without training, and
presses of a sensor that no set has, imported from a table of readings and learned from. Tables of
presses begin empty. Prints the time of each command and the errors, as Markdown. Commands that
have run are kept in OUT, so that an interrupted study goes on; `--fresh` begins anew.
"""

import argparse
import csv
import json
import math
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from eitskin.benchmarks.results import Results, write_results
from eitskin.benchmarks.studies.data.chain_cases import (
    CASES,
    DESIGN,
    OWN_RECIPE,
    PRESS,
    RECIPE,
    SESSION,
    ChainCase,
)
from eitskin.datasets.store.folder import open_dataset
from eitskin.files import atomic_file
from eitskin.provenance import Provenance

EITSKIN = (sys.executable, "-m", "eitskin")
OWN_TABLE = "own.csv"


@dataclass(frozen=True, slots=True)
class Ran:
    """One command that has run.

    Attributes:
        step: name of it.
        seconds: real time [s].
        processor: time of all processors [s].
        status: exit status.
        said: last line on stderr, where it failed.
        printed: standard output.
    """

    step: str
    seconds: float
    processor: float
    status: int
    said: str = ""
    printed: str = ""


@dataclass(frozen=True, slots=True)
class Found:
    """Commands of one case that have run, and the errors that they found.

    Attributes:
        ran: commands in turn.
        errors: by name, whose end says the unit.
    """

    ran: list[Ran] = field(default_factory=list)
    errors: dict[str, float] = field(default_factory=dict)

    def figures(self) -> Iterator[tuple[str, float]]:
        """Times, exit statuses and errors by name."""
        for ran in self.ran:
            yield f"{ran.step} [s]", round(ran.processor, 2)
            yield f"{ran.step}, real [s]", round(ran.seconds, 2)
            yield f"{ran.step}, exit status", ran.status
        yield "all commands [s]", round(sum(ran.processor for ran in self.ran), 1)
        for key, value in self.errors.items():
            yield key, round(value, 4)


@dataclass(frozen=True, slots=True)
class Chain:
    """Chain of commands for one case.

    Attributes:
        case: sensor and numbers of frames.
        folder: of all its files.
        cache: of tables of presses.
        found: by the commands so far.
    """

    case: ChainCase
    folder: Path
    cache: Path
    found: Found = field(default_factory=Found)

    def run(self, step: str, *arguments: str) -> str:
        """Run `eitskin ARGUMENTS` in the folder, unless it has run there.

        Returns its output, empty where it failed.
        """
        kept = self.folder / f"{step}.json"
        if not kept.is_file():
            ran = self._ran(step, arguments)
            with atomic_file(kept) as temporary:
                temporary.write_bytes(msgspec.json.encode(ran))
        ran = msgspec.json.decode(kept.read_bytes(), type=Ran)
        self.found.ran.append(ran)
        return "" if ran.status else ran.printed

    def _ran(self, step: str, arguments: Sequence[str]) -> Ran:
        before, begun = _children(), time.perf_counter()
        done = subprocess.run(  # noqa: S603
            [*EITSKIN, *arguments],
            cwd=self.folder,
            env=os.environ | {"EITSKIN_CACHE": str(self.cache)},
            capture_output=True,
            text=True,
            check=False,
        )
        seconds, processor = time.perf_counter() - begun, _children() - before
        said = done.stderr.strip().splitlines()
        (self.folder / f"{step}.log").write_text(
            f"eitskin {' '.join(arguments)}\n{done.stdout}{done.stderr}", encoding="utf-8"
        )
        last = said[-1] if said and done.returncode else ""
        print(f"{self.case.name}: {step}: {processor:.1f} s {last}", file=sys.stderr, flush=True)
        return Ran(step, seconds, processor, done.returncode, last, done.stdout)

    def simulated(self) -> None:
        """Mesh, dataset and pipelines of the sensor."""
        self.run("mesh", "mesh", "--sensor", DESIGN, "--view", "mesh.png")
        self.run("generate", "generate", RECIPE, "--out", "data", "--workers", "1")
        if printed := self.run("info", "dataset", "info", "data", "--json"):
            self.found.errors["channels"] = json.loads(printed)["channels"]
        self.learn("data", "quick", "quick")

    def learn(self, data: str, preset: str, name: str) -> None:
        """Train on a dataset, and measure on what was held out."""
        model = f"{name}.eitmodel"
        self.run(f"train {name}", "train", data, "--out", model, "--preset", preset, "--json")
        if printed := self.run(f"evaluate {name}", "evaluate", model, data, "--json"):
            judgement = judged(json.loads(printed))
            self.found.errors.update({f"{name} / {key}": value for key, value in judgement})

    def live(self) -> None:
        """Sensor check and live session on the virtual board: ten frames untouched, ten pressed."""
        model = "quick.eitmodel"
        uri = self.case.board()
        if printed := self.run("check", "check", model, "--board", uri, "--json"):
            self.found.errors["check / findings"] = len(json.loads(printed)["findings"])
        uri = self.case.board(scene=SESSION)
        options = ("--board", uri, "--frames", "20", "--every-frame", "--json")
        if printed := self.run("live", "live", model, *options):
            readings = [json.loads(line) for line in printed.splitlines()]
            self.found.errors.update(followed(readings, self.case.press))

    def pictured(self) -> None:
        """Picture of one press without training."""
        sensor = ("--sensor", DESIGN, "--protocol", self.case.protocol)
        options = ("--out", "picture.png", "--json")
        if printed := self.run("reconstruct", "reconstruct", PRESS, *sensor, *options):
            (picture,) = json.loads(printed)["pictures"]
            away = math.dist(picture["least_at_m"], self.case.press)
            self.found.errors["reconstruct / error [mm]"] = 1e3 * away

    def own_presses(self) -> None:
        """Presses of a sensor that no set has, as a table of readings in the hand of a user."""
        self.run("own presses", "generate", OWN_RECIPE, "--out", "own-simulated", "--workers", "1")
        if self.found.ran[-1].status:
            return
        write_presses(self.folder / "own-simulated", self.folder / OWN_TABLE)
        form = ("--rows", "before-during", "--keep-before", "--length-unit", "mm")
        sensor = ("--sensor", DESIGN, "--protocol", self.case.protocol)
        self.run("import", "import", OWN_TABLE, "--out", "own", *sensor, *form)
        self.learn("own", "quick", "own")


def write_presses(dataset: Path, table: Path) -> None:
    """Write a simulated dataset as a table of readings before and during each press, in mm."""
    data = open_dataset(dataset)
    names = [f"v{channel}" for channel in range(data.impedance.shape[1])]
    with table.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["state", "x", "y", *names])
        for index in range(len(data)):
            before, during = data.touch_reference[index].real, data.impedance[index].real
            place = 1e3 * np.array([data.touch_x[index, 0], data.touch_y[index, 0]], dtype=float)
            writer.writerow(["idle", "", "", *(f"{value:.7g}" for value in before)])
            at = (f"{value:.3f}" for value in place)
            writer.writerow(["touch", *at, *(f"{value:.7g}" for value in during)])


def judged(report: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Errors of a report of `eitskin evaluate --json` by name."""
    single = report["touches"].get("1")
    shares = [share for share in report["states"]["accuracy"].values() if share is not None]
    if shares:
        yield "states right [%]", 100.0 * float(np.mean(shares))
    if single is not None:
        yield "found [%]", 100.0 * single["found"]
        yield "false per touch [%]", 100.0 * single["false_per_touch"]
        for key in ("mean", "p95"):
            if single[f"{key}_error_mm"] is not None:
                yield f"{key} error [mm]", single[f"{key}_error_mm"]
    yield "p99 [ms]", report["latency"]["p99_ms"]


def followed(
    readings: Sequence[dict[str, Any]], press: tuple[float, float]
) -> Iterator[tuple[str, float]]:
    """Errors of a live session whose second half is pressed at one place, by name."""
    half = len(readings) // 2
    right = [
        reading["state"] == ("idle" if number < half else "touch")
        for number, reading in enumerate(readings)
    ]
    yield "live / states right [%]", 100.0 * float(np.mean(right))
    touches = [each for reading in readings[half:] for each in reading["touches"] or ()]
    if touches:
        yield "live / error [mm]", 1e3 * float(np.mean([math.dist(t[:2], press) for t in touches]))
    yield "live / touches per pressed frame", len(touches) / half
    yield "live / problems", sum(bool(reading["problems"]) for reading in readings)


def rows(cases: Mapping[str, Found]) -> list[dict[str, Any]]:
    """Commands of all cases, a row each."""
    return [
        {
            "case": name,
            "command": ran.step,
            "seconds": round(ran.seconds, 2),
            "processor_s": round(ran.processor, 2),
            "exit_status": ran.status,
            "last_line": ran.said,
        }
        for name, found in cases.items()
        for ran in found.ran
    ]


def taken_through(case: ChainCase, folder: Path, cache: Path) -> Found:
    """Outcome of the chain of one case; commands that have run in its folder are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    case.write(folder)
    chain = Chain(case, folder, cache)
    chain.simulated()
    chain.live()
    chain.pictured()
    chain.own_presses()
    return chain.found


def _children() -> float:
    """Processor time of all child processes that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _printed(name: str, found: Found) -> Iterator[str]:
    yield f"\n**{name}**\n"
    yield "| command | s | processor, s | status |\n|---|---|---|---|"
    for ran in found.ran:
        cells = f"{ran.seconds:.1f} | {ran.processor:.1f} | {ran.status} {ran.said}".rstrip()
        yield f"| {ran.step} | {cells} |"
    yield ""
    yield from (f"- {key}: {value:.4g}" for key, value in found.errors.items())


def main() -> None:
    """Take all cases, or one, through the chain; print and write what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of all results")
    parser.add_argument("--case", choices=[case.name for case in CASES], help="only this one")
    parser.add_argument("--fresh", action="store_true", help="run again what has run")
    options = parser.parse_args()
    out = options.out.absolute() / "chains"
    known = {}
    for case in CASES:
        if options.case in (None, case.name):
            folder = out / case.folder
            if options.fresh:
                shutil.rmtree(folder, ignore_errors=True)
            known[case.name] = taken_through(case, folder, folder / "cache")
            print("\n".join(_printed(case.name, known[case.name])))
    results = Results(
        "chains",
        "python -m eitskin.benchmarks.studies.data.chains --out OUT",
        Provenance.now(1),
        sum(ran.seconds for found in known.values() for ran in found.ran),
        quick=len(known) < len(CASES),
        figures={
            f"{name} / {key}": value
            for name, found in known.items()
            for key, value in found.figures()
        },
    )
    write_results(results, options.out, rows(known))


if __name__ == "__main__":
    main()
