"""Datasets for torch: all frames in memory, or shard by shard in a shuffled order."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eitskin.datasets.store.folder import open_dataset, read_entry
from eitskin.datasets.store.frame_tensors import NAMES, FrameTensors, Item, checked_names, make_item
from eitskin.datasets.store.manifest import read_manifest
from eitskin.errors import ConfigurationError
from eitskin.extras import require

_MEMORY_LIMIT = 1 << 30


class TorchDataset(FrameTensors):
    """Frames of a dataset in memory, for `torch.utils.data.DataLoader`.

    An item is a frame: a dictionary of tensors by the names of `Dataset`'s attributes, without
    the frame axis; `specimen` is the number of the frame's specimen within the dataset, and
    `reference` that specimen's, (C,). Unsigned integers are converted to int64, which torch can
    index and compare with.

    Another process reads the files itself, so that the object can be sent to workers.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, TorchDataset, save_dataset
        >>> _ = save_dataset(Dataset.from_arrays(np.full((4, 28), 600.0)), "in_memory")
        >>> len(TorchDataset("in_memory", names=("impedance",)))
        4
    """

    def __init__(
        self,
        folder: str | Path,
        names: Sequence[str] = NAMES,
        memory_limit: int = _MEMORY_LIMIT,
    ) -> None:
        """Read the frames.

        Args:
            folder: folder of the dataset.
            names: keys of an item.
            memory_limit: memory limit for all frames together [bytes].

        Raises:
            ConfigurationError: for unknown names, or a dataset above the limit.
            DataError: where the folder is no complete dataset.
            ImportError: without torch.
        """
        require("torch", "training")
        data = open_dataset(folder)
        size = len(data) * data.bytes_per_frame
        if size > memory_limit:
            raise ConfigurationError(
                f"{folder} takes {size / 1e6:.0f} MB in memory, the limit is "
                f"{memory_limit / 1e6:.0f} MB; read it with ShuffledShards, or raise memory_limit"
            )
        self.folder, self._limit = Path(folder), memory_limit
        super().__init__(data, names)

    def __reduce__(self) -> Any:
        """Folder, without frames: another process reads its own."""
        return TorchDataset, (self.folder, self.names, self._limit)


class ShuffledShards:
    """Frames of a dataset of any size, shard by shard, for `torch.utils.data.DataLoader`.

    Shards come in a random order, and the frames within each; both follow from the seed and the
    epoch alone. The shards are distributed over the loader's workers, so that each frame comes
    once. Items are those of `TorchDataset`, or batches of them, which are many times faster: for a
    loader with `batch_size=None`. Call `set_epoch` before each epoch, and leave the loader's
    `persistent_workers` off: persistent workers would keep the first epoch.

    Example:
        >>> import numpy as np
        >>> from eitskin.datasets import Dataset, ShuffledShards, save_dataset
        >>> _ = save_dataset(Dataset.from_arrays(np.full((4, 28), 600.0)), "shuffled")
        >>> sum(1 for _ in ShuffledShards("shuffled", names=("impedance",)))
        4
    """

    def __init__(
        self,
        folder: str | Path,
        names: Sequence[str] = NAMES,
        seed: int = 0,
        batch: int | None = None,
    ) -> None:
        """Read the manifest only; errors as for `TorchDataset`.

        Args:
            folder: folder of the dataset.
            names: keys of an item.
            seed: seed of the order.
            batch: number of frames in an item, the first axis of its tensors; fewer in the last
                item of a shard. None for items of one frame, without that axis.
        """
        if batch is not None and batch < 1:
            raise ConfigurationError(f"batch must be at least 1 or None, got {batch}")
        # A loader checks for an IterableDataset; a base class would import torch here.
        data = require("torch.utils.data", "training")
        data.IterableDataset.register(ShuffledShards)
        self.folder, self.names, self.seed, self.epoch = Path(folder), checked_names(names), seed, 0
        self._batch = batch
        self._manifest = read_manifest(self.folder)

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of the next pass; each epoch has its own."""
        self.epoch = epoch

    def __len__(self) -> int:
        """Number of items: frames, or batches of them."""
        size = self._batch or 1
        return sum(-(-entry.count // size) for entry in self._manifest.shards)

    def __iter__(self) -> Iterator[Item]:
        """Items of the shards of this worker."""
        worker = require("torch.utils.data", "training").get_worker_info()
        first, step = (worker.id, worker.num_workers) if worker else (0, 1)
        order = self._generator(0).permutation(len(self._manifest.shards))
        for shard in order[first::step].tolist():
            data = read_entry(self.folder, self._manifest.shards[shard])
            frames = self._generator(1, shard).permutation(len(data))
            size = self._batch or 1
            for start in range(0, len(frames), size):
                chosen = frames[start : start + size] if self._batch else int(frames[start])
                yield make_item(data, chosen, self.names)

    def _generator(self, *stream: int) -> np.random.Generator:
        sequence = np.random.SeedSequence(self.seed, spawn_key=(self.epoch, *stream))
        return np.random.default_rng(sequence)
