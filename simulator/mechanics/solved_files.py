"""Files of solutions that are kept between runs: folder, names, reading and writing."""

import hashlib
import json
import os
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eitskin.errors import ConfigurationError
from eitskin.files import atomic_file


def folder() -> Path:
    """Folder of the files: $EITSKIN_CACHE, or the user's folder for caches."""
    given = os.environ.get("EITSKIN_CACHE")
    if given:
        return Path(given)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "eitskin"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "eitskin"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "eitskin"


def file_name(kind: str, described: Mapping[str, object]) -> str:
    """Name of the file of a solution: its kind, and a hash of everything that it depends on.

    Numbers count to nine digits.
    """
    text = json.dumps(described, default=float, sort_keys=True)
    rounded = json.dumps(json.loads(text, parse_float=lambda s: f"{float(s):.9g}"))
    return f"{kind}-{hashlib.sha256(rounded.encode()).hexdigest()[:32]}.npz"


def read(path: Path) -> dict[str, NDArray[Any]] | None:
    """Arrays of a file by name; None where the file is absent or damaged."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays if the disk can be written; otherwise they are solved again next time."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, **arrays)
    except (OSError, ConfigurationError):
        return
