"""Attacks by kinds of hostile input, from a seed: `python tests/attacks/attacks.py --trials 1000`.

Every trial is either taken or refused by one error of the package. Anything else (a raw exception,
an endless loop, a half-written file, damage that is accepted) is printed with the number that makes
the trial again: `--only shards --trial 17`. The suite runs a few trials of each kind.
"""

import argparse
import contextlib
import errno
import functools
import os
import random
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

if __name__ == "__main__":
    HERE = Path(__file__).parent
    sys.path[:0] = [str(HERE), str(HERE.parent / "support")]

import numpy as np
import wrong_arguments
from session_attacks import AcceptedDamageError, damaged, live, network, pipeline, pipelines
from typer.testing import CliRunner

from eitskin.cli.main import app
from eitskin.datasets import (
    Recipe,
    export_dataset,
    generate,
    open_dataset,
    save_dataset,
    verify,
)
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.store.shard import append_checksum, verify_checksum
from eitskin.errors import EitskinError
from eitskin.files import TEMPORARY
from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol
from eitskin.training import StoredReference, Zero

import small_dataset
from shards_here import in_this_process, made_here

MAX_SECONDS = 60  # of processor time of a trial, and six times as much altogether
NUMBERS = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e-300, 1e300, 1e38, -1e38, 2.0**31, 1e6, 361.0)
TEXTS = (
    *("", " ", "a" * 300, "\0", "\x1b[2J", "\u202e", "1" * 5000, "9" * 20, "a b"),
    *"- -- ../.. /proc/self/mem -5 1e400 nan inf 0 0.5 x:y : ::1 [ $(id)".split(),  # noqa: SIM905
    *"pairwise:8 adjacent:1e9 coarse true {} 0-4 1,2,3 virtual:?seed=-5 set none".split(),  # noqa: SIM905
)


RECIPE = Recipe(
    "attacked", frames_per_shard=2, resolution="coarse", scenes=(SceneGroup("idle", count=4),)
)


@functools.cache
def whole(folder: Path) -> dict[str, bytes]:
    """Files of a generated set by name."""
    made_here(RECIPE, folder / "whole")
    return {path.name: path.read_bytes() for path in (folder / "whole").iterdir()}


def shards(rng: random.Random, folder: Path) -> None:
    """Resume a set with shards of a stranger, under seals that are right."""
    files, out = whole(folder), folder / "resumed"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(folder / "whole", out)
    name = "shard-000000.h5"
    image, _ = verify_checksum(files[name])
    if rng.random() < 0.5:
        broken = damaged(image, rng)
    else:
        path, broken = folder / "foreign.h5", image
        path.write_bytes(image)
        change_hdf5(path, rng)
        broken = path.read_bytes()
    (out / name).write_bytes(append_checksum(broken))
    if rng.random() < 0.7:
        (out / "manifest.json").unlink()
    with mock_workers():
        generate(RECIPE, out, resume=True)
    found = {path.name: path.read_bytes() for path in out.iterdir()}
    changed = [each for each in found if found[each] != files.get(each)]
    if changed:
        verify(out)
        data, sound = open_dataset(out), open_dataset(folder / "whole")
        for field in ("seed", "recipe", "source", "design", "protocol"):
            if getattr(data, field) != getattr(sound, field):
                raise AcceptedDamageError(f"another {field} was resumed")


@contextlib.contextmanager
def mock_workers() -> Iterator[None]:
    """Let shards be made in this process."""
    import pytest

    with pytest.MonkeyPatch.context() as patch:
        in_this_process(patch)
        yield


def change_hdf5(path: Path, rng: random.Random) -> None:
    """Change an attribute or a number of an HDF5 file."""
    import h5py

    with h5py.File(path, "r+") as file:
        if rng.random() < 0.5:
            name = rng.choice(list(file.attrs))
            value = rng.choice((*NUMBERS[:8], -5, 2**63 - 1, "", "a" * 70000, "[[", [1.0, 2.0]))
            with contextlib.suppress(TypeError, OSError):
                file.attrs[name] = value
            return
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if hasattr(item, "dtype") else None)
        array = file[rng.choice(names)]
        values = array[...]
        if values.size:
            with np.errstate(all="ignore"), contextlib.suppress(OverflowError, ValueError):
                values.flat[rng.randrange(values.size)] = rng.choice(NUMBERS)
            array[...] = values


