"""Attacks by kinds of hostile input, from a seed: `python tests/attacks/attacks.py --trials 1000`.

Every trial is either taken or refused by one error of the package. Anything else (a raw exception,
an endless loop, a half-written file, damage that is accepted) is printed with the number that makes
the trial again: `--only options --trial 17`. The suite runs a few trials of each kind.
"""

import argparse
import contextlib
import dataclasses
import errno
import functools
import json
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
from typer.testing import CliRunner

from eitskin.cli.main import app
from eitskin.datasets import export_dataset, save_dataset
from eitskin.errors import EitskinError
from eitskin.files import TEMPORARY
from eitskin.geometry import SensorDesign
from eitskin.hardware import Counts, run_live
from eitskin.hardware.streams import reading_record
from eitskin.simulator import Frame, Protocol
from eitskin.training import StoredReference, Zero, open_pipeline
from eitskin.training.pipeline.saved_form import SHIPPED_PATH

import small_dataset

MAX_SECONDS = 60  # of a trial
TEXTS = (
    *("", " ", "a b", "a" * 300, "1" * 5000, "9" * 20, "\0", "\x1b[2J", "\u202e", "-", "--"),
    *("-5", "1e400", "nan", "inf", "0", "0.5", "0-4", "1,2,3", "x:y", ":", "::1", "[", "{}"),
    *("$(id)", "../..", "/dev/zero", "/proc/self/mem", "pairwise:8", "adjacent:1e9", "coarse"),
    *("true", "virtual:?seed=-5", "set", "none"),
)


class AcceptedDamageError(Exception):
    """Damage that was taken for data."""


@functools.cache
def pipeline() -> Any:
    """The shipped pipeline."""
    return open_pipeline(SHIPPED_PATH)


def rest_frame(of: Any, numbers: np.random.Generator, count: int) -> Frame:
    """Frame of a sensor at rest, with noise."""
    noise = 1 + 2e-4 * numbers.standard_normal(len(of.layout.reference))
    values = (of.layout.reference * noise).astype(complex)
    return Frame(values, of.layout.protocol, 0.3 * count, count, frequency=of.layout.frequency)


def damaged_frame(good: Frame, rng: random.Random) -> Frame:
    """Frame with odd values, times, numbers or status."""
    numbers = np.random.default_rng(rng.randrange(2**32))
    values, count = good.impedance.copy(), len(good.impedance)
    chosen = numbers.random(count) < rng.choice((0.04, 0.5, 1.0))
    odd = numbers.choice([np.nan, np.inf, -np.inf, 0, -1, 1e300, 1e-300, 5e-324, 1e12, 1j], count)
    with np.errstate(all="ignore"):
        values = rng.choice(
            (
                np.where(chosen, odd, values),
                np.where(chosen, -values, values),
                np.where(chosen, values * 10 ** numbers.uniform(-12, 12), values),
                values * np.exp(2j * np.pi * rng.random()),
                numbers.permutation(values),
                values * (1 + 0.2 * numbers.standard_normal(count)),
            )
        )
    status = numbers.integers(0, 256, count).astype(np.uint8) * (chosen & (rng.random() < 0.2))
    time_, number = rng.choice(
        ((good.time, good.number),) * 3 + ((-1e10, 0), (np.nan, -5), (1e300, 2**40))
    )
    return dataclasses.replace(good, impedance=values, status=status, time=time_, number=number)


class FrameSource:
    """Board of frames that are made as they are asked for."""

    counts = Counts()

    def __init__(self, made: Iterator[Frame]) -> None:
        self.made = made

    def frames(self, newest: bool = False) -> Iterator[Frame]:  # noqa: ARG002
        """The frames."""
        return self.made


def live(rng: random.Random, folder: Path, frames: int = 100) -> None:  # noqa: ARG001
    """Run a session of frames most of which are damaged, by a clock that is set back."""
    pipeline().reset()
    draws = np.random.default_rng(rng.randrange(2**32))

    def source() -> Iterator[Frame]:
        for number in range(frames):
            good = rest_frame(pipeline(), draws, number)
            yield good if number == 0 or rng.random() < 0.3 else damaged_frame(good, rng)

    clock = lambda: rng.choice((time.perf_counter(), 0.0, -1e9, 1e12))  # noqa: E731
    steps = time.time if rng.random() < 0.5 else clock
    with mock.patch("time.time", steps):
        for reading in run_live(FrameSource(source()), pipeline(), clock=clock):
            if reading.problem.startswith("the pipeline failed"):
                raise ArithmeticError(reading.problem)
            json.dumps(reading_record(reading, FrameSource.counts), allow_nan=False)
            estimate = reading.estimate
            found = (
                []
                if estimate is None
                else [estimate.bend_angle_deg or 0.0, *np.ravel(estimate.touches)]
            )
            if estimate is not None and not (estimate.problems or np.isfinite(found).all()):
                raise ArithmeticError(f"not finite, without a problem: {estimate}")


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


KINDS: Mapping[str, Callable[[random.Random, Path], None]] = {
    each.__name__: each for each in (options, live, disks)
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
    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.alarm(MAX_SECONDS)
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
    after = threading.active_count(), sum(1 for _ in Path("/proc/self/fd").iterdir())
    grown = [new - old for new, old in zip(after, before, strict=True)]
    return outcome if max(grown) < 40 else ("bad", f"threads and files grew by {grown}")


def main() -> None:
    """Try inputs of all kinds, and print what became of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000, help="of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="kinds, between commas")
    parser.add_argument("--trial", type=int, help="one trial alone, whose error is shown")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    for kind in given.only.split(",") if given.only else KINDS:
        found: Counter[str] = Counter()
        began, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with tempfile.TemporaryDirectory() as folder:
            for number in range(given.trials) if given.trial is None else [given.trial]:
                outcome, why = attempt(kind, given.seed, number, Path(folder))
                found[outcome] += 1
                if why:
                    print(f"{kind}, trial {number}: {why}", file=sys.stderr, flush=True)
            os.chdir("/")
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) // 1024
        seconds = time.process_time() - began
        print(f"{kind}: {dict(found)} in {seconds:.0f} s, {grown} MB more", flush=True)


if __name__ == "__main__":
    main()
