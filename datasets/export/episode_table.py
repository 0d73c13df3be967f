"""Episodes of a dataset: which frames follow each other, in which order they are exported."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.export.splits import SPLITS
from eitskin.datasets.store.dataset import Dataset
from eitskin.errors import DataError

Integers = NDArray[np.int64]
FEWEST_FRAMES = 2


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeTable:
    """Episodes of at least two frames, (m,), those of each split after each other.

    Attributes:
        length: number of frames of each.
        specimen: number of the sensor of each.
        split: of each.
        number: of each in the dataset.
        of_frame: row of this table for each frame of the dataset, (n,); -1 for single frames.
        within: number of each frame within its episode, (n,).
        period: usual time from one frame to the next [s].
    """

    length: Integers
    specimen: Integers
    split: NDArray[np.str_]
    number: Integers
    of_frame: Integers
    within: Integers
    period: float

    @classmethod
    def of(cls, data: Dataset, splits: dict[int, str]) -> "EpisodeTable":
        """Episodes of a dataset.

        Args:
            data: columns `episode`, `time` and `specimen` are read.
            splits: split of each specimen, by its number.

        Raises DataError where no two frames follow each other in time.
        """
        data.read("episode", "time", "specimen")  # of a large dataset, in one pass
        episode = data.episode.astype(np.int64)
        specimen = data.specimen_number[data.specimen].astype(np.int64)
        change = (np.diff(episode) != 0) | (np.diff(specimen) != 0)
        starts = np.concatenate([[0], np.flatnonzero(change) + 1])
        lengths = np.diff([*starts.tolist(), len(data)])
        split = np.array([splits[number] for number in specimen[starts].tolist()])
        kept = np.flatnonzero(lengths >= FEWEST_FRAMES)
        order = np.concatenate([kept[split[kept] == name] for name in SPLITS])
        if not len(order):
            raise DataError(
                f"expected episodes of at least {FEWEST_FRAMES} frames, got {len(lengths)} single "
                "frames; export them with --format parquet or huggingface, or generate a recipe "
                "with [[episodes]]"
            )
        place = np.full(len(lengths), -1)
        place[order] = np.arange(len(order))
        return cls(
            lengths[order],
            specimen[starts[order]],
            split[order],
            episode[starts[order]],
            np.repeat(place, lengths),
            np.arange(len(data)) - np.repeat(starts, lengths),
            _period(data.time, change),
        )

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.length)

    @property
    def first(self) -> Integers:
        """Number of the first frame of each episode among those exported, (m,)."""
        ends = np.cumsum(self.length)
        return np.asarray(ends - self.length)

    def ranges(self) -> dict[str, tuple[int, int]]:
        """First episode of each split that has any, and the one after its last."""
        found = {name: np.flatnonzero(self.split == name) for name in SPLITS}
        return {n: (int(rows[0]), int(rows[-1]) + 1) for n, rows in found.items() if len(rows)}

    def files(self, most_frames: int) -> Integers:
        """Number of the file of each episode, (m,): a file ends once it has so many frames."""
        numbers, number, frames = [], 0, 0
        for length in self.length.tolist():
            if frames >= most_frames:
                number, frames = number + 1, 0
            numbers.append(number)
            frames += length
        return np.array(numbers)


def _period(time: NDArray[Any], change: NDArray[np.bool_]) -> float:
    """Median time [s] between frames of an episode; raises DataError where it is zero."""
    steps = np.diff(time)[~change]
    period = float(np.median(steps))
    if not period > 0.0:
        raise DataError(
            f"expected frames with times that rise, got a median interval of {period:g} s; import "
            "the recording with its column of times"
        )
    return period
