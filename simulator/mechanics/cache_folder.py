"""Folder in which solved tables are kept between runs."""

import os
import sys
from pathlib import Path


def folder() -> Path:
    """Folder of the tables: $EITSKIN_CACHE, or the user's folder for caches."""
    given = os.environ.get("EITSKIN_CACHE")
    if given:
        return Path(given)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "eitskin"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "eitskin"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "eitskin"
