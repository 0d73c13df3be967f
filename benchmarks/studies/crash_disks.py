"""Disks that are full, read-only or broken under `eitskin generate`."""

import errno
import os
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from eitskin.benchmarks.studies.crash_runs import Row, contents, finish, intact, shards, start

EXPECTED_CODES = (2, 5)
# Runs in every process that Python starts with it on its path, workers too.
_FAILING = """
import os
_left, _code, _sync = int(os.environ["FAIL_AFTER"]), int(os.environ["FAIL_WITH"]), os.fsync

def fsync(handle):
    global _left
    _left -= 1
    if _left < 0:
        raise OSError(_code, os.strerror(_code))
    _sync(handle)

os.fsync = fsync
"""


def injected(
    recipe: Path, folder: Path, whole: Mapping[str, bytes], code: int, trials: int, seed: int
) -> Row:
    """Syncing fails with `code` after some calls in each process; then resumed without."""
    rng = np.random.default_rng(seed)
    (folder / "failing").mkdir(parents=True)
    (folder / "failing" / "sitecustomize.py").write_text(_FAILING, encoding="utf-8")
    path = os.pathsep.join([str(folder / "failing"), os.environ.get("PYTHONPATH", "")])
    good = 0
    for trial in range(trials):
        out = folder / f"set-{trial}"
        failing = {"FAIL_AFTER": str(rng.integers(2, 10)), "FAIL_WITH": str(code)}
        run = start(recipe, out, environment={**os.environ, **failing, "PYTHONPATH": path})
        good += _clean(run, out, whole) and _resumes(recipe, out, whole)
    name = errno.errorcode[code]
    return Row(f"{name} injected into syncing: clean error, then resumed", trials, good, "")


def full_disks(recipe: Path, folder: Path, whole: Mapping[str, bytes]) -> Row:
    """Real small disks, from too small for anything up to nearly enough; then made larger."""
    what = "full disk (tmpfs): clean error, then resumed with more room"
    size = sum(map(len, whole.values()))
    sizes = [round(size * share / 4096) * 4096 for share in np.linspace(0.05, 0.95, 10)]
    good = 0
    for number, room in enumerate(sizes):
        with _small_disk(folder / f"disk-{number}", room) as remount:
            if remount is None:
                return Row(what, 0, 0, "mounting is not permitted here")
            out = folder / f"disk-{number}" / "set"
            ended = _clean(start(recipe, out), out, whole)
            remount("size=64m")
            good += ended and _resumes(recipe, out, whole)
    return Row(what, len(sizes), good, f"{sizes[0] // 1024} to {sizes[-1] // 1024} KiB")


def read_only(recipe: Path, folder: Path, whole: Mapping[str, bytes]) -> Row:
    """A folder that turns read-only before and after the set was begun."""
    what = "read-only folder: clean error, finished shards intact"
    with _small_disk(folder / "disk", 1 << 26) as remount:
        if remount is None:
            return Row(what, 0, 0, "mounting is not permitted here")
        out = folder / "disk" / "set"
        remount("ro")
        good = int(_clean(start(recipe, out), out, whole))
        remount("rw")
        finish(start(recipe, out, "--shard", "3"))
        remount("ro")
        kept = shards(out)
        good += _clean(start(recipe, out, "--resume"), out, whole) and shards(out) == kept != set()
        remount("rw")
        good += _resumes(recipe, out, whole)
    return Row(what, 3, good, "new folder, begun folder, writable again")


def _clean(run: "subprocess.Popen[str]", out: Path, whole: Mapping[str, bytes]) -> bool:
    """Whether a run ended with one of our errors and left nothing but whole shards."""
    code, said = finish(run)
    sober = code in EXPECTED_CODES and "Traceback" not in said and "eitskin: " in said
    complete = (out / "manifest.json").exists()
    return sober and not complete and intact(out, whole) and not list(out.glob(".writing-*"))


def _resumes(recipe: Path, out: Path, whole: Mapping[str, bytes]) -> bool:
    code, _ = finish(start(recipe, out, "--resume"))
    return code == 0 and contents(out) == whole


@contextmanager
def _small_disk(place: Path, size: int) -> Iterator[Callable[[str], None] | None]:
    """A disk of `size` bytes at `place`, and what mounts it anew; None where that is forbidden."""
    place.mkdir(parents=True)
    options = f"size={size}"
    mounted = _mount("-t", "tmpfs", "-o", options, "tmpfs", str(place))
    try:
        yield (
            (lambda change: _require(_mount("-o", f"remount,{change}", str(place))))
            if (mounted)
            else None
        )
    finally:
        if mounted:
            subprocess.run(["umount", str(place)], check=True)  # noqa: S603, S607


def _mount(*options: str) -> bool:
    try:
        done = subprocess.run(  # noqa: S603 - paths of our own
            ["mount", *options],  # noqa: S607
            check=False,
            capture_output=True,
        )
    except OSError:
        return False
    return done.returncode == 0


def _require(mounted: bool) -> None:
    if not mounted:
        raise OSError(errno.EPERM, "a disk could not be mounted anew")
