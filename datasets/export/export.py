"""Export of a dataset to a folder that other programs read, with a card of its content."""

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import numpy as np

from eitskin.datasets.export.frame_table import (
    FILE_BYTES,
    SPLITS,
    TOUCH_FIELDS,
    Column,
    columns,
    frame_table,
    origin,
    specimen_splits,
    write_parquet,
)
from eitskin.datasets.export.lerobot import write_lerobot
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import Progress, new_folder, open_dataset, read_shards
from eitskin.datasets.store.schema import State
from eitskin.errors import ConfigurationError, PartialError
from eitskin.extras import require
from eitskin.files import atomic_folder

FORMATS: Final = ("parquet", "huggingface", "lerobot")
SUMS: Final = "SHA256SUMS"
_REMEDY = "make room or give write permission, then export again; nothing was left behind"

PAPER = """@article{chen2026multitouch,
  title = {Multi-Touch and Bending Sensing Using Electrical Impedance Tomography for Robotics},
  author = {Chen, Haofeng and Himmel, Bedrich and Li, Bin and Wang, Xiaojie and Hoffmann, Matej},
  journal = {IEEE Robotics and Automation Letters},
  volume = {11},
  number = {8},
  pages = {9851--9858},
  year = {2026},
  doi = {10.1109/LRA.2026.3709063}
}"""
_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"))


@dataclass(frozen=True, slots=True)
class ExportSummary:
    """Frames of each split that has any, number of files, and their size together [bytes]."""

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
) -> ExportSummary:
    """Write a dataset in a format of other programs; docs/how-to/generate-data.md has the formats.

    The dataset is read a shard at a time, and each of its files is verified. The new folder appears
    when it is complete: after an error or Ctrl-C nothing is left. Equal datasets give equal bytes,
    with the same versions of eitskin and pyarrow.

    Args:
        folder: folder of the dataset.
        out: folder to write, new or empty.
        form: "parquet", "huggingface" or "lerobot".
        license_name: identifier of a licence as Hugging Face has them, for the card.
        progress: called with the number of shards read and of all shards, for each split.
        file_bytes: size in memory of the rows of one Parquet file [bytes].

    Raises:
        ImportError: naming the extra, where pyarrow is missing.
        ConfigurationError: where `out` holds something, or for another format or licence.
        DataError: for a dataset that is not complete or damaged, or without episodes for LeRobot.
        PartialError: where a file cannot be written.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, State, export_dataset, save_dataset
        >>> data = Dataset.from_arrays(np.full((4, 28), 600.0), state=np.full(4, State.IDLE))
        >>> _ = save_dataset(data, "to_export")
        >>> export_dataset("to_export", "parquet", "parquet").frames["train"]
        4
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
            shown = tuple(columns(data)) if form == "huggingface" else ()
            text = card(folder.resolve().name, license_name, sizes, data, shown)
            (temporary / "README.md").write_text(text, encoding="utf-8")
        files, size = _write_sums(temporary)
    return ExportSummary({name: count for name, (count, _) in sizes.items()}, files, size)


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
    origin_text = json.dumps(origin(data))
    numbers = data.specimen_number[data.specimen].tolist()
    frames = Counter(splits[number] for number in numbers)

    def tables(name: str | None) -> Iterator[Any]:
        """Tables of the frames of a split, or of all with a column of splits."""
        for part in read_shards(folder, progress):
            split = np.array([splits[number] for number in part.specimen_number.tolist()])
            split = split[part.specimen]
            if name is None:
                yield frame_table(part, origin_text, split)
            elif (split == name).any():
                yield frame_table(part.select(split == name), origin_text)

    if form == "parquet":
        write_parquet(tables(None), out, "frames", file_bytes)
        return {name: (frames[name], 0) for name in SPLITS if frames[name]}
    return {
        name: (frames[name], write_parquet(tables(name), out, name, file_bytes))
        for name in SPLITS
        if frames[name]
    }


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


Sizes = Mapping[str, tuple[int, int]]
"""Frames and size in memory [bytes] of each split."""


def card(
    title: str, license_name: str, sizes: Sizes, data: Dataset, shown: Sequence[Column]
) -> str:
    """Content of README.md: a dataset card.

    `license_name` is an identifier of Hugging Face, such as cc-by-4.0; `shown` are the columns of
    the table of frames, none for episodes.
    """
    version, frames = metadata.version("eitskin"), sum(count for count, _ in sizes.values())
    origin_text = "measured, and exported" if data.source == "measured" else "simulated"
    electrodes = f"{data.protocol.n_electrodes} electrodes, " if data.protocol else ""
    of_what = data.quantity or "values of a kind that the recording does not name"
    counts = "\n".join(f"| {name} | {count} |" for name, (count, _) in sizes.items())
    return f"""{_front_matter(license_name, sizes, shown)}
