"""Export of a dataset to a folder that other programs read."""

import contextlib
import hashlib
import json
import re
from collections import Counter
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import numpy as np

from eitskin.datasets.export.card import Card
from eitskin.datasets.export.frame_table import (
    FILE_BYTES,
    ParquetFiles,
    columns,
    frame_table,
    origin,
)
from eitskin.datasets.export.lerobot import write_lerobot
from eitskin.datasets.export.splits import SPLITS, specimen_splits
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import Progress, new_folder, open_dataset, read_shards
from eitskin.errors import ConfigurationError, PartialError
from eitskin.extras import require
from eitskin.files import atomic_folder

FORMATS: Final = ("parquet", "huggingface", "lerobot")
SUMS: Final = "SHA256SUMS"
_REMEDY = "make room or give write permission, then export again; nothing was left behind"


@dataclass(frozen=True, slots=True)
class Exported:
    """Files and frames that an export wrote.

    Attributes:
        frames: of each split that has any.
        files: number of files.
        size: of all files [bytes].
    """

    frames: dict[str, int]
    files: int
    size: int


def export_dataset(
    folder: str | Path,
    out: str | Path,
    form: str,
    license_name: str = "unknown",
    progress: Progress | None = None,
    file_bytes: int = FILE_BYTES,
) -> Exported:
    """Write a dataset in a format of other programs; docs/interoperability.md has the formats.

    The dataset is read a shard at a time, and each of its files is verified. The new folder appears
    when it is complete: after an error or Ctrl-C nothing is left. Equal datasets give equal bytes,
    with the same versions of eitskin and pyarrow.

    Args:
        folder: of the dataset.
        out: folder to write, new or empty.
        form: "parquet", "huggingface" or "lerobot".
        license_name: identifier of a licence as Hugging Face has them, for the card.
        progress: called with the number of shards read and of all shards.
        file_bytes: size in memory of the rows of one Parquet file [bytes].

    Raises:
        ImportError: naming the extra, where pyarrow is missing.
        ConfigurationError: where `out` holds something, or for another format or licence.
        DataError: for a dataset that is not complete or damaged, or without episodes for LeRobot.
        PartialError: where a file cannot be written.
    """
    require("pyarrow", "recordings")
    if form not in FORMATS:
        raise ConfigurationError(f"the format must be one of {', '.join(FORMATS)}, got '{form}'")
    if not re.fullmatch(r"[a-z0-9][a-z0-9.+-]*", license_name):
        raise ConfigurationError(
            "a licence must be an identifier such as cc-by-4.0 or mit, in small letters, got "
            f"'{license_name}'"
        )
    folder = Path(folder)
    data = open_dataset(folder)
    splits = specimen_splits(data.specimen_number.tolist(), data.names, data.seed)
    out = new_folder(Path(out))
    out.rmdir()  # until it is complete
    with atomic_folder(out, PartialError, _REMEDY) as temporary:
        if form == "lerobot":
            frames = write_lerobot(folder, temporary, data, splits, progress)
            sizes = {name: (count, 0) for name, count in frames.items()}
        else:
            sizes = _write_frames(
                folder, temporary / "data", data, splits, form, progress, file_bytes
            )
        if data.recipe:
            (temporary / "recipe.toml").write_text(data.recipe, encoding="utf-8")
        if form != "parquet":
            shown = columns(data) if form == "huggingface" else ()
            card = Card(
                folder.resolve().name,
                license_name,
                sizes,
                origin(data),
                data.recipe,
                shown,
                metadata.version("eitskin"),
            )
            (temporary / "README.md").write_text(card.text(), encoding="utf-8")
        files, size = _write_sums(temporary)
    return Exported({name: count for name, (count, _) in sizes.items()}, files, size)


def _write_frames(
    folder: Path,
    out: Path,
    data: Dataset,
    splits: dict[int, str],
    form: str,
    progress: Progress | None,
    file_bytes: int,
) -> dict[str, tuple[int, int]]:
    """Write all frames as rows; returns frames and size in memory [bytes] of each split."""
    out.mkdir()
    told = json.dumps(origin(data))
    frames: Counter[str] = Counter()
    writers: dict[str, ParquetFiles] = {}
    with contextlib.ExitStack() as stack:

        def write(stem: str, table: Any) -> None:
            if stem not in writers:
                writers[stem] = ParquetFiles(out, stem, file_bytes)
                stack.callback(writers[stem].abandon)
            writers[stem].write(table)

        for part in read_shards(folder, progress):
            split = np.array([splits[number] for number in part.specimen_number.tolist()])
            split = split[part.specimen]
            frames.update(split.tolist())
            if form == "parquet":
                write("frames", frame_table(part, told, split))
                continue
            for name in np.unique(split).tolist():
                write(name, frame_table(part.select(np.flatnonzero(split == name)), told))
        for each in writers.values():
            each.close()
    sizes = {name: writers[name].size if name in writers else 0 for name in frames}
    return {name: (frames[name], sizes[name]) for name in SPLITS if frames[name]}


def _write_sums(folder: Path) -> tuple[int, int]:
    """Write SHA-256 of every file in a folder; returns number and size [bytes] of all files."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    lines = []
    for path in paths:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        lines.append(f"{digest}  {path.relative_to(folder).as_posix()}\n")
    (folder / SUMS).write_text("".join(lines), encoding="utf-8")
    return len(paths) + 1, sum(path.stat().st_size for path in [*paths, folder / SUMS])