@functools.cache
def commands() -> list[tuple[tuple[str, ...], Any]]:
    """Words and parameters of every command that ends by itself."""
    import typer

    found: list[tuple[tuple[str, ...], Any]] = []

    def walk(command: Any, words: tuple[str, ...]) -> None:
        for name, inner in getattr(command, "commands", {}).items():
            walk(inner, (*words, name))
        if not hasattr(command, "commands") and words[0] not in ("bench", "demo", "virtual-board"):
            found.append((words, command.params))

    walk(typer.main.get_command(app), ())
    return found


def options(rng: random.Random, folder: Path) -> None:
    """Run a command with wrong values of its options."""
    words, parameters = rng.choice(commands())
    line = list(words)
    good = {
        "scene": "scene.toml",
        "recipe": "quick",
        "model": "reference.eitmodel",
        "files": "log.csv",
    }
    good |= {"design": "design.toml", "--board": "virtual:?speed=max&seed=1"}
    for parameter in parameters:
        name = parameter.opts[0]
        if name.startswith("--") and name not in ("--out", "--board") and rng.random() < 0.75:
            continue
        if name in ("--page", "--page-port", "--page-host", "--page-folder", "--ros2", "--picture"):
            continue
        value = (
            rng.choice(TEXTS)
            if rng.random() < 0.4
            else good.get(name, "new" if name == "--out" else "set")
        )
        if getattr(parameter, "is_flag", False) or "bool" in str(getattr(parameter, "type", "")):
            line.append(name)
        elif name.startswith("-"):
            line += [name, value]
        else:
            line.append(value)
    if words[0] in ("live", "check", "tare", "reconstruct") and "--frames" not in line:
        line += ["--frames", "2"]
    if words == ("generate",):
        line.append("--dry-run")
    ran = CliRunner().invoke(app, line, input="")
    error = ran.exception
    named = (
        isinstance(error, OSError) and error.filename is not None
    )  # answered by eitskin.cli.entry
    if (
        error is not None
        and not isinstance(error, EitskinError | SystemExit | ImportError)
        and not named
    ):
        error.add_note(shlex.join(line)[:600])
        raise error
    shutil.rmtree(folder / "new", ignore_errors=True)
    (folder / "new").unlink(missing_ok=True)
    if error is not None or ran.exit_code:
        raise EitskinError("refused")


def disks(rng: random.Random, folder: Path) -> None:
    """Write something on a disk that is full, over quota or read-only after some bytes."""
    out = folder / "written"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    reference = StoredReference(
        np.full(28, 500 + 1j), Protocol.pairwise(8), 40e3, Zero.FLAT, 5, 1e-4, ""
    )
    writers: Mapping[str, Callable[[Path], object]] = {
        "set": lambda path: save_dataset(small_dataset.make(40), path, frames_per_shard=8),
        "a.eitmodel": pipeline().save,
        "reference.json": reference.write,
        "design.toml": SensorDesign.reference().to_toml,
        "recipe.csv": Protocol.adjacent(8).to_file,
        "parquet": lambda path: export_dataset(folder / "set", path, "parquet"),
        "huggingface": lambda path: export_dataset(folder / "set", path, "huggingface"),
        "image.png": functools.partial(command, "simulate", folder / "scene.toml", "--view"),
        "log.mcap": functools.partial(command, "export", "mcap", folder / "set", "--out"),
        "imported": functools.partial(command, "import", folder / "log.csv", "--out"),
        "picture.npz": functools.partial(command, "reconstruct", folder / "set", "--out"),
    }
    name = rng.choice(list(writers))
    left, code = rng.randrange(12), rng.choice((errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO))

    def fails(name: str) -> Callable[..., Any]:
        call = getattr(os, name)

        def failing(path: Any, *rest: Any, **named: Any) -> Any:
            nonlocal left
            writes = name != "open" or (rest and rest[0] & (os.O_CREAT | os.O_RDWR))
            if writes and str(out) in str(path):
                left -= 1
                if left < 0:
                    raise OSError(code, os.strerror(code), str(path))
            return call(path, *rest, **named)

        return failing

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    refused = False
    try:
        with contextlib.ExitStack() as stack:
            if rng.random() < 0.5:
                resource.setrlimit(resource.RLIMIT_FSIZE, (int(10 ** rng.uniform(0, 5)), limits[1]))
            else:
                for call in ("open", "replace", "mkdir"):
                    stack.enter_context(mock.patch.object(os, call, fails(call)))
            try:
                writers[name](out / name)
            except (EitskinError, OSError):
                refused = True
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    if not refused:
        return
    for path in out.rglob("*"):
        half = path.name.startswith((TEMPORARY, f".{name}"))
        if half or (path == out / name and path.is_file()):
            raise AcceptedDamageError(f"{path.relative_to(out)} was left")
    raise EitskinError("refused")


