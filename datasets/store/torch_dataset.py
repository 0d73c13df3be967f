"""Datasets on disk as torch reads them: all in memory, or shard by shard in a shuffled order."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eitskin.datasets.store.dataset import Dataset
from eitskin.datasets.store.folder import open_dataset, read_entry, read_manifest
from eitskin.datasets.store.schema import FRAME_FIELDS
from eitskin.errors import ConfigurationError
from eitskin.extras import require

if TYPE_CHECKING:
    import torch

Item = dict[str, "torch.Tensor"]

NAMES = (*(field.name for field in FRAME_FIELDS), "reference")
_MEMORY_LIMIT = 1 << 30


class TorchDataset:
    """The frames of a dataset for `torch.utils.data.DataLoader`, in memory.

    An item is a frame: a dictionary of tensors by the names of `Dataset`'s attributes, without
    the frame axis; `reference` is the flat sensor that the frame was taken with, (C,). Unsigned
    integers come as int64, which torch can index and compare with.

    The files are read when the first item is asked for, in each process of its own, so that it
    can be sent to workers.
    """

    def __init__(
        self,
        folder: str | Path,
        names: Sequence[str] = NAMES,
        memory_limit: int = _MEMORY_LIMIT,
    ) -> None:
        """Look at the manifest and the first shard.

        Args:
            folder: of the dataset.
            names: what an item holds.
            memory_limit: of the frames together [bytes].

        Raises:
            ConfigurationError: for other names, or a dataset above the limit.
            DataError: where the folder is no complete dataset.
            ImportError: without torch.
        """
        require("torch", "training")
        self.folder, self.names = Path(folder), _checked(names)
        manifest = read_manifest(self.folder)
        self._frames = manifest.frames
        first = read_entry(self.folder, manifest.shards[0])
        size = manifest.frames * _frame_bytes(first)
        if size > memory_limit:
            raise ConfigurationError(
                f"{folder} takes {size / 1e6:.0f} MB in memory, the limit is "
                f"{memory_limit / 1e6:.0f} MB; read it with ShuffledShards, or raise memory_limit"
            )
        self._data: Dataset | None = None

    def __len__(self) -> int:
        """Number of frames."""
        return self._frames

    def __getitem__(self, index: int) -> Item:
        """Frame `index`, from the end where negative; raises IndexError beyond either end."""
        if not -self._frames <= index < self._frames:
            raise IndexError(f"frame {index} of a dataset of {self._frames}")
        if self._data is None:
            self._data = open_dataset(self.folder)
        return _item(self._data, index, self.names)

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process: where the frames are, not the frames."""
        return {**self.__dict__, "_data": None}


class ShuffledShards:
    """The frames of a dataset of any size for `torch.utils.data.DataLoader`, a shard at a time.

    Shards come in a random order, and the frames within each; both follow from the seed and the
    epoch alone. Workers share the shards out among them, so that each frame comes once. Items are
    those of `TorchDataset`. Call `set_epoch` before each epoch, and leave the loader's
    `persistent_workers` off: its workers would not hear of it.
    """

    def __init__(self, folder: str | Path, names: Sequence[str] = NAMES, seed: int = 0) -> None:
        """Look at the manifest only; errors as for `TorchDataset`.

        Args:
            folder: of the dataset.
            names: what an item holds.
            seed: of the order.
        """
        # A loader asks whether it has an IterableDataset; deriving from it would import torch.
        data = require("torch.utils.data", "training")
        data.IterableDataset.register(ShuffledShards)
        self.folder, self.names, self.seed, self.epoch = Path(folder), _checked(names), seed, 0
        self._manifest = read_manifest(self.folder)

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of the next pass; each epoch has its own."""
        self.epoch = epoch

    def __len__(self) -> int:
        """Number of frames."""
        return self._manifest.frames

    def __iter__(self) -> Iterator[Item]:
        """This worker's share of the frames."""
        worker = require("torch.utils.data", "training").get_worker_info()
        first, step = (worker.id, worker.num_workers) if worker else (0, 1)
        order = self._generator(0).permutation(len(self._manifest.shards))
        for shard in order[first::step].tolist():
            data = read_entry(self.folder, self._manifest.shards[shard])
            for index in self._generator(1, shard).permutation(len(data)).tolist():
                yield _item(data, index, self.names)

    def _generator(self, *stream: int) -> np.random.Generator:
        sequence = np.random.SeedSequence(self.seed, spawn_key=(self.epoch, *stream))
        return np.random.default_rng(sequence)


def _checked(names: Sequence[str]) -> tuple[str, ...]:
    wrong = sorted(set(names) - set(NAMES))
    if wrong or not names:
        raise ConfigurationError(
            f"expected names of {', '.join(NAMES)}, got {', '.join(wrong) or 'none'}"
        )
    return tuple(names)


def _frame_bytes(data: Dataset) -> int:
    """Memory that one frame takes [bytes]."""
    return sum(getattr(data, field.name)[0].nbytes for field in FRAME_FIELDS)


def _item(data: Dataset, index: int, names: Sequence[str]) -> Item:
    values = {
        name: data.reference[data.specimen[index]]
        if name == "reference"
        else getattr(data, name)[index]
        for name in names
    }
    return {name: _tensor(value) for name, value in values.items()}


def _tensor(value: Any) -> "torch.Tensor":
    import torch

    array = np.asarray(value)
    return torch.from_numpy(array.astype(np.int64) if array.dtype.kind == "u" else array.copy())
