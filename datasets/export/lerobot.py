"""Episodes of a dataset in the LeRobot format, version 3.0.

The format is that of github.com/huggingface/lerobot: many episodes to a Parquet file, and the
folder `meta` with what describes them. Inputs are named observation.*, labels label.*; there are no
actions, since a skin takes none.
"""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.export.episode_table import EpisodeTable, Integers
from eitskin.datasets.export.statistics import RunningStatistics
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import Progress, read_shards
from eitskin.datasets.store.schema import MAX_TOUCHES
from eitskin.extras import require

VERSION = "v3.0"
TASK = "feel bends and touches"
FILE_MEGABYTES, CHUNK_FILES = 100, 1000
_TOUCH = ("x", "y", "force", "radius", "depth")
_OBSERVED = ("impedance", "reference")


def write_lerobot(
    folder: Path, out: Path, data: Dataset, splits: dict[int, str], progress: Progress | None
) -> dict[str, int]:
    """Write the episodes of a dataset into a folder; returns the frames of each split.

    Args:
        folder: of the dataset.
        out: folder that exists.
        data: the dataset, whose columns are read as they are needed.
        splits: split of each specimen, by its number.
        progress: called with the number of shards read and of all shards, for each split.

    Raises DataError where no frames follow each other in time.
    """
    table = EpisodeTable.of(data, splits)
    features = _features(data)
    row_bytes = sum(
        np.dtype(each["dtype"]).itemsize * each["shape"][0] for each in features.values()
    )
    files = table.files(max(1, FILE_MEGABYTES * 2**20 // row_bytes))
    statistics = _write_frames(folder, out, table, files, progress)
    meta = out / "meta"
    _write_episodes(meta / "episodes" / "chunk-000" / "file-000.parquet", table, files)
    _write_tasks(meta / "tasks.parquet")
    _write_json(meta / "stats.json", statistics)
    ranges = table.ranges()
    info = {
        "codebase_version": VERSION,
        "robot_type": "eitskin",
        "total_episodes": len(table),
        "total_frames": int(table.length.sum()),
        "total_tasks": 1,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": FILE_MEGABYTES,
        "video_files_size_in_mb": 2 * FILE_MEGABYTES,
        "fps": 1.0 / table.period,
        "splits": {name: f"{start}:{stop}" for name, (start, stop) in ranges.items()},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }
    _write_json(meta / "info.json", info)
    return {name: int(table.length[start:stop].sum()) for name, (start, stop) in ranges.items()}


def _features(data: Dataset) -> dict[str, dict[str, Any]]:
    """Features of a frame, as meta/info.json has them."""
    labels = None if data.protocol is None else list(data.protocol.labels)
    touches = [f"{name}_{number}" for number in range(MAX_TOUCHES) for name in _TOUCH]

    def feature(dtype: str, length: int = 1, names: list[str] | None = None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": [length], "names": names}

    return {
        **{
            f"observation.{name}_{part}": feature("float32", data.channels, labels)
            for name in _OBSERVED
            for part in ("real", "imag")
        },
        "label.state": feature("int64"),
        "label.bend_angle_deg": feature("float32"),
        "label.touches": feature("float32", len(touches), touches),
        "timestamp": feature("float32"),
        **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), feature("int64")),
    }


def _write_frames(
    folder: Path, out: Path, table: EpisodeTable, files: Integers, progress: Progress | None
) -> dict[str, Any]:
    """Write the files of frames; returns the statistics of all that is always known."""
    statistics: dict[str, RunningStatistics] = {}
    with contextlib.ExitStack() as stack:
        writer: Any = None
        number = -1
        for file, columns in _file_pieces(folder, table, files, progress):
            frames = _arrow_table(columns)
            if file != number:
                stack.close()
                writer, number = _open_writer(out / _data_path(file), frames.schema), file
                stack.callback(writer.close)
            writer.write_table(frames)
            for name, values in columns.items():
                if not name.startswith("label."):
                    rows = values.reshape(len(values), -1)
                    statistics.setdefault(name, RunningStatistics()).add(rows)
    return {name: each.document() for name, each in statistics.items()}


def _open_writer(path: Path, schema: Any) -> Any:
    path.parent.mkdir(parents=True, exist_ok=True)
    return require("pyarrow.parquet", "recordings").ParquetWriter(path, schema)


def _file_pieces(
    folder: Path, table: EpisodeTable, files: Integers, progress: Progress | None
) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
    """File numbers, rising, and the columns of frames that come next in each."""
    for split in table.ranges():
        for episode, columns in _pieces(folder, table, split, progress):
            for file in np.unique(files[episode]).tolist():
                rows = files[episode] == file
                yield file, {name: values[rows] for name, values in columns.items()}


def _pieces(
    folder: Path, table: EpisodeTable, split: str, progress: Progress | None
) -> Iterator[tuple[Integers, dict[str, NDArray[Any]]]]:
    """Episodes of the frames of one split (n,), and their columns, shard by shard."""
    begun = 0
    start, stop = table.ranges()[split]
    for part in read_shards(folder, progress):
        rows = slice(begun, begun + len(part))
        begun += len(part)
        episode = table.of_frame[rows]
        chosen = np.flatnonzero((episode >= start) & (episode < stop))
        if len(chosen):
            episode, within = episode[chosen], table.within[rows][chosen]
            columns = _columns(part.select(chosen))
            columns |= {
                "frame_index": within,
                "episode_index": episode,
                "index": table.first[episode] + within,
                "task_index": np.zeros(len(chosen), dtype=np.int64),
            }
            yield episode, columns


def _columns(data: Dataset) -> dict[str, NDArray[Any]]:
    reference = data.reference[data.specimen]
    known = [getattr(data, f"touch_{name}") for name in _TOUCH]
    return {
        "observation.impedance_real": data.impedance.real,
        "observation.impedance_imag": data.impedance.imag,
        "observation.reference_real": reference.real,
        "observation.reference_imag": reference.imag,
        "label.state": data.state.astype(np.int64),
        "label.bend_angle_deg": data.bend_angle_deg,
        "label.touches": np.stack(known, axis=2).reshape(len(data), -1),
        "timestamp": data.time.astype(np.float32),
    }


def _arrow_table(columns: dict[str, NDArray[Any]]) -> Any:
    arrow = require("pyarrow", "recordings")
    arrays = {}
    for name, values in columns.items():
        flat = arrow.array(np.ascontiguousarray(values).reshape(-1))
        lists = values.ndim > 1 and values.shape[1] > 1
        arrays[name] = (
            arrow.FixedSizeListArray.from_arrays(flat, values.shape[1]) if lists else flat
        )
    return arrow.table(arrays)


def _data_path(file: int) -> str:
    chunk, number = divmod(file, CHUNK_FILES)
    return f"data/chunk-{chunk:03d}/file-{number:03d}.parquet"


def _write_episodes(path: Path, table: EpisodeTable, files: Integers) -> None:
    arrow, parquet = require("pyarrow", "recordings"), require("pyarrow.parquet", "recordings")
    path.parent.mkdir(parents=True, exist_ok=True)
    zeros = np.zeros(len(table), dtype=np.int64)
    columns = {
        "episode_index": np.arange(len(table)),
        "tasks": [[TASK]] * len(table),
        "length": table.length,
        "data/chunk_index": files // CHUNK_FILES,
        "data/file_index": files % CHUNK_FILES,
        "dataset_from_index": table.first,
        "dataset_to_index": table.first + table.length,
        "meta/episodes/chunk_index": zeros,
        "meta/episodes/file_index": zeros,
        "split": table.split.tolist(),
        "specimen": table.specimen,
        "episode": table.number,
    }
    parquet.write_table(arrow.table(columns), path)


def _write_tasks(path: Path) -> None:
    """Write the table of tasks, whose index pandas is to find in the column `task`."""
    arrow, parquet = require("pyarrow", "recordings"), require("pyarrow.parquet", "recordings")
    table = arrow.table({"task_index": [0], "task": [TASK]})

    def column(name: str, pandas_type: str, numpy_type: str) -> dict[str, Any]:
        kinds = {"pandas_type": pandas_type, "numpy_type": numpy_type, "metadata": None}
        return {"name": name, "field_name": name, **kinds}

    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column("task_index", "int64", "int64"), column("task", "unicode", "object")],
    }
    parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(described)}), path)


def _write_json(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
