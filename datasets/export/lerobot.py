"""Episodes of a dataset in the LeRobot format, version 3.0.

The format is that of github.com/huggingface/lerobot: many episodes to a Parquet file, and the
folder `meta` with what describes them. Inputs are named observation.*, labels label.*; there are no
actions, since a skin takes none.
"""

import contextlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.export.frame_table import SPLITS, TOUCH_FIELDS
from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import Progress, read_shards
from eitskin.datasets.store.schema import MAX_TOUCHES
from eitskin.errors import DataError
from eitskin.extras import require

if TYPE_CHECKING:
    import pandas as pd

VERSION = "v3.0"
TASK = "feel bends and touches"
FILE_MEGABYTES, CHUNK_FILES = 100, 1000
MIN_FRAMES = 2

Integers = NDArray[np.int64]
Columns = dict[str, NDArray[Any]]


class Episodes:
    """Episodes of at least two frames, those of each split after each other.

    Attributes:
        table: length, specimen and split of each episode, its number in the dataset, and that of
            its first frame among those exported.
        of_frame: row of the table for each frame of the dataset, (n,); -1 for single frames.
        within: number of each frame within its episode, (n,).
        period: usual time from one frame to the next [s].
    """

    def __init__(self, data: Dataset, splits: dict[int, str]) -> None:
        """Find the episodes; raises DataError where no two frames follow each other in time."""
        import pandas as pd

        data.read("episode", "time", "specimen")  # of a large dataset, in one pass
        frames = pd.DataFrame({"episode": data.episode.astype(np.int64), "time": data.time})
        frames["specimen"] = data.specimen_number[data.specimen].astype(np.int64)
        run = frames[["episode", "specimen"]].diff().ne(0).any(axis=1).cumsum()
        groups = frames.groupby(run)
        table = groups[["specimen", "episode"]].first().assign(length=groups.size())
        kind = pd.CategoricalDtype(list(SPLITS), ordered=True)
        table["split"] = table["specimen"].map(splits).astype(kind)
        single = len(table)
        table = table[table["length"] >= MIN_FRAMES].sort_values("split", kind="stable")
        if table.empty:
            raise DataError(
                f"expected episodes of at least {MIN_FRAMES} frames, got {single} single "
                "frames; export them with --format parquet or huggingface, or generate a recipe "
                "with [[episodes]]"
            )
        self.period = float(groups["time"].diff().median())
        if not self.period > 0.0:
            raise DataError(
                f"expected frames with times that rise, got a median interval of {self.period:g} "
                "s; import the recording with its column of times"
            )
        rows = pd.Series(range(len(table)), index=table.index)
        self.of_frame: Integers = run.map(rows).fillna(-1).to_numpy(np.int64)
        self.within: Integers = groups.cumcount().to_numpy(np.int64)
        table["first"] = table["length"].cumsum() - table["length"]
        self.table = table.reset_index(drop=True)

    def splits(self) -> "dict[str, pd.DataFrame]":
        """Episodes of each split that has any."""
        return {str(name): part for name, part in self.table.groupby("split", observed=True)}

    def file_numbers(self, most_frames: int) -> Integers:
        """Number of the file of each episode, (m,): a file ends once it has so many frames."""
        numbers, frames = [0], 0
        for length in self.table["length"].tolist():
            frames += length
            numbers.append(numbers[-1] + (frames >= most_frames))
            frames *= frames < most_frames
        return np.array(numbers[:-1])


