"""Trials of hostile inputs: `python -m eitskin.benchmarks.studies.hostile.run`, `make fuzz`.

Each trial makes one input, from a good one and random numbers, and reads it in a process that is
watched. Counted are inputs that are read, or refused with one error of eitskin; anything else is a
failure, whose number makes it again: `--only "shards" --trial 17`.
"""

import argparse
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from eitskin.benchmarks.results import Results, found_results, write_results
from eitskin.benchmarks.studies.hostile.watched import OUTCOMES, watched
from eitskin.provenance import Provenance

NAME = "hostile"
SHOWN = 20  # failures of a kind and outcome


def main() -> None:
    """Run the trials of all kinds, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("build/bench"))
    parser.add_argument("--trials", type=int, default=400, help="of a kind, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--only", default="", help="kinds, or their beginnings, between ';'; others keep figures"
    )
    parser.add_argument("--workers", type=int, default=1, help="processes that try inputs")
    parser.add_argument("--trial", type=int, help="make one trial again, in this process")
    given = parser.parse_args()
    if given.trial is not None:
        _one(given.only, given.seed, given.trial)
    else:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        sys.exit(_table(given))


def tasks(most: int, only: str = "") -> list[tuple[str, int]]:
    """Kind and number of each trial, at most so many of a kind."""
    from eitskin.benchmarks.studies.hostile.kinds import KINDS

    chosen = [k for start in only.split(";") for k in KINDS if k.startswith(start.strip())]
    return [(kind, n) for kind in chosen for n in range(max(1, int(most * KINDS[kind])))]


def _one(only: str, seed: int, number: int) -> None:
    """Make one trial again; its error ends the program."""
    from eitskin.benchmarks.studies.hostile.kinds import KINDS, draws, trial

    kind = next(kind for kind in KINDS if kind.startswith(only))
    with tempfile.TemporaryDirectory() as folder:
        os.environ["EITSKIN_CACHE"] = str(Path(folder) / "cache")
        print(trial(kind)(draws(seed, kind, number), Path(folder)))


def _table(given: argparse.Namespace) -> int:
    """Run, print and write; 1 where an outcome is neither reading nor one clear error."""
    began = time.perf_counter()
    asked = tasks(given.trials, given.only)
    left = Counter(kind for kind, _ in asked)
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in left}
    try:
        for kind, number, outcome, message in watched(given.seed, asked, given.workers):
            counts[kind][outcome] += 1
            left[kind] -= 1
            if outcome not in OUTCOMES[:2] and counts[kind][outcome] <= SHOWN:
                print(f"{kind}, trial {number}: {outcome}: {message}", flush=True)
            if not left[kind]:
                _print_row(kind, counts[kind])
    except KeyboardInterrupt:
        print("interrupted; what was tried is kept", flush=True)
    tried = {kind: found for kind, found in counts.items() if found}
    _write(given, tried, round(time.perf_counter() - began))
    return int(any(found[bad] for found in counts.values() for bad in OUTCOMES[2:]))


def _print_row(kind: str, found: Counter[str]) -> None:
    counts = (f"{name} {found[name]}" for name in OUTCOMES)
    print(f"{kind}: {found.total()} tried", *counts, sep="; ", flush=True)


def _write(given: argparse.Namespace, counts: Mapping[str, Counter[str]], seconds: int) -> None:
    """Write the results of kinds that were tried; others keep their figures."""
    before = next((each for each in found_results(given.out) if each.name == NAME), None)
    figures = dict(before.figures) if before else {}
    seconds += round(before.seconds or 0) if before else 0
    for kind, found in counts.items():
        figures[f"{kind} / tried"] = found.total()
        figures |= {f"{kind} / {outcome}": found[outcome] for outcome in OUTCOMES}
    module = __spec__.name if __spec__ else __name__
    command = f"python -m {module} --trials {given.trials}"
    provenance = Provenance.now(given.seed)
    write_results(Results(NAME, command, provenance, seconds, figures=figures), given.out)


if __name__ == "__main__":
    main()