# {title}

Frames of electrical-impedance robot skin, {origin_text} by eitskin {version}. {frames} frames; \
{electrodes}{data.frequency:g} Hz; {of_what}. SI units; degrees where a name ends in `_deg`. \
Places are those of the flat sensor, from a corner of its conductive layer.

{_list_columns(shown) if shown else _EPISODES}

## Splits

By specimen: no sensor is in two splits. The split of a specimen follows from a hash of its name, \
or of the seed and its number, and not from the other frames.

| split | frames |
|---|---|
{counts}

{_describe_recipe(data)}

## Checksums

`sha256sum -c SHA256SUMS` compares every file with what was written.

## Citation

```bibtex
@software{{eitskin,
  title = {{eitskin: a simulator of electrical-impedance robot skin}},
  author = {{{{The eitskin authors}}}},
  version = {{{version}}},
  year = {{2026}}
}}

{PAPER}
```
"""


def _front_matter(license_name: str, sizes: Sizes, shown: Sequence[Column]) -> str:
    """YAML between dashes; only names that need no quotes come into it."""
    frames = sum(count for count, _ in sizes.values())
    size = next((name for most, name in _SIZES if frames < most), "n>1M")
    tags = ["tactile", "electrical-impedance-tomography", "robot-skin"]
    tags += [] if shown else ["LeRobot"]
    lines = ["---", f"license: {license_name}", "task_categories:", "- robotics", "tags:"]
    lines += [f"- {tag}" for tag in tags]
    lines += ["size_categories:", f"- {size}", "configs:", "- config_name: default"]
    if not shown:
        return "\n".join([*lines, "  data_files: data/*/*.parquet", "---", ""])
    lines.append("  data_files:")
    for name in sizes:
        lines += [f"  - split: {name}", f"    path: data/{name}-*"]
    lines += ["dataset_info:", "  features:"]
    lines += [f"  {line}" for column in shown for line in _feature(column)]
    lines.append("  splits:")
    for name, (count, size_bytes) in sizes.items():
        lines += [f"  - name: {name}", f"    num_bytes: {size_bytes}"]
        lines.append(f"    num_examples: {count}")
    return "\n".join([*lines, "---", ""])


def _list_columns(shown: Sequence[Column]) -> str:
    lines = ["## Columns", "", "| column | type | units | content |", "|---|---|---|---|"]
    for each in shown:
        kind = f"{each.kind} x {each.length}" if each.length else each.kind
        if each.kind == "touches":
            kind = f"list of ({', '.join(TOUCH_FIELDS)})"
        lines.append(f"| `{each.name}` | {kind} | {each.units} | {each.description} |")
    return "\n".join(lines)


def _describe_recipe(data: Dataset) -> str:
    if not data.recipe:
        return "## Origin\n\nRecorded; there is no recipe that makes these frames again."
    return (
        "## Recipe\n\n`recipe.toml` makes these frames again: "
        f"`eitskin generate recipe.toml --out SET`, with seed {data.seed}.\n\n"
        f"```toml\n{data.recipe.strip()}\n```"
    )


_EPISODES = """## Features

`meta/info.json` names the features of a frame: `observation.*` is what a board measures and the
flat sensor it is compared with, `label.*` the truth. In labels NaN is unknown or absent, and state
255 unknown. There are no actions. `timestamp` is the time since the episode began [s]; `fps` is one
over the usual interval. `meta/episodes` has the specimen and the split of each episode."""


def _feature(column: Column) -> list[str]:
    """Lines of YAML for a column, as the package `datasets` describes features."""
    head = f"- name: {column.name}"
    if column.kind == "touches":
        inner = [
            line for name in TOUCH_FIELDS for line in (f"  - name: {name}", "    dtype: float32")
        ]
        return [head, "  list:", *inner]
    if column.name == "state":
        names = [f"        '{int(state)}': {state.name.lower()}" for state in State]
        return [head, "  dtype:", "    class_label:", "      names:", *names]
    if column.length:
        return [head, f"  list: {column.kind}", f"  length: {column.length}"]
    return [head, f"  dtype: {'string' if column.kind == 'text' else column.kind}"]
