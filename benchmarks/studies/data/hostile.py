"""Trials of hostile inputs: `python -m eitskin.benchmarks.studies.data.hostile`, `make fuzz`.

Each trial makes one input, from a good one and random numbers, and reads it in a process that is
watched. Counted are inputs that are read, or refused with one error of eitskin; anything else is a
failure, whose number makes it again: `--only "shards" --trial 17`.
"""

import argparse
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from eitskin.benchmarks.results import Results, write_results
from eitskin.errors import EitskinError
from eitskin.provenance import Provenance

SECONDS: Final = 60
"""Processor time after which a trial counts as hanging [s]; recordings have 30 s for a block."""

MOST_BYTES: Final = 500_000_000
LONGEST: Final = 5000  # characters of an error
OUTCOMES: Final = ("read", "one clear error", "traceback", "crash", "hang", "over 500 MB")


def main() -> None:
    """Run the trials of all kinds, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    parser.add_argument("--trials", type=int, default=400, help="of a kind, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="kind, or its beginning")
    parser.add_argument("--trial", type=int, help="make one trial again, in this process")
    parser.add_argument("--watched", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.trial is not None:
        _one(given.only, given.seed, given.trial)
    elif given.watched:
        _perform()
    else:
        _table(given)


def run(seed: int, most: int, only: str = "") -> Iterator[tuple[str, int, str, str]]:
    """Kind, number, outcome and message of each trial."""
    from eitskin.benchmarks.studies.data.hostile_inputs import trials

    tasks = [
        (kind, number)
        for kind, (_, share) in trials().items()
        if kind.startswith(only)
        for number in range(max(1, int(most * share)))
    ]
    while tasks:
        done = 0
        for outcome, message in _watched(seed, tasks):
            yield *tasks[done], outcome, message
            done += 1
        tasks = tasks[done:]


def _watched(seed: int, tasks: list[tuple[str, int]]) -> Iterator[tuple[str, str]]:
    """Outcomes of tasks in a child, until it ends; the last is why."""
    with subprocess.Popen(  # noqa: S603 - this module
        [sys.executable, "-m", __spec__.name if __spec__ else __name__, "--watched"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as child:
        assert child.stdin is not None  # noqa: S101 - pipes, as asked for
        assert child.stdout is not None  # noqa: S101
        child.stdin.write(json.dumps([seed, tasks]))
        child.stdin.close()
        count = 0
        for line in child.stdout:
            count += 1
            outcome, message = json.loads(line)
            yield outcome, message
        code = child.wait()
        if count < len(tasks):
            yield ("hang" if code == -24 else "crash"), f"ended with {code}"


def _perform() -> None:
    """Perform the tasks of the input in this process."""
    seed, tasks = json.load(sys.stdin)
    warnings.simplefilter("ignore")
    from eitskin.benchmarks.studies.data.hostile_inputs import trials

    known = trials()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["EITSKIN_CACHE"] = str(Path(folder) / "cache")
        for kind, number in tasks:
            used = resource.getrusage(resource.RUSAGE_SELF)
            limit = int(used.ru_utime + used.ru_stime) + SECONDS
            resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
            with suppress(OSError):
                Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
            outcome = _outcome(known[kind][0], seed, kind, number, Path(folder))
            print(json.dumps(outcome), flush=True)


def _outcome(trial: Any, seed: int, kind: str, number: int, folder: Path) -> tuple[str, str]:
    before = _peak()  # sensors of earlier trials stay in caches
    try:
        trial(random.Random(f"{seed} {kind} {number}"), folder)  # noqa: S311
        found, message = "read", ""
    except EitskinError as error:
        message = str(error)
        found = "one clear error" if len(message) <= LONGEST else "traceback"
    except Exception as error:  # whatever comes is what is looked for
        found, message = "traceback", f"{type(error).__name__}: {error}"
    if _peak() - before > MOST_BYTES:
        found = "over 500 MB"
    return found, message[:300]


def _peak() -> int:
    """Largest memory of this process since the peak was reset, or of a waiting reader [bytes]."""
    from eitskin.contained import _Child

    processes = ["self", *(str(child._process.pid) for child in _Child._idle)]
    peaks = [0]
    for each in processes:
        with suppress(OSError):
            status = Path(f"/proc/{each}/status").read_text(encoding="ascii")
            lines = (line for line in status.splitlines() if line.startswith("VmHWM"))
            peaks += [int(line.split()[1]) * 1024 for line in lines]
    return max(peaks)


def _one(kind: str, seed: int, number: int) -> None:
    from eitskin.benchmarks.studies.data.hostile_inputs import trials

    with tempfile.TemporaryDirectory() as folder:
        print(trials()[kind][0](random.Random(f"{seed} {kind} {number}"), Path(folder)))  # noqa: S311


def _table(given: argparse.Namespace) -> None:
    began = time.perf_counter()
    counts: dict[str, Counter[str]] = {}
    for kind, number, outcome, message in run(given.seed, given.trials, given.only):
        counts.setdefault(kind, Counter())[outcome] += 1
        if outcome not in OUTCOMES[:2]:
            print(f"{kind}, trial {number}: {outcome}: {message}", flush=True)
    figures: dict[str, float] = {}
    for kind, found in counts.items():
        figures[f"{kind} / tried"] = found.total()
        figures |= {f"{kind} / {outcome}": found[outcome] for outcome in OUTCOMES}
        print(kind, found.total(), *(f"{name} {found[name]}" for name in OUTCOMES), sep="; ")
    command = f"python -m {__spec__.name if __spec__ else __name__} --trials {given.trials}"
    seconds = round(time.perf_counter() - began)
    results = Results("hostile", command, Provenance.now(given.seed), seconds, figures=figures)
    write_results(results, given.out)
    if any(counts[kind][outcome] for kind in counts for outcome in OUTCOMES[2:]):
        sys.exit(1)


if __name__ == "__main__":
    main()
