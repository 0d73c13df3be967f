"""Real runs of `eitskin generate`, to be killed and starved by the crash benchmark."""

import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup

COMMAND = "from eitskin.cli.main import run; run()"
# Cheap shards: a killed run is to have many of them, finished and not.
RECIPE = Recipe(
    "crashes",
    seed=7,
    frames_per_shard=4,
    scenes=(
        SceneGroup("idle", count=24),
        SceneGroup("bend", count=24, angle_deg=(-20.0, 50.0)),
    ),
)


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table: what was tried, how often, how often it went as promised."""

    what: str
    tried: int
    as_promised: int
    remark: str


def contents(folder: Path) -> dict[str, bytes]:
    """Every file in `folder` by name, but for what killed writers left half-written."""
    return {
        path.name: path.read_bytes()
        for path in sorted(folder.iterdir())
        if not path.name.startswith(".")
    }


def shards(folder: Path) -> frozenset[str]:
    """Names of the shards in `folder`, which need not exist."""
    return frozenset(path.name for path in folder.glob("shard-*.h5"))


def intact(folder: Path, whole: Mapping[str, bytes]) -> bool:
    """Whether each shard that lies there is, byte for byte, that of the whole set."""
    return all((folder / name).read_bytes() == whole[name] for name in shards(folder))


def start(
    recipe: Path, out: Path, *options: str, environment: Mapping[str, str] | None = None
) -> subprocess.Popen[str]:
    """Start `eitskin generate` in a process of its own."""
    given = ("generate", str(recipe), "--out", str(out), "--quiet", *options)
    return subprocess.Popen(  # noqa: S603 - this interpreter, and paths of our own
        [sys.executable, "-c", COMMAND, *given],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def finish(run: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and what was said on stderr."""
    _, said = run.communicate(timeout=300)
    return run.returncode, said


def workers_of(run: subprocess.Popen[str]) -> list[int]:
    """Process numbers of the workers that a run has started, as Linux tells them."""
    try:
        children = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
        return [
            int(child)
            for child in children
            if b"multiprocessing.spawn" in Path(f"/proc/{child}/cmdline").read_bytes()
        ]
    except FileNotFoundError:  # it has ended in between
        return []