def write_lerobot(
    folder: Path, out: Path, data: Dataset, splits: dict[int, str], progress: Progress | None
) -> dict[str, int]:
    """Write the episodes of a dataset into a folder; returns the frames of each split.

    `progress` is called with the number of shards read and of all shards, for each split. Raises
    DataError where no frames follow each other in time.
    """
    import pandas as pd

    episodes, features = Episodes(data, splits), _features(data)
    row_bytes = sum(
        np.dtype(feature["dtype"]).itemsize * feature["shape"][0] for feature in features.values()
    )
    files = episodes.file_numbers(max(1, FILE_MEGABYTES * 2**20 // row_bytes))
    statistics = _write_frames(folder, out, episodes, files, progress)
    table, meta = episodes.table, out / "meta"
    columns = {
        "episode_index": np.arange(len(table)),
        "tasks": [[TASK]] * len(table),
        "length": table["length"],
        "data/chunk_index": files // CHUNK_FILES,
        "data/file_index": files % CHUNK_FILES,
        "dataset_from_index": table["first"],
        "dataset_to_index": table["first"] + table["length"],
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        "split": table["split"].astype(object),
        "specimen": table["specimen"],
        "episode": table["episode"],
    }
    (meta / "episodes" / "chunk-000").mkdir(parents=True)
    path = meta / "episodes" / "chunk-000" / "file-000.parquet"
    pd.DataFrame(columns).to_parquet(path, index=False)
    tasks = pd.DataFrame({"task_index": [0]}, index=pd.Index([TASK], dtype=object, name="task"))
    tasks.to_parquet(meta / "tasks.parquet")
    _write_json(meta / "stats.json", statistics)
    parts = episodes.splits()
    info = {
        "codebase_version": VERSION,
        "robot_type": "eitskin",
        "total_episodes": len(table),
        "total_frames": int(table["length"].sum()),
        "total_tasks": 1,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": FILE_MEGABYTES,
        "video_files_size_in_mb": 2 * FILE_MEGABYTES,
        "fps": 1.0 / episodes.period,
        "splits": {n: f"{part.index[0]}:{part.index[-1] + 1}" for n, part in parts.items()},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }
    _write_json(meta / "info.json", info)
    return {name: int(part["length"].sum()) for name, part in parts.items()}


def _features(data: Dataset) -> dict[str, dict[str, Any]]:
    """Features of a frame, as meta/info.json has them."""
    labels = None if data.protocol is None else list(data.protocol.labels)
    touches = [f"{name}_{number}" for number in range(MAX_TOUCHES) for name in TOUCH_FIELDS]

    def feature(dtype: str, length: int = 1, names: list[str] | None = None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": [length], "names": names}

    return {
        **{
            f"observation.{name}_{part}": feature("float32", data.channels, labels)
            for name in ("impedance", "reference")
            for part in ("real", "imag")
        },
        "label.state": feature("int64"),
        "label.bend_angle_deg": feature("float32"),
        "label.touches": feature("float32", len(touches), touches),
        "timestamp": feature("float32"),
        **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), feature("int64")),
    }


def _write_frames(
    folder: Path, out: Path, episodes: Episodes, files: Integers, progress: Progress | None
) -> dict[str, Any]:
    """Write the files of frames; returns the statistics of all that is always known."""
    arrow, parquet = require("pyarrow", "recordings"), require("pyarrow.parquet", "recordings")
    statistics: dict[str, list[Columns]] = {}
    with contextlib.ExitStack() as stack:
        writer: Any = None
        number = -1
        for columns in _pieces(folder, episodes, progress):
            for file in np.unique(files[columns["episode_index"]]).tolist():
                rows = files[columns["episode_index"]] == file
                chosen = {name: values[rows] for name, values in columns.items()}
                frames = arrow.table({n: _arrow_array(arrow, v) for n, v in chosen.items()})
                if file != number:
                    stack.close()
                    chunk, place = divmod(file, CHUNK_FILES)
                    path = out / f"data/chunk-{chunk:03d}/file-{place:03d}.parquet"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    writer, number = parquet.ParquetWriter(path, frames.schema), file
                    stack.callback(writer.close)
                writer.write_table(frames)
            for name, values in columns.items():
                if not name.startswith("label."):
                    statistics.setdefault(name, []).append(moments(values))
    return {name: joined_statistics(parts) for name, parts in statistics.items()}


def _pieces(folder: Path, episodes: Episodes, progress: Progress | None) -> Iterator[Columns]:
    """Columns of the frames of one split after the other, shard by shard."""
    first = episodes.table["first"].to_numpy()
    for part_of_split in episodes.splits().values():
        begun = 0
        for part in read_shards(folder, progress):
            of_frame = episodes.of_frame[begun : begun + len(part)]
            chosen = np.flatnonzero(np.isin(of_frame, part_of_split.index))
            if len(chosen):
                episode, within = of_frame[chosen], episodes.within[begun + chosen]
                yield _columns(part.select(chosen)) | {
                    "frame_index": within,
                    "episode_index": episode,
                    "index": first[episode] + within,
                    "task_index": np.zeros(len(chosen), dtype=np.int64),
                }
            begun += len(part)


def _columns(data: Dataset) -> Columns:
    reference = data.reference[data.specimen]
    touches = [getattr(data, f"touch_{name}") for name in TOUCH_FIELDS]
    return {
        "observation.impedance_real": data.impedance.real,
        "observation.impedance_imag": data.impedance.imag,
        "observation.reference_real": reference.real,
        "observation.reference_imag": reference.imag,
        "label.state": data.state.astype(np.int64),
        "label.bend_angle_deg": data.bend_angle_deg,
        "label.touches": np.stack(touches, axis=2).reshape(len(data), -1),
        "timestamp": data.time.astype(np.float32),
    }


def _arrow_array(arrow: Any, values: NDArray[Any]) -> Any:
    """Numbers, or lists of equally many."""
    flat = arrow.array(np.ascontiguousarray(values).reshape(-1))
    if values.ndim == 1 or values.shape[1] == 1:
        return flat
    return arrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _write_json(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def moments(values: NDArray[Any]) -> Columns:
    """Number, bounds, mean and variance of the rows of a table, (1, C) each."""
    table = values.reshape(len(values), -1).astype(np.float64)
    return {
        "count": np.array([[len(table)]]),
        "min": table.min(axis=0, keepdims=True),
        "max": table.max(axis=0, keepdims=True),
        "mean": table.mean(axis=0, keepdims=True),
        "variance": table.var(axis=0, keepdims=True),
    }


def joined_statistics(parts: Sequence[Columns]) -> dict[str, list[float]]:
    """Statistics of a table as plain data, a number for each column, from those of its parts.

    The variance of the whole is the mean of the parts' variances and the variance of their means,
    which loses no digits where a mean is large next to the deviation.
    """
    each = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    weights = each["count"][:, 0]
    mean = np.average(each["mean"], axis=0, weights=weights)
    apart = (each["mean"] - mean) ** 2
    variance = np.average(each["variance"] + apart, axis=0, weights=weights)
    return {
        "min": each["min"].min(axis=0).tolist(),
        "max": each["max"].max(axis=0).tolist(),
        "mean": mean.tolist(),
        "std": np.sqrt(variance).tolist(),
        "count": [int(weights.sum())],
    }
