"""Flipped bits and cut files at random places, and who notices."""

import multiprocessing
import shutil
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np

from eitskin.benchmarks.studies.crash_runs import Row
from eitskin.datasets.generation.generate import generate
from eitskin.datasets.generation.verification import verify
from eitskin.datasets.recipe.recipe import Recipe
from eitskin.datasets.recipe.scene_group import SceneGroup
from eitskin.datasets.store.folder import open_dataset
from eitskin.datasets.store.schema import FIELDS
from eitskin.datasets.store.shard import read_shard
from eitskin.errors import DataError

# Shards of the usual length: small ones are mostly HDF5's own, unused space.
RECIPE = Recipe("damage", seed=7, frames_per_shard=256, scenes=(SceneGroup("idle", count=3 * 256),))


def damage(place: Path, trials: int, seed: int) -> list[Row]:
    """Flip a bit, or cut a shard, in turn; ask `verify`, the whole set, and the lone shard."""
    rng = np.random.default_rng(seed)
    sound, folder = place / "sound", place / "damaged"
    generate(RECIPE, sound, workers=1)
    shutil.copytree(sound, folder)
    paths = sorted(folder.glob("shard-*.h5"))
    found, lone = Counter[str](), Counter[tuple[str, str]]()
    for trial in range(trials):
        path = paths[int(rng.integers(len(paths)))]
        whole = path.read_bytes()
        kind = "flip" if trial % 2 else "cut"
        path.write_bytes(_damaged(whole, kind, rng))
        found["verify"] += [each.file for each in verify(folder).damage] == [path.name]
        found["manifest"] += _refused(folder)
        lone[kind, _lone(path, sound / path.name)] += 1
        path.write_bytes(whole)
    return [
        Row("damaged shard named by verify", trials, found["verify"], "half cut, half flipped"),
        Row("damaged shard refused when the set is opened", trials, found["manifest"], ""),
        *(_lone_row(kind, lone) for kind in ("cut", "flip")),
    ]


def _damaged(whole: bytes, kind: str, rng: np.random.Generator) -> bytes:
    place = int(rng.integers(len(whole)))
    if kind == "cut":
        return whole[:place]
    broken = bytearray(whole)
    broken[place] ^= 1 << int(rng.integers(8))
    return bytes(broken)


def _refused(folder: Path) -> bool:
    try:
        open_dataset(folder)
    except DataError:
        return True
    return False


def _lone(path: Path, sound: Path) -> str:
    """What becomes of a damaged shard without a manifest, read in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
        try:
            return pool.submit(_read_lone, path, sound).result(timeout=60)
        except BrokenProcessPool:
            return "reader crashed"


def _read_lone(path: Path, sound: Path) -> str:
    try:
        data = read_shard(path)
    except DataError:
        return "refused"
    whole = read_shard(sound)
    same = all(
        np.array_equal(
            getattr(data, field.name),
            getattr(whole, field.name),
            equal_nan=field.dtype.kind in "fc",
        )
        for field in FIELDS
    )
    labels = ("protocol", "frequency", "source", "recipe", "seed", "design")
    same = same and all(getattr(data, name) == getattr(whole, name) for name in labels)
    return "without effect" if same else "read as other values"


def _lone_row(kind: str, lone: Mapping[tuple[str, str], int]) -> Row:
    """A lone shard keeps its promise where it is refused, or reads as what was written."""
    counts = {outcome: n for (of, outcome), n in lone.items() if of == kind}
    good = counts.get("refused", 0) + counts.get("without effect", 0)
    remark = ", ".join(f"{n} {outcome}" for outcome, n in sorted(counts.items()))
    name = {"cut": "cut", "flip": "one bit flipped"}[kind]
    what = f"lone shard without a manifest, {name}: refused or unchanged"
    return Row(what, sum(counts.values()), good, remark)
