"""Hold-out part of a dataset: whole specimens, or the end of a recording of one."""

import numpy as np
from numpy.typing import NDArray

from eitskin.datasets.store.dataset import Dataset

SHARE = 0.2  # of the specimens, or of the frames


def hold_out(dataset: Dataset, seed: int = 0) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Frames (n,) to train with, and frames of other specimens to judge by.

    A fifth of the specimens, at least one, is drawn at random. For a single specimen the held-out
    part is the last fifth in time of the frames of each state: neighbours in time are too similar
    to judge by.

    Args:
        dataset: at least two frames.
        seed: of the draw.
    """
    specimens = np.random.default_rng(seed).permutation(np.unique(dataset.specimen))
    if len(specimens) > 1:
        drawn = specimens[: max(1, round(SHARE * len(specimens)))]
        held_out = np.isin(dataset.specimen, drawn)
    else:
        held_out = _ends(dataset)
    return np.flatnonzero(~held_out), np.flatnonzero(held_out)


def _ends(dataset: Dataset) -> NDArray[np.bool_]:
    """Whether each frame (n,) is in the last fifth in time of its state."""
    late = np.zeros(len(dataset), dtype=np.bool_)
    for state in np.unique(dataset.state):
        frames = np.flatnonzero(dataset.state == state)
        order = np.lexsort((frames, dataset.time[frames], dataset.episode[frames]))
        late[frames[order][len(frames) - round(SHARE * len(frames)) :]] = True
    return late