def command(*words: object) -> None:
    """Run a command in this process; its error is raised."""
    ran = CliRunner().invoke(app, [*map(str, words), "--quiet"])
    if ran.exception is not None and not isinstance(ran.exception, SystemExit):
        raise ran.exception


def arguments(rng: random.Random, folder: Path) -> None:
    """Call one public name with wrong arguments."""
    if wrong_arguments.attack(rng, folder) == "refused":
        raise EitskinError("refused")


KINDS: Mapping[str, Callable[[random.Random, Path], None]] = {
    each.__name__: each
    for each in (
        shards,
        options,
        pipelines,
        arguments,
        live,
        disks,
        network,
    )
}


def prepare(folder: Path) -> None:
    """Make the files that trials name, and work beside them."""
    if not (folder / "set").exists():
        save_dataset(small_dataset.make(6, status=np.zeros((6, 28))), folder / "set")
    SensorDesign.reference().to_toml(folder / "design.toml")
    (folder / "scene.toml").write_text("[[touches]]\nx = 0.05\ny = 0.02\n")
    (folder / "log.csv").write_text("v0,v1,x,y\n" + "1,2,0.01,0.02\n" * 12)
    os.chdir(folder)


def attempt(kind: str, seed: int, number: int, folder: Path) -> tuple[str, str]:
    """Outcome of one trial, "taken", "refused" or "bad", and what was bad."""
    before = threading.active_count(), sum(1 for _ in Path("/proc/self/fd").iterdir())
    for sign in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(sign, signal.default_int_handler)
    signal.alarm(6 * MAX_SECONDS)
    signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)
    try:
        prepare(folder)
        KINDS[kind](random.Random(f"{kind} {seed} {number}"), folder)
    except (EitskinError, ImportError):
        outcome = "refused", ""
    except (Exception, KeyboardInterrupt) as error:
        outcome = "bad", "".join(traceback.format_exception(error)[-4:])
    else:
        outcome = "taken", ""
    finally:
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0)
    after = threading.active_count(), sum(1 for _ in Path("/proc/self/fd").iterdir())
    grown = [new - old for new, old in zip(after, before, strict=True)]
    return outcome if max(grown) < 40 else ("bad", f"threads and files grew by {grown}")


def main() -> None:
    """Try inputs of all kinds, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="kinds, between commas")
    parser.add_argument("--trial", type=int, help="one trial alone, whose error is shown")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    print(
        "| kind | seed | trials | taken | refused | bad | seconds | growth of memory |\n"
        + "|---" * 8
        + "|"
    )
    for kind in given.only.split(",") if given.only else KINDS:
        found: Counter[str] = Counter()
        began, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with tempfile.TemporaryDirectory() as folder:
            trials = range(given.trials) if given.trial is None else [given.trial]
            for number in trials:
                outcome, why = attempt(kind, given.seed, number, Path(folder))
                found[outcome] += 1
                if why:
                    print(f"{kind}, trial {number}: {why}", file=sys.stderr, flush=True)
            os.chdir("/")
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) // 1024
        counts_ = " | ".join(str(found[each]) for each in ("taken", "refused", "bad"))
        seconds = time.process_time() - began
        print(
            f"| {kind} | {given.seed} | {len(trials)} | {counts_} | {seconds:.0f} | {grown} MB |",
            flush=True,
        )


if __name__ == "__main__":
    main()
