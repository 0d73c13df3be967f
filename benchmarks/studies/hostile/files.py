"""Hostile files that are not text: shards, saved pipelines, recordings, surfaces, tables."""

import contextlib
import functools
import hashlib
import io
import random
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.io import savemat

from eitskin.benchmarks.studies.hostile.mutations import damaged, misworded
from eitskin.benchmarks.studies.hostile.parsers import small_dataset
from eitskin.benchmarks.studies.hostile.texts import Draws, Trial, broken_json
from eitskin.datasets.recordings.form import RecordingNames
from eitskin.datasets.recordings.recording import read_recording
from eitskin.datasets.store.seal import sealed, unsealed
from eitskin.datasets.store.shard import shard_bytes
from eitskin.datasets.store.shard_reader import shard_of
from eitskin.geometry.design.surface import Surface
from eitskin.hardware.boards.replay_board import ReplayBoard
from eitskin.simulator.mechanics import solved_files
from eitskin.training.adaptation.opening import open_pipeline
from eitskin.training.adaptation.recorded_touches import RecordedTouches
from eitskin.training.pipeline.saved_form import SHIPPED, SUMS

PARTS = ("pipeline.json", "weights.safetensors", "golden.safetensors", SUMS)
SURFACES = ("stl", "obj", "ply")


def files() -> Mapping[str, Trial]:
    """Trials of files by kind."""
    found: dict[str, Trial] = {
        "shards (HDF5)": _shard,
        "replayed recordings (HDF5)": _replay,
        "tables kept on the disk (npz)": _kept,
    }
    for part in PARTS:
        found[f"saved pipelines: {part}"] = _model(SHIPPED, part)
        found[f"saved touch positions: {part}"] = _positions(part)
    found |= {f"recordings: {ending}": _recording(ending) for ending in _recordings()}
    return found | {f"surfaces: {ending}": _surface(ending) for ending in SURFACES}


@functools.lru_cache
def _good_shard() -> bytes:
    return shard_bytes(small_dataset())


def _broken_shard(rng: random.Random) -> bytes:
    """Shard, damaged before it was sealed, after, or without its seal."""
    content = _good_shard()
    image, _ = unsealed(content)
    choice = rng.randrange(3)
    broken = damaged(rng, image if choice else content)
    return sealed(broken) if choice == 1 else broken


def _shard(rng: Draws, folder: Path) -> object:
    return shard_of(_broken_shard(rng), folder / "shard.h5")


def _replay(rng: Draws, folder: Path) -> object:
    """Recording, replayed to its end."""
    path = folder / "replayed.h5"
    path.write_bytes(_broken_shard(rng))
    with ReplayBoard(str(path)) as board:
        return list(board.frames())


def _model(good: Path, part: str) -> Trial:
    def trial(rng: Draws, folder: Path) -> object:
        path = folder / f"broken-{good.name}"
        if not path.exists():
            shutil.copytree(good, path)
        content = (good / part).read_bytes()
        _write_part(path, part, _broken_part(rng, part, content))
        try:
            return open_pipeline(path)
        finally:
            for name in (part, SUMS):
                shutil.copyfile(good / name, path / name)

    return trial


def _broken_part(rng: random.Random, part: str, content: bytes) -> bytes:
    """Part of a saved pipeline, damaged; the head of arrays more often than their values."""
    if part.endswith(".json"):
        return broken_json(rng, content)
    head = 8 + int.from_bytes(content[:8], "little")
    if part != SUMS and rng.random() < 0.7:
        return damaged(rng, content[:head]) + content[head:]
    return damaged(rng, content)


def _write_part(path: Path, part: str, content: bytes) -> None:
    """Write a part and make the sums right again, unless it is the sums."""
    (path / part).write_bytes(content)
    if part == SUMS:
        return
    lines = (path / SUMS).read_text(encoding="utf-8").splitlines()
    digest = hashlib.sha256(content).hexdigest()
    changed = [digest + line[64:] if line.endswith(f"  {part}") else line for line in lines]
    (path / SUMS).write_text("\n".join(changed) + "\n", encoding="utf-8")


def _positions(part: str) -> Trial:
    def trial(rng: Draws, folder: Path) -> object:
        good = folder / "positions.eitmodel"
        if not good.exists():
            path = folder / "labelled.npz"
            path.write_bytes(_recordings()["npz"])
            RecordedTouches.fit(read_recording(path, RecordingNames("v"))).save(good)
        return _model(good, part)(rng, folder)

    return trial


