"""Datasets of this user whose shards are known to do no harm to the HDF5 library.

A hash in a manifest tells damage and not intent: a folder from elsewhere brings both. Datasets that
were made here, or whose shards were all read in a child, are noted in the user's folder for caches,
so that their shards are read in this process from then on.
"""

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from eitskin.simulator.mechanics import solved_files


def note(checksums: Iterable[str]) -> None:
    """Note a dataset by the SHA-256 of its shards; without a folder to write to, nothing is."""
    path = _path(checksums)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def known(checksums: Iterable[str]) -> bool:
    """Whether a dataset was noted."""
    try:
        return _path(checksums).is_file()
    except OSError:
        return False


def _path(checksums: Iterable[str]) -> Path:
    text = "\n".join(checksums).encode(errors="surrogatepass")
    return solved_files.folder() / "known-datasets" / hashlib.sha256(text).hexdigest()
