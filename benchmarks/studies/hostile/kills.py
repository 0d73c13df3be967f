"""Kills of a generation that is resumed afterwards: no half file, and the same bytes.

Each trial begins a small dataset in a process that is killed, at an operation on a file or after
some processor time, looks at what is left, kills half of the resumed processes too, and resumes.
A process that ends before it is killed does not count.
"""

import functools
import os
import shutil
import signal
import sys
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

from eitskin.benchmarks.studies.hostile.texts import Draws
from eitskin.datasets.generation import generate as generation
from eitskin.datasets.generation.generate import generate
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.recipe.specimen import Specimens
from eitskin.files import TEMPORARY
from eitskin.geometry.deformation.fixtures import Hinge
from eitskin.simulator.instrument.instrument import Instrument

RECIPE = Recipe(
    "killed",
    seed=1,
    frames_per_shard=2,
    resolution="coarse",
    fixture=Hinge(),
    instrument=Instrument.ideal(),
    specimens=Specimens(count=1),
    scenes=(SceneGroup("idle", count=3), SceneGroup("bend", count=3, angle_deg=(-20.0, 40.0))),
)
OPERATIONS = 46  # on files, as many as a whole generation makes
SECONDS = 0.12  # of processor time, about what it takes in a forked process
_EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "os.chmod", "tempfile.mkstemp")


def killed(draws: Draws, folder: Path) -> int:
    """Number of kills until a generation is whole, and its bytes are those without any."""
    out, whole = folder / "killed", _whole(folder)
    shutil.rmtree(out, ignore_errors=True)
    kills = 0
    while kills == 0 or (kills < 3 and draws.random() < 0.5):
        if _be_killed(out, draws):
            kills += 1
            _require_whole_files(out, whole)
        else:  # it ended before
            shutil.rmtree(out)
    _in_process(out)
    found = _contents(out)
    if found != whole:
        raise AssertionError(f"resumed: {sorted(found)} instead of {sorted(whole)}, or other bytes")
    return kills


@functools.lru_cache
def _whole(folder: Path) -> dict[str, bytes]:
    """Files of the generation without interruption, by name.

    It is made in this process, so that those forked from it have what it has loaded and solved.
    """
    _generate(folder / "whole")
    return _contents(folder / "whole")


def _contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def _require_whole_files(out: Path, whole: dict[str, bytes]) -> None:
    """Files with a name are whole, whatever was killed; half ones are temporary."""
    for name, content in (_contents(out) if out.is_dir() else {}).items():
        if not name.startswith(TEMPORARY) and content != whole.get(name):
            raise AssertionError(f"{name} is not the whole file after a kill")


def _in_process(out: Path, before: Callable[[], None] = lambda: None) -> bool:
    """Generate, or resume, in a process of its own; whether it was killed."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            before()
            _generate(out)
            code = 0
        finally:
            os._exit(code)
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, -signal.SIGKILL, -signal.SIGPROF):
        raise AssertionError(f"generation ended with {code}")
    return code != 0


def _generate(out: Path) -> None:
    pooled, generation.make_shards = generation.make_shards, _here
    try:
        generate(RECIPE, out, workers=1, resume=out.is_dir())
    finally:
        generation.make_shards = pooled


def _here(
    recipe: Recipe,
    folder: Path,
    shards: Sequence[int],
    workers: int,  # noqa: ARG001
    scheduler: str | None,  # noqa: ARG001
) -> Generator[int, None, None]:
    """As that of `generate`, whose processes take a second to start."""
    for shard in shards:
        generation.make_shard(recipe, folder, shard)
        yield shard


def _be_killed(out: Path, draws: Draws) -> bool:
    """Generate in a process that is killed at a random place; whether it was."""
    if draws.random() < 0.5:
        seconds = draws.uniform(1e-3, SECONDS)
        return _in_process(out, lambda: signal.setitimer(signal.ITIMER_PROF, seconds) and None)
    left = draws.randrange(OPERATIONS)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal left
        if event in _EVENTS and str(out) in str(arguments):
            left -= 1
            if left < 0:
                os.kill(os.getpid(), signal.SIGKILL)

    return _in_process(out, lambda: sys.addaudithook(hook))
