"""Killing runs of `eitskin generate` at random moments, and resuming them."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from eitskin.benchmarks.studies.crash_runs import (
    RECIPE,
    Row,
    contents,
    finish,
    intact,
    shards,
    start,
    workers_of,
)
from eitskin.datasets.generation.generate import generate
from eitskin.extras import require

_PARENTS = 0.7  # share of kills that hit the parent
_LONGEST_DELAY = 0.3  # [s], a few shards' time, after the last shard that was waited for


def same_bytes(recipe: Path, folder: Path, whole: Mapping[str, bytes]) -> Row:
    """Two workers, and each shard by a command of its own, against one worker."""
    found = []
    found.append(finish(start(recipe, folder / "two", "--workers", "2"))[0] == 0)
    found[-1] = found[-1] and contents(folder / "two") == whole
    codes = {
        finish(start(recipe, folder / "array", "--shard", str(shard)))[0]
        for shard in reversed(range(RECIPE.shards))
    }
    found.append(codes == {0} and contents(folder / "array") == whole)
    what = "same bytes as from one worker: two workers; one command per shard"
    return Row(what, len(found), sum(found), f"{RECIPE.shards} shards")


def cluster(folder: Path, whole: Mapping[str, bytes], kills: int) -> Row:
    """A dask cluster of two worker processes, killed in turn after every second shard."""
    distributed = require("distributed", "cluster")
    killed: list[int] = []
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as made:

        def kill(done: int, _total: int) -> None:
            due = done // (2 * RECIPE.frames_per_shard)
            if len(killed) < min(due, kills):
                pids = [worker.pid for worker in made.workers.values() if worker.pid]
                if pids and pids[-1] not in killed:
                    os.kill(pids[-1], signal.SIGKILL)
                    killed.append(pids[-1])

        generate(RECIPE, folder, progress=kill, scheduler=made.scheduler_address)
    same = contents(folder) == whole
    what = "same bytes as from one worker: a dask cluster of two workers, some killed"
    return Row(what, 1, int(same), f"{len(killed)} workers killed")


def kill_and_resume(
    recipe: Path, folder: Path, whole: Mapping[str, bytes], kills: int, seed: int
) -> list[Row]:
    """`kill -9` of parents and workers; each run goes on where the killed one was."""
    rng = np.random.default_rng(seed)
    done, kept, sets = Counter[str](), Counter[str](), Counter[str]()
    out = folder / "set-0"
    while done.total() < kills:
        before = shards(out)
        run = start(recipe, out, "--resume", "--workers", str(rng.integers(1, 3)))
        victim = "parent" if rng.random() < _PARENTS else "worker"
        hit = _kill(run, victim, out, len(before), rng)
        code, _ = finish(run)
        if hit:
            done[victim] += 1
            kept[victim] += before <= shards(out) and intact(out, whole)
            if done.total() % 10 == 0:
                print(f"{kept.total()}/{done.total()} kills so far", file=sys.stderr)
        if code == 0:
            sets["made"] += 1
            sets["identical"] += contents(out) == whole
            out = folder / f"set-{sets['made']}"
        elif not hit or victim == "worker":
            sets["failed"] += 1
    if shards(out):  # the last set is made whole, too
        sets["made"] += finish(start(recipe, out, "--resume"))[0] == 0
        sets["identical"] += contents(out) == whole
    return [
        *(
            Row(f"kill -9 of a {name}: no finished shard lost or changed", n, kept[name], "")
            for name, n in sorted(done.items())
        ),
        Row(
            "sets resumed until complete: identical to one that was never killed",
            sets["made"] + sets["failed"],
            sets["identical"],
            f"{done.total() / max(1, sets['made']):.1f} kills each",
        ),
    ]


def _kill(
    run: subprocess.Popen[str], victim: str, out: Path, finished: int, rng: np.random.Generator
) -> bool:
    """Kill a run or one of its workers some time after some shard; False where it ended before."""
    # A run killed between the last shard and the manifest has all of them.
    wanted = int(rng.integers(min(finished, RECIPE.shards - 1), RECIPE.shards))
    choice, delay = rng.random(), float(rng.uniform(0.0, _LONGEST_DELAY))
    while run.poll() is None and (len(shards(out)) < wanted or not workers_of(run)):
        time.sleep(0.001)
    moment = time.perf_counter() + delay
    while run.poll() is None and time.perf_counter() < moment:
        time.sleep(0.001)
    pids = [run.pid] if victim == "parent" else workers_of(run)
    if run.poll() is not None or not pids:
        return False
    try:
        os.kill(pids[int(choice * len(pids))], signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True