def _kept(rng: Draws, folder: Path) -> object:
    """Table of solutions, kept on the disk by an earlier run: solved again where it is damaged."""
    path = folder / "table.npz"
    made = io.BytesIO()
    rows = np.arange(300.0).reshape(20, 15)
    np.savez_compressed(made, allow_pickle=False, rows=rows, scale=np.float64(2.0))
    path.write_bytes(damaged(rng, made.getvalue()))
    return solved_files.read(path)


@functools.lru_cache
def _recordings() -> dict[str, bytes]:
    """Content of good recordings by ending."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0.01, 0.09, 12), rng.uniform(0.01, 0.05, 12)
    values = 500 + 1000 * np.stack([x, y, x * y, np.ones(12)], 1)
    tables = {"v": values, "x": x, "y": y, "force": np.full(12, 2.0), "state": np.ones(12)}
    made: dict[str, Any] = {ending: io.BytesIO() for ending in ("npz", "mat", "h5")}
    np.savez(made["npz"], allow_pickle=False, **tables)
    savemat(made["mat"], tables, do_compression=True)
    with h5py.File(made["h5"], "w") as file:
        for name, table in tables.items():
            file[name] = table
    contents = {ending: file.getvalue() for ending, file in made.items()}
    header = ["v0", "v1", "v2", "v3", "x", "y", "force", "state"]
    rows = np.column_stack([values, x, y, tables["force"], tables["state"]])
    lines = [header, *([str(cell) for cell in row] for row in rows.tolist())]
    contents["csv"] = "\n".join(map(",".join, lines)).encode()
    contents["tsv"] = "\n".join(map("\t".join, lines)).encode()
    openeit = (" , ".join(f"{cell:.3f}" for cell in row) for row in values)
    contents["txt"] = "\n".join(f"magnitudes : {line}" for line in openeit).encode()
    with contextlib.suppress(ImportError):
        contents["xlsx"] = _workbook(lines)
    with contextlib.suppress(ImportError):
        contents["parquet"] = _parquet(header, rows)
    return contents


def _workbook(lines: list[list[str]]) -> bytes:
    from openpyxl import Workbook

    book, out = Workbook(), io.BytesIO()
    for row in lines:
        book.active.append(row)
    book.save(out)
    return out.getvalue()


def _parquet(header: list[str], rows: Any) -> bytes:
    import pyarrow
    import pyarrow.parquet

    out = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table(list(rows.T), names=header), out)
    return out.getvalue()


def _recording(ending: str) -> Trial:
    text = ending in {"csv", "tsv", "txt"}

    def trial(rng: Draws, folder: Path) -> object:
        good = _recordings()[ending]
        worded = text and rng.random() < 0.6
        path = folder / f"recording.{ending}"
        path.write_bytes(
            misworded(rng, good.decode()).encode() if worded else _repacked(rng, ending, good)
        )
        return read_recording(path, RecordingNames("magnitudes" if ending == "txt" else "v"))

    return trial


def _repacked(rng: random.Random, ending: str, good: bytes) -> bytes:
    """Content damaged; of a ZIP file, half of the time the content of a member."""
    import zipfile

    if ending not in {"npz", "xlsx"} or rng.random() < 0.5:
        return damaged(rng, good)
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(good)) as old, zipfile.ZipFile(out, "w") as new:
        names = old.namelist()
        chosen = rng.choice(names)
        for name in names:
            content = old.read(name)
            new.writestr(name, damaged(rng, content) if name == chosen else content)
    return out.getvalue()


@functools.lru_cache
def _surfaces() -> dict[str, bytes]:
    """Content of the surface of a box by ending."""
    import trimesh

    box = trimesh.creation.box((0.1, 0.06, 0.01))
    made = {ending: box.export(file_type=ending) for ending in SURFACES}
    return {name: each.encode() if isinstance(each, str) else each for name, each in made.items()}


def _surface(ending: str) -> Trial:
    def trial(rng: Draws, folder: Path) -> object:
        path = folder / f"surface-{rng.random()}.{ending}"
        good = _surfaces()[ending]
        worded = ending == "obj" and rng.random() < 0.6
        path.write_bytes(misworded(rng, good.decode()).encode() if worded else damaged(rng, good))
        try:
            return Surface(path)
        finally:
            path.unlink()

    return trial
