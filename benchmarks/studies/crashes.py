"""What crashes, full disks and bit rot do to datasets.

Run by `python -m eitskin.benchmarks.studies.crashes`.

Everything is real: processes of the command line are killed, small disks are filled. Takes about
a quarter of an hour with 200 kills; Linux, and for the disks the right to mount.
"""

import argparse
import dataclasses
import errno
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from eitskin.benchmarks.results import write_table
from eitskin.benchmarks.studies.crash_damage import damage
from eitskin.benchmarks.studies.crash_disks import full_disks, injected, read_only
from eitskin.benchmarks.studies.crash_kills import cluster, kill_and_resume, same_bytes
from eitskin.benchmarks.studies.crash_runs import RECIPE, Row, contents, finish, start
from eitskin.provenance import Provenance

TRIALS = ("bytes", "damage", "disks", "kills")


def run(given: argparse.Namespace) -> Iterator[Row]:
    """The trials asked for, in a temporary folder; the seed decides over moments and places."""
    with tempfile.TemporaryDirectory(prefix="eitskin-crashes-") as name:
        place = Path(name)
        recipe = place / "recipe.toml"
        recipe.write_text(RECIPE.to_toml(), encoding="utf-8")
        code, said = finish(start(recipe, place / "whole", "--workers", "1"))
        if code:
            raise SystemExit(said)
        whole = contents(place / "whole")
        if "bytes" in given.only:
            yield same_bytes(recipe, place / "same", whole)
            yield cluster(place / "cluster", whole, kills=5)
        if "damage" in given.only:
            yield from damage(place / "damage", given.damages, given.seed)
        if "disks" in given.only:
            yield full_disks(recipe, place / "full", whole)
            yield read_only(recipe, place / "read-only", whole)
            for which in (errno.ENOSPC, errno.EIO):
                folder = place / f"error-{which}"
                yield injected(recipe, folder, whole, which, given.failures, given.seed)
        if "kills" in given.only:
            yield from kill_and_resume(recipe, place / "killed", whole, given.kills, given.seed)


def main() -> None:
    """Print each line as it is known; write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="CSV file for the table")
    parser.add_argument("--only", nargs="+", choices=TRIALS, default=TRIALS)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--damages", type=int, default=400, help="flipped bits and cuts")
    parser.add_argument("--failures", type=int, default=10, help="of each injected error")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    begun, rows = time.perf_counter(), []
    for row in run(given):
        rows.append(dataclasses.asdict(row))
        print(f"{row.as_promised}/{row.tried}  {row.what}  {row.remark}", flush=True)
    seconds = time.perf_counter() - begun
    write_table(given.out, rows, f"{Provenance.now(given.seed)}; {seconds:.0f} s")
    if any(row["as_promised"] < row["tried"] for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
