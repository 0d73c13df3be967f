"""Public splits of a dataset by specimen: whoever makes them, from whichever recording."""

import hashlib
from collections.abc import Iterable

from eitskin.datasets.store.manifest import Names

SPLITS = ("train", "validation", "test")
_SHARES = (0.8, 0.1, 0.1)


def specimen_splits(numbers: Iterable[int], names: Names, seed: int) -> dict[int, str]:
    """Split of each specimen, by its number within the dataset.

    A specimen's split follows from SHA-256 of its name where it has one, else of the dataset's seed
    and its number, so that one sensor stays in one split whatever else is recorded or drawn. About
    80 % are in `train`, 10 % in each other. Where `train` would be empty, as it may be for one or
    two specimens, all are in `train`.

    Args:
        numbers: of the specimens.
        names: of specimens, where a recording gave them.
        seed: of the dataset, from which simulated specimens are drawn.
    """
    found = {n: split_of(names.specimens.get(n, f"{seed}:{n}")) for n in numbers}
    if SPLITS[0] not in found.values():
        return dict.fromkeys(found, SPLITS[0])
    return found


def split_of(key: str) -> str:
    """Split that the text `key` stands for."""
    digest = hashlib.sha256(f"eitskin split 1: {key}".encode()).digest()
    place = int.from_bytes(digest[:8], "big") / 2.0**64
    if place < _SHARES[0]:
        return SPLITS[0]
    return SPLITS[1] if place < _SHARES[0] + _SHARES[1] else SPLITS[2]
